"""The figures of success show what they are given."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from flowlab.viz.flow_error_figure import FlowBars, draw_flow_errors, plot_flow_errors
from flowlab.viz.learning_curve_figure import LearningCurve, draw_learning_curves, plot_learning_curves
from flowlab.viz.plot_style import policy_colors
from flowlab.viz.success_figure import Mark, SuccessPanel, draw_success, plot_success

A, B = Mark(0.4, 0.2, 0.6), Mark(0.9, 0.7, 0.95, paper=0.5)
HARD = SuccessPanel("hard (2 of 6)", {"push": {"dp3": A, "fdp": B}, "assembly": {"fdp": A}}, {"dp3": A})
EASY = SuccessPanel("easy (1 of 28)", {"reach": {"dp3": A}}, {})
CURVES = {
    "push": {"dp3": LearningCurve((1, 2, 4), (A, A, B)), "fdp": LearningCurve((1.5, 3), (A, B))},
    "assembly": {"fdp": LearningCurve((2,), (A,))},
}
FLOW = {
    "push": {"fdp": FlowBars(4, 20, 7, 40), "mine": FlowBars(6, 22, 9, 44)},
    "reach": {"mine": FlowBars(1, 2, 3, 4)},
}


def titles(figure: Figure) -> dict[str, Axes]:
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def data(line: Line2D) -> tuple[list[float], list[float]]:
    return np.asarray(line.get_xdata()).tolist(), np.asarray(line.get_ydata()).tolist()


def drawn(axes: Axes, marker: str) -> list[tuple[float, float, str]]:
    """Share, height on the axis, and color of every mark of a kind, from top to bottom."""
    lines = [line for line in axes.lines if line.get_marker() == marker]
    return sorted(
        ((data(x)[0][0], data(x)[1][0], to_hex(x.get_markeredgecolor())) for x in lines), key=lambda found: found[1]
    )


def inside(figure: Figure) -> None:
    """Nothing sticks out of the picture."""
    figure.canvas.draw()
    box = figure.get_tightbbox()
    assert min(box.x0, box.y0) >= 0
    width, height = figure.get_size_inches()
    assert box.x1 <= width
    assert box.y1 <= height


def test_every_policy_has_its_dot_interval_and_diamond() -> None:
    figure = plot_success([EASY, HARD], ["dp3", "fdp"])
    inside(figure)
    assert list(titles(figure)) == ["easy (1 of 28)", "hard (2 of 6)"]
    hard = titles(figure)["hard (2 of 6)"]
    assert [t.get_text() for t in hard.get_yticklabels()] == ["push", "assembly", "mean of tasks"]
    colors = policy_colors(["dp3", "fdp"])
    dots = drawn(hard, "o")
    assert [(x, color) for x, _, color in dots] == [
        (0.4, colors["dp3"]), (0.9, colors["fdp"]), (0.4, colors["fdp"]), (0.4, colors["dp3"]),
    ]  # fmt: skip
    intervals = {(tuple(x), y[0]) for line in hard.lines if line.get_marker() == "None" for x, y in [data(line)]}
    limits = [(0.2, 0.6), (0.7, 0.95), (0.2, 0.6), (0.2, 0.6)]
    assert intervals == {(x, y) for x, (_, y, _) in zip(limits, dots, strict=True)}
    assert drawn(hard, "D") == [(0.5, dots[1][1], colors["fdp"])]
    assert legend(figure) == ["dp3", "fdp", "paper"]


def test_rows_have_room_for_their_policies_and_names_are_in_their_middle() -> None:
    hard = titles(plot_success([HARD], ["dp3", "fdp"]))["hard (2 of 6)"]
    push, assembly, mean = (float(y) for y in hard.get_yticks())
    heights = [y for _, y, _ in drawn(hard, "o")]
    assert heights == sorted(set(heights))
    assert np.mean(heights[:2]) == pytest.approx(push)
    assert heights[2:] == pytest.approx([assembly, mean])
    assert hard.get_ylim()[0] > hard.get_ylim()[1]  # the first on top


def test_the_paper_is_in_the_legend_only_if_it_is_drawn() -> None:
    assert legend(plot_success([EASY], ["dp3"])) == ["dp3"]


def test_many_tasks_are_set_in_two_columns() -> None:
    def panel(count: int) -> SuccessPanel:
        return SuccessPanel(f"{count}", {f"task-{k}": {"dp3": A, "fdp": B} for k in range(count)}, {})

    def left(*counts: int) -> list[float]:
        figure = plot_success([panel(n) for n in counts], ["dp3", "fdp"])
        inside(figure)
        return [axes.get_position().x0 for axes in figure.axes]

    assert len(set(left(9, 7))) == 1
    two = left(28, 11, 6, 5)
    assert two[0] < two[1] == two[2] == two[3]
    assert len(set(left(28))) == 1


def test_long_names_have_room() -> None:
    task, label = "button-press-topdown-wall", "a-run-of-last-november-with-seed-3"
    inside(plot_success([SuccessPanel("easy", {task: {label: A, "fdp": B}}, {})], [label, "fdp"]))
    inside(plot_flow_errors({task: {label: FlowBars(4, 20, 7, 40)}}, [label]))
    inside(
        plot_learning_curves(
            {task: {f"{label}-{k}": LearningCurve((1, 2), (A, B)) for k in range(4)}},
            [f"{label}-{k}" for k in range(4)],
        )
    )


def test_colors_tell_policies_apart() -> None:
    known = ["dp3", "mba", "fdp", "fdp-m50", "fdp-m200", "fdp-object", "fdp-stratified", "fdp-auxiliary"]
    colors = policy_colors([*known, "mine", "yours"])
    assert len(set(colors.values())) == 10
    assert policy_colors(["fdp"]) == {"fdp": colors["fdp"]}
    assert len(set(policy_colors([f"run-{k}" for k in range(30)]).values())) == 30, "each has one of its own"


def test_curves_are_drawn_task_by_task() -> None:
    figure = plot_learning_curves(CURVES, ["dp3", "mba", "fdp"])
    inside(figure)
    assert list(titles(figure)) == ["push", "assembly"]
    push, assembly = figure.axes
    assert [data(line) for line in push.lines] == [([1, 2, 4], [0.4, 0.4, 0.9]), ([1.5, 3], [0.4, 0.9])]
    assert [data(line) for line in assembly.lines] == [([2], [0.4])]
    assert push.get_xlim() == assembly.get_xlim()
    assert push.get_xlim()[1] > 4
    band = push.collections[0].get_paths()[0].vertices
    assert {(x, y) for x, y in band.tolist()} >= {(1, 0.2), (1, 0.6), (2, 0.2), (4, 0.7), (4, 0.95)}
    assert legend(figure) == ["dp3", "fdp"]  # mba has no curve


def test_axes_are_named_below_the_lowest_panels() -> None:
    figure = plot_learning_curves({f"task-{k}": {"fdp": LearningCurve((1, 2), (A, B))} for k in range(5)}, ["fdp"])
    inside(figure)
    assert [bool(axes.get_xlabel()) for axes in figure.axes] == [False, False, True, True, True]


def test_bars_of_flow_stand_before_those_of_no_motion() -> None:
    labels = ["dp3", "fdp", "mine"]
    figure = plot_flow_errors(FLOW, labels)
    inside(figure)
    ade, fde = figure.axes
    colors = policy_colors(labels)
    for axes, wanted in ((ade, [(4, 20), (6, 22), (1, 2)]), (fde, [(7, 40), (9, 44), (3, 4)])):
        bars = [p for c in axes.containers for p in c.patches if isinstance(p, Rectangle)]
        pairs = list(zip(bars[1::2], bars[::2], strict=True))
        assert [(ours.get_width(), zero.get_width()) for ours, zero in pairs] == wanted
        assert [to_hex(ours.get_facecolor()) for ours, _ in pairs] == [colors[x] for x in ("fdp", "mine", "mine")]
        for ours, zero in pairs:
            assert ours.get_zorder() > zero.get_zorder()
            assert zero.get_y() < ours.get_y() < ours.get_y() + ours.get_height() < zero.get_y() + zero.get_height()
    assert [t.get_text() for t in ade.get_yticklabels()] == ["push", "reach"]
    assert legend(figure) == ["fdp", "mine", "no motion"]


def test_pictures_replace_what_was_there(tmp_path: Path) -> None:
    paths = [tmp_path / "figures" / name for name in ("success.png", "curves.png", "flow.png")]
    paths[0].parent.mkdir()
    paths[0].write_text("old")
    draw_success([EASY, HARD], ["dp3", "fdp"], paths[0])
    draw_learning_curves(CURVES, ["dp3", "fdp"], paths[1])
    draw_flow_errors(FLOW, ["fdp", "mine"], paths[2])
    assert sorted(paths[0].parent.iterdir()) == sorted(paths)
    for path in paths:
        picture = imread(path)
        assert min(picture.shape[:2]) > 250
        assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 20
