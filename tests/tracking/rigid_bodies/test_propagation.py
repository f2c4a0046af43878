"""Queries carried by known motions: where they go, and when the camera sees them."""

import numpy as np
import pytest
from rigid_body_scenes import FRAMES, Scene, fit_of, scene, two_plates

from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.choice import FollowedPoints
from flowlab.tracking.trackers.rigid_bodies.propagation import PropagatedTracks, propagate
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion


def carried(seen: Scene, uv: np.ndarray, *motions: RigidMotion) -> PropagatedTracks:
    z = seen.pictures.depth[0, uv[:, 1], uv[:, 0]].astype(float)
    return propagate(fit_of(seen, *motions), uv.astype(float), z, not_followed(len(seen.pictures), len(uv)))


def not_followed(frames: int, points: int) -> FollowedPoints:
    return FollowedPoints(np.ones((frames, points, 3)), np.zeros((frames, points), bool))


@pytest.fixture(scope="module")
def crossing() -> Scene:
    """A plate passes before another, which stands still before the wall."""
    import moving_planes

    frames = 20
    return scene([
        moving_planes.wall(1.2, frames),
        moving_planes.moving((0.2, 0.2), (-0.05, 0, 1.0), np.array([0.004, 0, 0]), np.zeros(3), frames, 1),
        moving_planes.moving((0.16, 0.5), (-0.36, 0, 0.7), np.array([0.024, 0, 0]), np.zeros(3), frames, 2),
    ])  # fmt: skip


def test_points_take_the_motion_of_what_they_lie_on_and_go_with_it() -> None:
    seen = two_plates()
    motions = seen.motion(1), seen.motion(2)
    for k in range(3):
        uv = seen.some_pixels(k, 40)
        tracks = carried(seen, uv, *motions)
        assert (tracks.motion == k).mean() > 0.9, k
        mine = tracks.motion == k
        truth = seen.motion(k).apply(seen.points(uv))
        np.testing.assert_allclose(tracks.xyz_cam[:, mine], truth[:, mine], atol=0.002)
        np.testing.assert_allclose(tracks.xyz_cam[0], seen.points(uv), atol=1e-6)
        assert np.median(tracks.cost[mine]) < 0.3


def test_points_are_seen_but_for_what_passes_before_them(crossing: Scene) -> None:
    uv = crossing.some_pixels(1, 30)
    tracks = carried(crossing, uv, crossing.motion(1), crossing.motion(2))
    truth = crossing.motion(1).apply(crossing.points(uv))
    pixel = np.rint(crossing.pictures.project(truth)).astype(int)
    front = crossing.motion(2).t[:, 0]  # its left and right edge, at 0.7 m
    f, cx = crossing.pictures.K[0, 0], crossing.pictures.K[0, 2]
    left, right = ((-0.36 + s * 0.08 + front) / 0.7 * f + cx for s in (-1, 1))
    hidden = (pixel[..., 0] > left[:, None] + 1.5) & (pixel[..., 0] < right[:, None] - 1.5)
    clear = (pixel[..., 0] < left[:, None] - 1.5) | (pixel[..., 0] > right[:, None] + 1.5)
    assert 0.1 < hidden.mean() < 0.9
    assert not tracks.visible[hidden].any()
    assert tracks.visible[clear].all()
    mine = tracks.motion == 1
    np.testing.assert_allclose(tracks.xyz_cam[:, mine], truth[:, mine], atol=0.002)
    assert mine.mean() > 0.9


def test_points_that_leave_the_picture_are_not_seen() -> None:
    seen = two_plates()
    away = RigidMotion(np.tile(np.eye(3), (FRAMES, 1, 1)), np.linspace(0, 3, FRAMES)[:, None] * [1.0, 0, 0])
    uv = seen.some_pixels(1, 20)
    fit = fit_of(seen, away)
    cheap = np.zeros_like(fit.assignment.raw)
    cheap[0] = 9  # so that everything goes away
    fit = RigidBodyFit(fit.cells, fit.bodies, type(fit.assignment)(cheap, cheap))
    z = seen.pictures.depth[0, uv[:, 1], uv[:, 0]].astype(float)
    tracks = propagate(fit, uv.astype(float), z, not_followed(FRAMES, len(uv)))
    assert (tracks.motion == 1).all()
    assert tracks.visible[0].all()
    assert not tracks.visible[-8:].any()


def test_the_spread_is_how_far_apart_the_motions_are_that_explain_a_point_alike() -> None:
    seen = two_plates()
    uv = seen.some_pixels(1, 30)
    alone = carried(seen, uv, seen.motion(1))
    beside = RigidMotion(seen.motion(1).R, seen.motion(1).t + np.linspace(0, 0.004, FRAMES)[:, None] * [0, 0, 1.0])
    doubted = carried(seen, uv, seen.motion(1), beside)
    assert (alone.spread[0] == 0).all()
    assert (doubted.spread[-1] > alone.spread[-1]).mean() > 0.8
    assert np.median(doubted.spread[-1]) == pytest.approx(0.002, abs=0.0015)


def test_flow_that_leads_away_from_a_wrong_path_is_told() -> None:
    seen = two_plates()
    uv = seen.some_pixels(1, 30)
    right, wrong = carried(seen, uv, seen.motion(1)), carried(seen, uv, seen.motion(2))
    moved = np.linalg.norm(seen.motion(1).apply(seen.points(uv))[-1] - seen.points(uv), axis=-1)
    assert np.median(right.slip[-1]) < 0.004
    assert np.median(wrong.slip[-1] / moved) > 0.15
    assert (wrong.slip[-1] > 0.015).mean() > 0.7


def test_what_is_left_of_a_poses_error_is_taken_from_the_surface() -> None:
    """Along the ray, for what moves: its surface is read there."""
    seen = two_plates()
    true = seen.motion(1)
    short = np.where(np.arange(FRAMES) > 0, -0.003, 0)[:, None] * [0, 0, 1.0]
    uv = seen.some_pixels(1, 40, border=6)
    tracks = carried(seen, uv, RigidMotion(true.R, true.t + short))
    mine = tracks.motion == 1
    off = (tracks.xyz_cam - true.apply(seen.points(uv)))[6:-6, mine, 2]
    assert mine.mean() > 0.9
    assert -0.003 < np.median(off) < 0
    assert abs(np.median(off)) < 0.5 * 0.003


def test_residuals_say_how_badly_a_frame_fits(crossing: Scene) -> None:
    uv = crossing.some_pixels(1, 30)
    tracks = carried(crossing, uv, crossing.motion(1), crossing.motion(2))
    mine = tracks.motion == 1
    assert np.median(tracks.residual[:, mine][tracks.visible[:, mine]]) < 0.25
    hidden = ~tracks.visible & mine
    np.testing.assert_allclose(tracks.residual[hidden], np.broadcast_to(tracks.cost.clip(0, 1), hidden.shape)[hidden])
