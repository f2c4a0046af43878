"""The stated error: what it must grow with, and in what frame it must not matter."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import rigid
from flowlab.records import Clip, PositionSource, Tracks2D
from flowlab.tracking.lifting import Lifted
from flowlab.tracking.uncertainty import EVIDENCE, MODEL_WEIGHTS, evidence, stated_error

T, M = 6, 4
K = np.array([[200.0, 0, 79.5], [0, 200.0, 59.5], [0, 0, 1]])


def case(
    z: float = 1.0, source: PositionSource = PositionSource.MODEL, T_world_cam: np.ndarray | None = None
) -> tuple[Clip, Tracks2D, Lifted]:
    """Points that stand still at depth z, seen, with nothing to complain of."""
    camera = Camera(160, 120, K, np.eye(4) if T_world_cam is None else T_world_cam)
    clip = Clip(np.zeros((T, 120, 160, 3), np.uint8), np.full((T, 120, 160), z, np.float32), camera)
    xy = np.tile(np.array([[20, 30], [50, 60], [90, 40], [120, 100]], np.float32), (T, 1, 1))
    tracks = Tracks2D(
        xy, np.ones((T, M), bool), np.ones((T, M), np.float32), *np.zeros((2, T, M), np.float32),
        residual=np.full((T, M), 0.2, np.float32),
    )  # fmt: skip
    xyz_world = camera.unproject(xy, np.full((T, M), z)).astype(np.float32)
    seen = np.ones((T, M), bool)
    return clip, tracks, Lifted(xyz_world, seen, np.full((T, M), int(source), np.uint8), seen)


@pytest.mark.parametrize("source", list(PositionSource))
def test_grows_with_the_square_of_depth(source: PositionSource) -> None:
    near, far = (stated_error(*case(z, source)) for z in (0.8, 1.6))
    np.testing.assert_allclose(far / near, 4, rtol=1e-3)


@given(disagreement=st.floats(0, 50), more=st.floats(0, 50), source=st.sampled_from(list(PositionSource)))
def test_more_disagreement_never_lowers_it(disagreement: float, more: float, source: PositionSource) -> None:
    clip, tracks, lifted = case(source=source)
    low, high = (
        stated_error(clip, replace(tracks, disagreement=np.full((T, M), d, np.float32)), lifted)
        for d in (disagreement, disagreement + more)
    )
    assert (high >= low * (1 - 1e-6)).all()


@pytest.mark.parametrize("source", [PositionSource.MODEL, PositionSource.FILLED])
def test_a_point_out_of_sight_is_less_sure_the_longer_it_is(source: PositionSource) -> None:
    clip, tracks, lifted = case(source=source)
    hidden = lifted.visible.copy()
    hidden[2:] = False
    sigma = stated_error(clip, tracks, replace(lifted, visible=hidden))
    assert (np.diff(sigma[1:], axis=0) >= 0).all()
    assert (sigma[-1] > sigma[1]).all()


def test_moved_points_are_less_sure() -> None:
    clip, tracks, lifted = case()
    moved = lifted.xyz_world.copy()
    moved[3:, 0, 0] += 0.1
    sigma = stated_error(clip, tracks, replace(lifted, xyz_world=moved))
    assert (sigma[3:, 0] > 1.3 * sigma[2, 0]).all()
    np.testing.assert_allclose(sigma[3:, 1:], np.broadcast_to(sigma[2, 1:], (3, 3)), rtol=1e-5)


def test_under_a_camera_that_moves_what_stands_still_is_no_surer() -> None:
    clip, tracks, lifted = case()
    still = replace(lifted, xyz_world=np.repeat(lifted.xyz_world[:1], T, axis=0))
    poses = np.tile(clip.camera.T_world_cam.astype(float), (T, 1, 1))
    poses[:, 0, 3] += 0.05 * np.arange(T)
    beside, before = (stated_error(c, tracks, still) for c in (replace(clip, T_world_cam=poses), clip))
    carried = replace(
        still, xyz_world=still.xyz_world - np.float32([0.05, 0, 0]) * np.arange(T)[:, None, None].astype("f")
    )
    np.testing.assert_allclose(beside, stated_error(clip, tracks, carried), rtol=1e-4)
    assert (beside[1:] > before[1:]).all()


def test_what_a_tracker_states_itself_is_taken_for_what_its_model_gives() -> None:
    clip, tracks, lifted = case()
    own = np.full((T, M), -1, np.float32)
    untold = stated_error(clip, replace(tracks, sigma=own), lifted)
    np.testing.assert_array_equal(untold, stated_error(clip, tracks, lifted))
    own[3:, 1] = 0.25
    told = stated_error(clip, replace(tracks, sigma=own), lifted)
    np.testing.assert_array_equal(told[3:, 1], np.float32(0.25))
    others = own < 0
    np.testing.assert_array_equal(told[others], untold[others])
    measured = replace(lifted, source=np.full((T, M), int(PositionSource.MEASURED), np.uint8))
    assert (stated_error(clip, replace(tracks, sigma=own), measured) < 0.02).all(), "it is the model that is told of"


def test_the_worlds_frame_does_not_matter() -> None:
    T_world_cam = rigid(np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]]), np.array([0.3, -1.0, 2.0]))
    here, there = stated_error(*case()), stated_error(*case(T_world_cam=T_world_cam))
    np.testing.assert_allclose(here, there, rtol=1e-4)


def test_what_a_tracker_does_not_tell_is_taken_as_nothing_wrong() -> None:
    clip, tracks, lifted = case()
    silent = replace(tracks, forward_backward=None, disagreement=None)
    np.testing.assert_array_equal(stated_error(clip, silent, lifted), stated_error(clip, tracks, lifted))
    unknown = np.full((T, M), -1, np.float32)
    np.testing.assert_array_equal(
        stated_error(clip, replace(tracks, disagreement=unknown), lifted), stated_error(clip, tracks, lifted)
    )


def test_every_piece_of_evidence_has_a_weight_and_none_rewards_trouble() -> None:
    values = evidence(*case())
    _, weights = MODEL_WEIGHTS
    assert values.shape == (T, M, len(EVIDENCE)) == (T, M, len(weights))
    assert min(weights) >= 0
