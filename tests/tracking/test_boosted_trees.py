"""Trees do what a walk from their roots does, and error models what their trees ask for."""

from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.tracking.boosted_trees import BoostedTrees
from flowlab.tracking.error_model import Doubt, ErrorModel

Node = tuple[int, float, "Node", "Node"] | float
"""Which number, up to what it goes to the left, and both sides; or a leaf's value."""
COLUMNS = 3


def nodes() -> st.SearchStrategy[Node]:
    leaf = st.floats(-10, 10, width=32)
    inner = lambda side: st.tuples(st.integers(0, COLUMNS - 1), st.sampled_from([-1.0, 0.0, 0.5]), side, side)  # noqa: E731
    return st.recursive(leaf, inner, max_leaves=8)


def walk(node: Node, row: np.ndarray) -> float:
    if not isinstance(node, tuple):
        return node
    column, threshold, left, right = node
    return walk(left if row[column] <= threshold else right, row)


def as_arrays(trees: list[Node]) -> BoostedTrees:
    column, threshold, children, value = [], [], [], []

    def add(node: Node) -> int:
        place = len(column)
        column.append(node[0] if isinstance(node, tuple) else -1)
        threshold.append(node[1] if isinstance(node, tuple) else 0.0)
        children.append([0, 0])
        value.append(0.0 if isinstance(node, tuple) else node)
        if isinstance(node, tuple):
            children[place] = [add(node[2]), add(node[3])]
        return place

    root = [add(tree) for tree in trees]
    return BoostedTrees(
        np.array(root, np.int32), np.array(column, np.int16), np.array(threshold, float),
        np.array(children, np.int32).reshape(-1, 2), np.array(value, np.float32),
    )  # fmt: skip


@settings(max_examples=examples(60), deadline=None, derandomize=True)
@given(trees=st.lists(nodes(), min_size=1, max_size=4), seed=st.integers(0, 99))
def test_a_row_gets_the_sum_of_its_leaves(trees: list[Node], seed: int) -> None:
    rows = np.random.default_rng(seed).choice([-2.0, -1, 0, 0.25, 0.5, 3], (2, 5, COLUMNS))
    found = as_arrays(trees)(rows)
    assert found.shape == (2, 5)
    np.testing.assert_allclose(found, [[sum(walk(t, row) for t in trees) for row in part] for part in rows], atol=1e-4)


def test_an_error_model_states_what_any_forest_asks_for_also_from_its_file(tmp_path: Path) -> None:
    far, farther = (
        Doubt(as_arrays([(k, 0.5, -6.0, 1.0)]), np.array([[-5.0, 0.0], [0.0, least]]))
        for k, least in ((0, 0.3), (2, 0.4))
    )
    model = ErrorModel(as_arrays([(1, 0.5, np.log(0.001), np.log(0.01))]), (far, farther))
    with (tmp_path / "model.npz").open("wb") as stream:
        model.write(stream)
    evidence = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]])
    for each in (model, ErrorModel.read(tmp_path / "model.npz")):
        np.testing.assert_allclose(each.stated_error(evidence, np.ones(5)), [0.001, 0.01, 0.3, 0.3, 0.4], rtol=1e-5)
        np.testing.assert_allclose(
            each.stated_error(evidence, np.full(5, 3.0)), [0.009, 0.09, 0.3, 0.3, 0.4], rtol=1e-5
        )


def test_what_is_behind_the_camera_is_no_surer_than_what_is_near() -> None:
    model = ErrorModel(as_arrays([np.log(0.002)]), (Doubt(as_arrays([-6.0]), np.array([[-5.0, 0.0], [0.0, 0.3]])),))
    behind, at_it, near = model.stated_error(np.zeros((3, 1)), np.array([-1.0, 0.0, 0.2]))
    assert behind == at_it == near > 0
