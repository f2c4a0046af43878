"""The rigid-body tracker against scenes whose motion is known in closed form."""

from dataclasses import fields, replace

import cv2
import moving_planes
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowlab.geometry.sampling import farthest_points
from flowlab.records import Clip, PositionSource, Tracks2D
from flowlab.testing.trackers import check_tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.labeling import label_clip
from flowlab.tracking.lifting import LiftSettings
from flowlab.tracking.trackers.rigid_bodies import RigidBodies
from flowlab.tracking.trackers.rigid_bodies.features import extract_features

FRAMES = 24


def two_plates() -> list[moving_planes.Plate]:
    """One slides to the right and turns; one comes nearer, tilting."""
    return [
        moving_planes.wall(1.2, FRAMES),
        moving_planes.moving(
            (0.22, 0.26), (-0.2, -0.12, 0.8), np.array([0.008, 0.002, 0]), np.array([0, 0, 0.015]), FRAMES, 1
        ),
        moving_planes.moving(
            (0.24, 0.22), (0.2, 0.15, 0.9), np.array([-0.002, 0, -0.007]), np.array([0, 0.012, 0]), FRAMES, 2
        ),
    ]


def queries(owner: np.ndarray, of: int, count: int = 20, border: int = 4) -> np.ndarray:
    """Pixels (M, 2) of frame 0 that show a plate, away from its edges."""
    inner = np.ones_like(owner, bool)
    for axis in (0, 1):
        for shift in (-border, border):
            inner &= np.roll(owner, shift, axis) == of
    inner[:border], inner[-border:], inner[:, :border], inner[:, -border:] = False, False, False, False
    v, u = np.nonzero(inner & (owner == of))
    xy = np.stack([u, v, np.zeros(len(u))], -1).astype(np.float32)
    return xy[farthest_points(xy, count), :2]


def errors(
    scene: list[moving_planes.Plate], clip: Clip, owner: np.ndarray, xy: np.ndarray
) -> tuple[np.ndarray, Tracks2D]:
    """Distance (T, M) [m] between labels and truth."""
    tracks, labels = label_clip(clip, xy, RigidBodies(), ChunkSettings(), LiftSettings())
    return np.linalg.norm(labels.xyz_world - moving_planes.paths(scene, clip, owner, xy), axis=-1), tracks


@pytest.mark.parametrize(("noise", "within"), [(0.0, 0.004), (0.003, 0.006)])
def test_follows_things_that_move_differently(noise: float, within: float) -> None:
    scene = two_plates()
    clip, owner = moving_planes.film(scene, noise=noise)
    for k, limit in [(0, 0.001 + 3 * noise), (1, within), (2, within)]:
        error, tracks = errors(scene, clip, owner, queries(owner, k))
        assert np.median(error, 1)[1:].max() < limit, k
        assert (error[-1] < 0.02 + 4 * noise).mean() >= 0.9, k
        assert tracks.visible.mean() > 0.5


@pytest.mark.parametrize("z", [0.75, 0.994])
def test_a_board_that_slides_before_a_wall_is_not_left_standing(z: float) -> None:
    """Nor one so thin that depth does not tell it from the wall."""
    frames = 20
    board = moving_planes.moving((0.25 * z, 0.3 * z), (-0.15, 0, z), np.array([z / 72, 0, 0]), np.zeros(3), frames, 1)
    scene = [moving_planes.wall(1.0, frames), board]
    clip, owner = moving_planes.film(scene, noise=0.001)
    for k in (0, 1):
        error, _ = errors(scene, clip, owner, queries(owner, k, 16))
        assert (error[-1] < 0.02).mean() > 0.9, k


def test_does_not_drift() -> None:
    scene = two_plates()
    clip, owner = moving_planes.film(scene)
    error, _ = errors(scene, clip, owner, queries(owner, 1))
    assert np.median(error[-4:]) < np.median(error[4:8]) + 0.002


def test_a_hidden_point_is_carried_on_and_said_to_be_hidden() -> None:
    frames = 30
    scene = [
        moving_planes.wall(1.2, frames),
        moving_planes.moving((0.2, 0.2), (-0.1, 0, 1.0), np.array([0.004, 0, 0]), np.zeros(3), frames, 1),
        moving_planes.moving((0.16, 0.5), (-0.45, 0, 0.7), np.array([0.024, 0, 0]), np.zeros(3), frames, 2),
    ]
    clip, owner = moving_planes.film(scene)
    xy = queries(owner, 1, count=12)
    _, labels = label_clip(clip, xy, RigidBodies(), ChunkSettings(), LiftSettings())
    truth = moving_planes.paths(scene, clip, owner, xy)
    uv, z = clip.camera.project(truth)
    j, i = np.rint(uv).astype(int).transpose(2, 0, 1)
    is_seen = clip.depth[np.arange(frames)[:, None], i, j]
    hidden = is_seen < z - 0.1
    assert 0.1 < hidden.mean() < 0.9
    # Within a pixel of the edge of what hides a point, either answer is right.
    assert labels.visible[hidden].mean() < 0.15
    assert labels.visible[~hidden].mean() > 0.9
    assert labels.quality is not None
    assert np.isin(labels.quality.source[1:], [PositionSource.MODEL]).all()
    error = np.linalg.norm(labels.xyz_world - truth, axis=-1)
    assert np.median(error[hidden]) < 0.006
    assert np.median(error[-1]) < 0.006


