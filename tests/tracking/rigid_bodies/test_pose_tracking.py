"""Poses of bodies against scenes whose motion is known: refined in one frame, and tracked through all."""

from dataclasses import replace
from functools import cache

import moving_planes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body_scenes import FRAMES, Scene, scene, still_camera_moves, two_plates
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.tracking.trackers.rigid_bodies import _costs, _gauss_newton
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody, track_poses
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion


def align(scene: Scene, k: int, t: int, R: np.ndarray, s: np.ndarray, iterations: int = 10) -> tuple[np.ndarray, ...]:
    """The pose of a plate in frame t, from one nearby."""
    uv, p = scene.some_pixels(k, 200, border=3), scene.pictures
    lightness = _costs.features_at(p.feature[0], uv.astype(np.float32))[:, 1].astype(float)
    found = _gauss_newton.align(
        scene.points(uv)[None], lightness[None], R[None], s[None], p.lightness(t), p.smooth[t], p.normal[t], p.K,
        iterations,
    )  # fmt: skip
    return found[0][0], found[1][0]


def off(scene: Scene, k: int, t: int, R: np.ndarray, s: np.ndarray) -> float:
    """Mean distance [m] of a plate's points from where they truly are."""
    points, truth = scene.points(scene.some_pixels(k, 200)), scene.motion(k)
    return float(np.linalg.norm(points @ (R - truth.R[t]).T + (s - truth.t[t]), axis=1).mean())


@settings(max_examples=examples(20), deadline=None, derandomize=True)
@given(
    turn=st.lists(st.floats(-0.02, 0.02), min_size=3, max_size=3),
    shift=st.lists(st.floats(-0.004, 0.004), min_size=3, max_size=3),
    k=st.sampled_from([1, 2]),
    t=st.integers(1, FRAMES - 1),
)
def test_alignment_mends_a_wrong_pose(turn: list[float], shift: list[float], k: int, t: int) -> None:
    scene = two_plates()
    truth, center = scene.motion(k), scene.plates[k].t[t]
    R = Rotation.from_rotvec(turn).as_matrix()
    wrong = R @ truth.R[t], R @ (truth.t[t] - center) + center + shift
    assert off(scene, k, t, *align(scene, k, t, *wrong)) < max(0.0015, 0.3 * off(scene, k, t, *wrong))


def test_a_right_pose_stays() -> None:
    scene, t = two_plates(), 8
    truth = scene.motion(1)
    R, s = align(scene, 1, t, truth.R[t], truth.t[t])
    assert off(scene, 1, t, R, s) < 0.001
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def test_a_body_that_is_nowhere_in_the_picture_is_left_alone() -> None:
    scene = two_plates()
    away = np.array([5.0, 0, 0])
    R, s = align(scene, 1, 3, np.eye(3), away)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(s, away)


def body(scene: Scene, k: int, motion: RigidMotion | None = None) -> RigidBody:
    frames = len(scene.pictures)
    guess = motion or RigidMotion.identity(frames)
    return RigidBody(scene.pixels(k), guess, np.full(frames, motion is not None))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_bodies_are_tracked_without_a_guess(noise: float) -> None:
    scene = two_plates(noise)
    found = track_poses(scene.pictures, [body(scene, 2), body(scene, 1)], np.random.default_rng(0))
    for k, one in zip((2, 1), found, strict=True):
        np.testing.assert_array_equal(one.pixels, scene.pixels(k))
        np.testing.assert_array_equal(one.motion.R[0], np.eye(3))
        worst = max(off(scene, k, t, one.motion.R[t], one.motion.t[t]) for t in range(FRAMES))
        assert worst < 0.003 + noise, k


@cache
def leap() -> Scene:
    """A plate that jumps by 12 cm and turns by 30 degrees, farther than is searched for."""
    plate = moving_planes.moving((0.24, 0.26), (-0.15, 0, 0.8), np.array([0.004, 0, 0]), np.zeros(3), 12, 1)
    jump = 0.12 * (np.arange(12) >= 7)[:, None] * np.array([1.0, 0.3, 0])
    turn = Rotation.from_rotvec(np.radians(30) * (np.arange(12) >= 7)[:, None] * np.array([0, 0, 1.0])).as_matrix()
    return scene([moving_planes.wall(1.2, 12), moving_planes.Plate(plate.size, turn, plate.t + jump, 1)])


def landing_error(found: RigidBody) -> float:
    """How far the plate's points are from where they truly are right after the jump [m]."""
    return off(leap(), 1, 7, found.motion.R[7], found.motion.t[7])


def test_a_guess_leads_over_a_leap() -> None:
    """Optical flow would find it, too; here there is none."""
    seen, rng = leap(), np.random.default_rng(0)
    pictures = replace(seen.pictures, flow=np.zeros_like(seen.pictures.flow))
    (alone,) = track_poses(pictures, [body(seen, 1)], rng)
    (led,) = track_poses(pictures, [body(seen, 1, seen.motion(1))], rng)
    assert landing_error(led) < 0.003
    assert landing_error(alone) > 0.03


def test_a_lost_body_is_held_by_one_that_is_not() -> None:
    """A label on the plate loses it at the leap, for which the plate has a guess."""
    seen, rng = leap(), np.random.default_rng(0)
    label = RigidBody(seen.some_pixels(1, 60, border=12), RigidMotion.identity(12), np.zeros(12, bool))
    (alone,) = track_poses(seen.pictures, [label], rng)
    _, held = track_poses(seen.pictures, [body(seen, 1, seen.motion(1)), label], rng)
    assert landing_error(alone) > 0.03
    assert landing_error(held) < 0.006


def test_a_moving_camera_moves_the_wall() -> None:
    scene = still_camera_moves()
    (found,) = track_poses(scene.pictures, [body(scene, 0)], np.random.default_rng(0))
    assert off(scene, 0, FRAMES - 1, found.motion.R[-1], found.motion.t[-1]) < 0.006


def test_no_bodies_are_no_work() -> None:
    assert track_poses(two_plates().pictures, [], np.random.default_rng(0)) == []
