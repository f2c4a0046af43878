"""A body that leaves and comes back is found again where it truly is, and nothing else is taken for it."""

from functools import cache

import moving_planes
import numpy as np
import pytest
from rigid_body_scenes import Scene, scene
from scipy.spatial.transform import Rotation

from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody, track_poses
from flowlab.tracking.trackers.rigid_bodies.recovery import LastSeen
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

FRAMES, GONE, BACK = 18, slice(8, 13), slice(14, 18)
SIZE, START = (0.2, 0.2), np.array([-0.1, 0.0, 0.8])
OUT_OF_VIEW = np.array([-5.0, 0, 0.8])


def plate(t: np.ndarray, seed: int, turn: float = 0.0) -> moving_planes.Plate:
    """A plate at places (T, 3) [m], turned by so much [rad] once it is back."""
    angle = np.where(np.arange(FRAMES) >= BACK.start, turn, 0)[:, None] * np.array([0, 0, 1.0])
    return moving_planes.Plate(SIZE, Rotation.from_rotvec(angle).as_matrix(), t, seed)


def leaving(end: np.ndarray) -> np.ndarray:
    """The places of a plate that slides out of the picture, is away, and comes back at another place."""
    t = np.tile(START, (FRAMES, 1))
    t[: GONE.start, 0] -= 0.06 * np.arange(GONE.start)
    t[GONE.start : BACK.start] = OUT_OF_VIEW
    t[BACK] = end
    return t


def followed(seen: Scene) -> RigidMotion:
    """How the first plate before the wall was found to move."""
    body = RigidBody(seen.pixels(1), RigidMotion.identity(FRAMES), np.zeros(FRAMES, bool))
    return track_poses(seen.pictures, [body], np.random.default_rng(0))[0].motion


def errors(seen: Scene, found: RigidMotion) -> np.ndarray:
    """Mean distance (T,) [m] of the plate's points from where they truly are."""
    points = seen.points(seen.some_pixels(1, 100))
    return np.asarray(np.linalg.norm(found.apply(points) - seen.motion(1).apply(points), axis=-1).mean(1))


@cache
def comes_back(turn: float, noise: float) -> Scene:
    end = START + np.array([0.25, 0.1, -0.1])
    return scene([moving_planes.wall(1.2, FRAMES), plate(leaving(end), 1, turn)], noise)


@pytest.mark.parametrize(("turn", "noise"), [(0.0, 0.0), (0.06, 0.002)])
def test_what_comes_back_elsewhere_is_found_there(turn: float, noise: float) -> None:
    seen = comes_back(turn, noise)
    assert errors(seen, followed(seen))[BACK].max() < 0.006


def test_something_else_that_comes_is_not_taken_for_it() -> None:
    """Another plate comes where nothing was, while the body stays away."""
    newcomer = np.tile(OUT_OF_VIEW, (FRAMES, 1))
    newcomer[BACK] = START + np.array([0.25, 0.1, -0.1])
    seen = scene([moving_planes.wall(1.2, FRAMES), plate(leaving(OUT_OF_VIEW), 1), plate(newcomer, 2)])
    away = np.linalg.norm(followed(seen).apply(START[None])[:, 0] - newcomer, axis=1)
    assert away[BACK].min() > 0.15


def test_its_twin_that_stood_there_from_the_start_is_not_taken_for_it() -> None:
    twin = np.tile(START + np.array([0.3, 0.1, 0.05]), (FRAMES, 1))
    seen = scene([moving_planes.wall(1.2, FRAMES), plate(leaving(OUT_OF_VIEW), 1), plate(twin, 1)])
    away = np.linalg.norm(followed(seen).apply(START[None])[:, 0] - twin, axis=1)
    assert away[BACK].min() > 0.15


@pytest.mark.parametrize("leap", [0.16, 0.3])
def test_what_leaps_from_one_picture_to_the_next_is_found(leap: float) -> None:
    there = START + np.where(np.arange(FRAMES) > 8, leap, 0)[:, None] * np.array([1.0, 0.2, 0])
    seen = scene([moving_planes.wall(1.2, FRAMES), plate(there, 1)])
    assert errors(seen, followed(seen)).max() < 0.006


def test_a_lost_body_is_looked_for_as_far_away_as_it_may_have_come_before_a_camera_that_moves() -> None:
    middle, frames = np.array([0.1, 0.0, 4.0]), np.arange(9)
    still = RigidMotion(np.tile(np.eye(3), (9, 1, 1)), frames[:, None] * np.array([-0.5, 0, 0]))
    last = LastSeen.at_first(2)
    last.update(np.array([False, True]), 3, np.tile(np.eye(3), (2, 1, 1)), np.tile([-1.0, 0, 0], (2, 1)))
    rested = middle - np.array([1.0 + 0.5 * 2, 0, 0])  # the camera went on for two frames
    far = np.array([[0, 1.19, 0], [1.19, 0, 0], [0, 1.21, 0], [-3.0, 0, 0]])
    np.testing.assert_allclose(last.within_reach(1, 5, middle, still, rested + far), (rested + far)[:2])


class PlainPlate(moving_planes.Plate):
    """A plate of one color."""

    def texture(self) -> np.ndarray:
        return np.full((8, 8, 3), (60, 120, 200), np.float32)


def test_what_is_far_too_small_to_look_as_it_did_is_not_taken_for_it() -> None:
    """A room of its color is seen three times as far away, where few pixels would show it, and any would do."""
    turn = np.tile(np.eye(3), (FRAMES, 1, 1))
    far = np.tile(OUT_OF_VIEW, (FRAMES, 1))
    far[BACK] = 3 * (START + np.array([0.25, 0.1, 0.0]))
    body, room = PlainPlate(SIZE, turn, leaving(OUT_OF_VIEW), 1), PlainPlate((1.2, 1.2), turn, far, 1)
    seen = scene([moving_planes.wall(4.0, FRAMES), body, room])
    assert followed(seen).apply(START[None])[BACK, 0, 2].max() < 1.7