def test_a_moving_camera_is_one_body() -> None:
    velocity, spin = np.array([0.004, -0.002, 0.003]), np.array([0.003, 0.004, 0.002])
    steps = np.arange(FRAMES)[:, None]
    R, t = Rotation.from_rotvec(steps * spin).as_matrix(), steps * velocity
    still = [
        moving_planes.wall(1.1, FRAMES),
        moving_planes.moving((0.3, 0.25), (0, 0, 0.8), 0 * velocity, 0 * spin, FRAMES, 1),
    ]
    scene = [moving_planes.Plate(p.size, R @ p.R, (R @ p.t[..., None])[..., 0] + t, p.seed) for p in still]
    clip, owner = moving_planes.film(scene)
    for k in (0, 1):
        error, _ = errors(scene, clip, owner, queries(owner, k, border=12))
        assert np.median(error[-1]) < 0.008, k


def test_large_pictures_are_shrunk_and_give_the_same_places() -> None:
    scene = two_plates()
    clip, owner = moving_planes.film(scene, width=640, height=480)
    assert extract_features(clip, 4.0).depth.shape[1:] == (240, 320)
    error, _ = errors(scene, clip, owner, queries(owner, 1, border=16))
    assert np.median(error, 1).max() < 0.004


def test_points_without_depth_are_followed_in_the_picture() -> None:
    scene = two_plates()
    clip, owner = moving_planes.film(scene)
    xy = queries(owner, 1, count=10)
    hole = clip.depth.copy()
    hole[0, xy[0, 1].astype(int), xy[0, 0].astype(int)] = 0
    tracks = RigidBodies().open(Clip(clip.rgb, hole, clip.camera)).track(np.insert(xy, 0, 0, axis=1), 0, FRAMES)
    assert tracks.xyz_cam is not None
    assert tracks.forward_backward is not None
    assert (tracks.xyz_cam[:, 0] == 0).all()
    assert (tracks.xyz_cam[1:, 1:, 2] > 0).all()
    assert (tracks.forward_backward[0:, 0] >= 0).any()
    uv, _ = clip.camera.project(moving_planes.paths(scene, clip, owner, xy[:1]))
    assert np.linalg.norm(tracks.xy[-1, 0] - uv[-1, 0]) < 3


def test_what_nothing_explains_is_followed_in_the_picture() -> None:
    clip, owner = moving_planes.film(two_plates())
    query = np.insert(queries(owner, 1, count=5), 0, 0, axis=1)
    tracks = RigidBodies(unexplained=1e-6).open(clip).track(query, 0, FRAMES)
    assert tracks.xyz_cam is not None
    assert (tracks.xyz_cam == 0).all()


def test_same_seed_same_tracks() -> None:
    clip, owner = moving_planes.film(two_plates(), noise=0.003)
    query = np.insert(np.concatenate([queries(owner, k, 6) for k in range(3)]), 0, 0, axis=1)
    one, other = (RigidBodies(seed=3).open(clip).track(query, 0, FRAMES) for _ in range(2))
    for field in fields(Tracks2D):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_keeps_the_contract_of_trackers() -> None:
    check_tracker(RigidBodies)


@pytest.mark.parametrize("pixels", [[(21, 31)], [(21, 31), (22, 30)]])
def test_hardly_any_depth_is_no_reason_to_stop(pixels: list[tuple[int, int]]) -> None:
    """Not even where none of it lies at a pixel that is looked at for bodies."""
    clip, _ = moving_planes.film([moving_planes.wall(1.0, 6)], 80, 60)
    depth = np.zeros_like(clip.depth)
    for x, y in pixels:
        depth[:, y, x] = 1
    _, labels = label_clip(
        replace(clip, depth=depth), np.array(pixels, np.float32), RigidBodies(), ChunkSettings(), LiftSettings()
    )
    np.testing.assert_allclose(labels.xyz_world[-1], labels.xyz_world[0], atol=0.01)


@pytest.mark.parametrize(("width", "height"), [(8, 8), (40, 12), (640, 20)])
def test_pictures_that_are_too_small_for_optical_flow_are_followed_without(width: int, height: int) -> None:
    """OpenCV would end the process at such pictures, or raise an error of its own."""
    clip, _ = moving_planes.film([moving_planes.wall(1.2, 5)], width=width, height=height)
    tracks, labels = label_clip(
        clip, np.array([[width // 2, height // 2]], np.float32), RigidBodies(), ChunkSettings(), LiftSettings()
    )
    assert np.isfinite(tracks.xy).all()
    assert labels.quality is not None
    assert not (labels.quality.source == PositionSource.MODEL).any()


class PlainPlate(moving_planes.Plate):
    """Without texture."""

    def texture(self) -> np.ndarray:
        return np.full((384, 512, 3), 150, np.float32)


def test_a_plain_surface_beside_what_passes_closely_before_it_stays() -> None:
    """Lucas-Kanade follows the edge beside its points, which looks the same all along."""
    wall = moving_planes.wall(1.0, FRAMES)
    hand = moving_planes.moving((0.3, 0.3), (-0.12, 0, 0.985), np.array([0.008, 0, 0]), np.zeros(3), FRAMES, 1)
    scene = [PlainPlate(wall.size, wall.R, wall.t, wall.seed), hand]
    clip, owner = moving_planes.film(scene, width=320, height=240, noise=0.003)
    near, touching = (cv2.dilate((owner == 1).astype(np.uint8), np.ones((k, k))) == 1 for k in (13, 5))
    v, u = np.nonzero(near & ~touching)
    error, _ = errors(scene, clip, owner, np.stack([u, v], -1)[::16].astype(np.float32))
    assert (error < 0.02).mean() > 0.95  # it was .53 where that told their motion
