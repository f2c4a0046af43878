"""Predicted flow is measured against what MuJoCo's bodies did, by sums one can write out."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.evaluation.flow_error import flow_error
from flowlab.evaluation.results import RolloutFlowError
from flowlab.geometry.transforms import apply, rigid
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, sample_queries
from flowlab.records import Queries
from flowlab.sim.expert import Expert
from flowlab.sim.recorder import Rollout, TaskSimulator
from flowlab.sim.scene_settings import SceneSettings

PLANNED, MOVES_M = 15, 0.005
Predicted = list[tuple[int, np.ndarray]]


@dataclass(frozen=True)
class Case:
    rollout: Rollout
    queries: Queries
    """12 that are distinct, and 4 that repeat them."""
    truth: np.ndarray
    """(T, 12, 3): where the distinct ones were in the world, from MuJoCo's own numbers."""
    depth: np.ndarray
    """(T, 12): their distance along the camera's axis."""


@pytest.fixture(scope="module")
def case() -> Case:
    """An expert hammers, and every body's pose is written down before every action."""
    simulation = (simulator := TaskSimulator("hammer", SceneSettings())).simulation
    recorder = simulator.begin(1_000_000)
    cloud = Observer(ObserverSettings(), "hammer").cloud(recorder.frame())
    queries = sample_queries(cloud, QuerySettings(points=12, sampling="stratified", object_share=0.5))
    model, data, expert = simulation.model, simulation.data, Expert(simulation)
    position, turn = [], []
    for _ in range(45):
        position.append(data.xpos.copy())
        turn.append(data.xmat.reshape(-1, 3, 3).copy())
        recorder.step(expert.act())
    truth = np.zeros((45, 12, 3))
    for m, owner in enumerate(queries.owner):
        body = model.geom_bodyid[owner] if owner < model.ngeom else model.site_bodyid[owner - model.ngeom]
        fixed = turn[0][body].T @ (queries.xyz_world[m] - position[0][body])
        for t in range(45):
            truth[t, m] = turn[t][body] @ fixed + position[t][body]
    eye = data.cam("corner2")
    depth = -((truth - eye.xpos) @ eye.xmat.reshape(3, 3))[..., 2]
    repeated = [*range(12), 0, 1, 2, 3]
    padded = replace(queries, xyz_world=queries.xyz_world[repeated], owner=queries.owner[repeated], pixel=None)
    return Case(recorder.rollout(), padded, truth, depth)


def by_hand(case: Case, predicted: Predicted, n_action_steps: int) -> RolloutFlowError | None:
    """Pair by pair."""
    far, far_if_still, ends, ends_if_still, calm, limits = [], [], [], [], [], []
    for step, flow in predicted:
        done = min(n_action_steps, len(case.truth) - 1 - step)
        for m in range(12):
            true = [case.truth[step + k + 1, m] - case.truth[step, m] for k in range(done)]
            guess, errors = np.zeros(3), []
            for k in range(done):
                guess = guess + flow[k, m]
                errors.append(math.dist(guess, true[k]))
            lengths = [math.hypot(*x) for x in true]
            if not any(x > MOVES_M for x in lengths):
                calm += errors
                continue
            far += errors
            far_if_still += lengths
            ends.append(errors[-1])
            ends_if_still.append(lengths[-1])
            limits += [case.depth[step + k + 1, m] for k in range(done)]
    if not far:
        return None
    apd, jaccard = tapvid(far, limits, case)
    apd_if_still, jaccard_if_still = tapvid(far_if_still, limits, case)
    return RolloutFlowError(
        pairs=len(far),
        ade_mm=1e3 * sum(far) / len(far),
        zero_ade_mm=1e3 * sum(far_if_still) / len(far),
        ends=len(ends),
        fde_mm=1e3 * sum(ends) / len(ends),
        zero_fde_mm=1e3 * sum(ends_if_still) / len(ends),
        apd=apd,
        zero_apd=apd_if_still,
        average_jaccard=jaccard,
        zero_average_jaccard=jaccard_if_still,
        still_pairs=len(calm),
        still_mm=1e3 * sum(calm) / len(calm) if calm else 0.0,
    )


def tapvid(errors: list[float], depth: list[float], case: Case) -> tuple[float, float]:
    """APD, and average Jaccard where everything is visible and said to be: a miss is a false one and a missed one."""
    focal = case.rollout.camera.K[0, 0] * 256 / 128
    shares = [
        sum(e < pixels * z / focal for e, z in zip(errors, depth, strict=True)) / len(errors)
        for pixels in (1, 2, 4, 8, 16)
    ]
    return sum(shares) / 5, sum(s / (2 - s) for s in shares) / 5


def assert_close(found: RolloutFlowError | None, expected: RolloutFlowError | None) -> None:
    assert (found is None) == (expected is None)
    if found is None or expected is None:
        return
    for name, value in expected.model_dump().items():
        # float32 poses; a share may turn by one pair that lies on a limit
        tolerance = 0 if isinstance(value, int) else 2e-3 if name.endswith("mm") else 1.01 / expected.pairs
        assert getattr(found, name) == pytest.approx(value, abs=tolerance), name


