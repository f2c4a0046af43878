"""Whether the tracker says so where its motions cannot be trusted."""

from dataclasses import replace
from types import ModuleType

import moving_planes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body_scenes import fit_of, two_plates
from thoroughness import examples

from flowlab.records import Clip, PositionSource, Tracks2D, Tracks3D
from flowlab.tracking import uncertainty
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.labeling import label_clip
from flowlab.tracking.lifting import LiftSettings
from flowlab.tracking.trackers.rigid_bodies import RigidBodies, doubt
from flowlab.tracking.trackers.rigid_bodies.choice import FollowedPoints
from flowlab.tracking.trackers.rigid_bodies.propagation import propagate

FRAMES, SWAPPED = 16, 7
WALL = np.stack(np.meshgrid(np.arange(12, 60, 8), np.arange(12, 110, 12)), -1).reshape(-1, 2).astype(np.float32)
BOARD = np.stack(np.meshgrid(np.arange(100, 128, 5), np.arange(46, 75, 5)), -1).reshape(-1, 2).astype(np.float32)


def labeled(clip: Clip) -> tuple[Tracks2D, Tracks3D]:
    """Points of the wall, then those of the board."""
    return label_clip(clip, np.concatenate([WALL, BOARD]), RigidBodies(), ChunkSettings(), LiftSettings())


@pytest.fixture(scope="module")
def swapped() -> tuple[Clip, Clip]:
    """A board at rest before a wall; and the same, when it is exchanged for another at the same place."""
    still, one, other = (
        moving_planes.wall(1.2, FRAMES),
        *(
            moving_planes.moving((0.3, 0.3), (0.27, 0, 1.195), np.zeros(3), np.zeros(3), FRAMES, seed)
            for seed in (1, 2)
        ),
    )
    (kept, _), (after, _) = (moving_planes.film([still, board], noise=0.001) for board in (one, other))
    cut = replace(kept, rgb=np.concatenate([kept.rgb[:SWAPPED], after.rgb[SWAPPED:]]))
    return kept, cut


def test_what_changed_without_a_motion_that_explains_it_states_a_large_error(swapped: tuple[Clip, Clip]) -> None:
    (_, before), (tracks, after) = map(labeled, swapped)
    assert before.quality is not None
    assert after.quality is not None
    assert (before.quality.sigma < 0.02).mean() > 0.95
    sigma, board = after.quality.sigma, slice(len(WALL), None)
    assert (sigma[:, : len(WALL)] < 0.02).mean() > 0.95, "the wall has not changed"
    assert (sigma[1:SWAPPED, board] < 0.02).mean() > 0.9, "nor has the board, yet"
    modeled = after.quality.source[SWAPPED + 1 :, board] == PositionSource.MODEL
    assert modeled.any()
    assert (sigma[SWAPPED + 1 :, board][modeled] > 0.02).mean() > 0.9
    assert tracks.sigma is not None
    assert (tracks.sigma[SWAPPED + 1 :, board] == sigma[SWAPPED + 1 :, board])[modeled].all()


@settings(max_examples=examples(60), deadline=None, derandomize=True)
@given(data=st.data())
@pytest.mark.parametrize("of", [doubt, uncertainty])
def test_worse_evidence_never_states_less(of: ModuleType, data: st.DataObject) -> None:
    column = data.draw(st.sampled_from([k for k, grows in enumerate(of.EVIDENCE.values()) if grows]))
    numbers = st.floats(0, 1) | st.floats(0, 0.02) | st.floats(0, 100)
    evidence = np.array(data.draw(st.lists(numbers, min_size=len(of.EVIDENCE), max_size=len(of.EVIDENCE))))[None]
    worse = evidence.copy()
    worse[0, column] += data.draw(st.floats(0, 2))
    stated, more = (of.error_model().stated_error(e, np.ones(1))[0] for e in (evidence, worse))
    assert more >= stated * (1 - 1e-6), list(of.EVIDENCE)[column]


@pytest.mark.parametrize("of", [doubt, uncertainty])
def test_trees_know_no_other_evidence(of: ModuleType) -> None:
    model = of.error_model()
    assert all(
        forest.column.max() < len(of.EVIDENCE) for forest in (model.log_error, *(d.log_odds for d in model.doubts))
    )


@pytest.mark.parametrize("of", [doubt, uncertainty])
def test_it_grows_with_the_square_of_depth_beyond_what_was_seen(of: ModuleType) -> None:
    near, far = of.error_model().stated_error(np.zeros((2, len(of.EVIDENCE))), np.array([10.0, 30]))
    assert far / near == pytest.approx(9, rel=1e-4)


def test_what_is_likely_far_off_states_decimeters() -> None:
    evidence = np.array([[1.0 if grows else 0.5 for grows in doubt.EVIDENCE.values()]])
    assert doubt.error_model().stated_error(evidence, np.ones(1))[0] > 0.2


def test_what_could_have_slid_far_unseen_states_half_of_that() -> None:
    evidence = np.zeros((1, len(doubt.EVIDENCE)))
    evidence[0, list(doubt.EVIDENCE).index("slippage")] = 0.9
    assert doubt.stated_error(evidence, np.ones(1))[0] >= 0.45


def test_how_far_bodies_turn_and_what_they_gain_is_evidence() -> None:
    seen = two_plates()
    fit, uv = fit_of(seen, seen.motion(1), seen.motion(2)), seen.some_pixels(1, 20)
    angle = np.stack([np.arccos(((np.trace(m.R, axis1=1, axis2=2) - 1) / 2).clip(-1, 1)) for m in fit.motions], 1)
    np.testing.assert_allclose(doubt._turned(fit), angle, atol=1e-6)
    gain, owner, cost = fit.assignment.gain, fit.assignment.best_motion, fit.assignment.cost
    without = np.sort(cost[:, owner == 2], 0)
    assert gain[2] == pytest.approx((without[1] - without[0]).mean(), rel=1e-5)
    assert gain[1:].min() > 0.1
    assert fit_of(seen).assignment.gain == pytest.approx([0.0])  # nothing else explains anything
    followed = FollowedPoints(seen.motion(1).apply(seen.points(uv)), np.ones((len(angle), 20), bool))
    carried = propagate(fit, uv.astype(float), seen.points(uv)[:, 2], followed)
    of = carried, uv.astype(float), seen.points(uv)[:, 2], carried.visible, followed.xyz_cam, np.zeros(20)
    evidence = dict(zip(doubt.EVIDENCE, np.moveaxis(doubt.evidence(fit, *of), -1, 0), strict=True))
    assert (carried.motion == 1).all()
    np.testing.assert_allclose(evidence["turned"], angle[:, [1]].repeat(20, 1), atol=1e-6)
    np.testing.assert_allclose(evidence["cost"][5], carried.cost)
    np.testing.assert_allclose(evidence["gain"], gain[1])


def test_what_left_the_picture_says_nothing_for_or_against_what_is_around() -> None:
    cost, out = np.array([[0.1, 0.3, 0.9, 0.6]], np.float32), np.array([[False, False, True, True]])
    cells = doubt._Cells(np.zeros((4, 3)), np.zeros(4, int), cost, out)
    around = np.array([[0, 1], [0, 2], [2, 3]])
    np.testing.assert_allclose(cells.misfit(around), [[0.2, 0.1, doubt._UNSEEN_COST]], rtol=1e-6)