def prediction(case: Case, steps: list[int], noise: float, seed: int = 0) -> Predicted:
    """The true flow with noise [m]; the actions after the last are foreseen to do nothing but noise."""
    rng = np.random.default_rng(seed)
    truth = np.concatenate([case.truth, case.truth[-1:].repeat(PLANNED, 0)])
    made = []
    for step in steps:
        flow = np.zeros((PLANNED, 16, 3))
        flow[:, :12] = np.diff(truth[step : step + PLANNED + 1], axis=0)
        flow += noise * rng.normal(size=flow.shape)
        flow[:, 12:] = 7.0
        made.append((step, flow.astype(np.float32)))
    return made


def test_the_case_has_points_that_move_and_points_that_do_not(case: Case) -> None:
    reach = np.linalg.norm(case.truth - case.truth[0], axis=-1).max(0)
    assert (reach > 0.05).sum() >= 3
    assert (reach < 1e-4).sum() >= 3


@settings(max_examples=examples(25), deadline=None)
@given(
    n_action_steps=st.integers(1, PLANNED),
    noise=st.sampled_from([0.0, 0.001, 0.01]),
    first=st.integers(0, 30),
    seed=st.integers(0, 99),
)
def test_the_figures_are_those_of_sums_by_hand(
    case: Case, n_action_steps: int, noise: float, first: int, seed: int
) -> None:
    predicted = prediction(case, [*range(first, 44, n_action_steps)], noise, seed)
    assert_close(
        flow_error(case.rollout, case.queries, predicted, n_action_steps), by_hand(case, predicted, n_action_steps)
    )


def test_a_perfect_prediction_is_perfect(case: Case) -> None:
    found = flow_error(case.rollout, case.queries, prediction(case, [*range(0, 44, 8)], 0.0), 8)
    assert found is not None
    assert max(found.ade_mm, found.fde_mm, found.still_mm) < 1e-2
    assert (found.apd, found.average_jaccard) == (1, 1)
    assert found.zero_fde_mm > found.zero_ade_mm > 5
    assert found.zero_average_jaccard < found.zero_apd < 0.95
    assert found.pairs > 100
    assert found.still_pairs > 100


def test_no_motion_is_as_good_as_its_baseline(case: Case) -> None:
    predicted = [(step, np.zeros((PLANNED, 16, 3), np.float32)) for step in range(0, 44, 8)]
    found = flow_error(case.rollout, case.queries, predicted, 8)
    assert found is not None
    for name in ("ade_mm", "fde_mm", "apd", "average_jaccard"):
        assert getattr(found, name) == getattr(found, f"zero_{name}")


def test_only_executed_steps_and_distinct_points_count(case: Case) -> None:
    predicted = prediction(case, [0, 8, 16, 24, 32, 40], 0.002)
    before = flow_error(case.rollout, case.queries, predicted, 8)
    for _, flow in predicted:
        flow[8:] = 1e3
        flow[:, 12:] = -1e3
    assert flow_error(case.rollout, case.queries, predicted, 8) == before
    predicted[2][1][7] += 0.01
    assert flow_error(case.rollout, case.queries, predicted, 8) != before


def test_a_plan_with_nothing_to_compare_it_with_counts_for_nothing(case: Case) -> None:
    """One made at the last step, whose first action's end nobody wrote down."""
    predicted = prediction(case, [24, 32], 0.002)
    found = flow_error(case.rollout, case.queries, predicted, 8)
    assert found == flow_error(case.rollout, case.queries, [*predicted, *prediction(case, [44], 0.5)], 8)
    assert flow_error(case.rollout, case.queries, prediction(case, [44], 0.0), 8) is None
    assert flow_error(case.rollout, case.queries, [], 8) is None


def test_where_nothing_moves_there_is_nothing_to_say(case: Case) -> None:
    still = np.flatnonzero(np.linalg.norm(case.truth - case.truth[0], axis=-1).max(0) < 1e-4)
    queries = replace(
        case.queries, xyz_world=case.queries.xyz_world[still], owner=case.queries.owner[still], count=len(still)
    )
    predicted = [(0, np.zeros((PLANNED, len(still), 3), np.float32))]
    assert flow_error(case.rollout, queries, predicted, 8) is None


@settings(max_examples=examples(10), deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_figures_are_the_same_in_any_world(case: Case, seed: int) -> None:
    """Tracks, query points and flow are in the dataset's world, which need not be MuJoCo's."""
    rng = np.random.default_rng(seed)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R = R * np.sign(np.linalg.det(R))
    T = rigid(R, rng.uniform(-1, 1, 3))
    camera = replace(case.rollout.camera, T_world_cam=T @ case.rollout.camera.T_world_cam)
    turned = replace(case.rollout, T_world_sim=T, camera=camera)
    xyz = apply(T, case.queries.xyz_world.astype(np.float64)).astype(np.float32)
    predicted = prediction(case, [0, 8, 16, 24, 32, 40], 0.002)
    elsewhere = [(step, (flow @ R.T).astype(np.float32)) for step, flow in predicted]
    found = flow_error(turned, replace(case.queries, xyz_world=xyz), elsewhere, 8)
    assert_close(found, by_hand(case, predicted, 8))
