"""Motions proposed by trajectories that follow known motions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body_scenes import FRAMES, two_plates
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.tracking.trackers.rigid_bodies.proposals import MIN_SEEDS, Trajectories, propose_motions, track_seeds
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion


def motion(seed: int, frames: int = 20, still: bool = False) -> RigidMotion:
    """A screw motion of some centimeters."""
    rng = np.random.default_rng(seed)
    steps = np.arange(frames)[:, None] * (not still)
    R = Rotation.from_rotvec(steps * rng.normal(0, 0.02, 3)).as_matrix()
    return RigidMotion(R, steps * rng.normal(0, 0.006, 3))


def trajectories(motions: list[RigidMotion], sizes: list[int], strays: int = 0, seed: int = 0) -> Trajectories:
    """Points around a place of their own for each motion, and some that go where they want."""
    rng = np.random.default_rng(seed)
    parts = [
        m.apply(rng.normal([0.3 * k, 0, 1], 0.04, (n, 3))) for k, (m, n) in enumerate(zip(motions, sizes, strict=True))
    ]
    frames = len(parts[0])
    astray = rng.normal([0.1, 0, 1], 0.2, (1, strays, 3)) + rng.normal(0, 0.02, (frames, strays, 3)).cumsum(0)
    xyz = np.concatenate([*parts, astray], 1)
    xyz += rng.normal(0, 0.001, xyz.shape)
    pixels = np.stack([np.arange(xyz.shape[1]), np.zeros(xyz.shape[1])], 1).astype(np.int32)
    return Trajectories(pixels, xyz, np.ones(xyz.shape[:2], bool), np.broadcast_to(xyz[:1], xyz.shape))


@settings(max_examples=examples(15), deadline=None, derandomize=True)
@given(st.integers(0, 1000))
def test_each_motion_is_proposed_once_with_all_who_follow_it(seed: int) -> None:
    truth = [motion(seed), motion(seed + 1001)]
    paths = trajectories(truth, [60, 40], strays=20, seed=seed)
    found = propose_motions(paths, 10, np.random.default_rng(0))
    assert len(found) >= 2
    for members, true in ((range(60), truth[0]), (range(60, 100), truth[1])):
        (best,) = (p for p in found if np.isin(p.pixels[:, 0], members).mean() > 0.5)
        assert len(best.pixels) >= 0.95 * len(members)
        xyz = paths.xyz_cam[0, list(members)]
        error = np.linalg.norm(best.motion.apply(xyz) - true.apply(xyz), axis=-1)
        assert error.max() < 0.006
        assert best.known.all()


def test_the_best_supported_is_proposed_first_and_no_more_than_asked_for() -> None:
    paths = trajectories([motion(1), motion(2), motion(3)], [20, 80, 40])
    found = propose_motions(paths, 2, np.random.default_rng(0))
    assert [len(p.pixels) for p in found] == [80, 40]


def test_few_or_unrelated_trajectories_prove_nothing() -> None:
    few = trajectories([motion(1)], [MIN_SEEDS - 1])
    assert propose_motions(few, 10, np.random.default_rng(0)) == []
    unrelated = trajectories([motion(1)], [0], strays=60)
    assert propose_motions(unrelated, 10, np.random.default_rng(0)) == []


def test_frames_in_which_most_were_lost_are_not_known() -> None:
    paths = trajectories([motion(1)], [40])
    paths.known[12:, 4:] = False
    (found,) = propose_motions(paths, 10, np.random.default_rng(0))
    np.testing.assert_array_equal(found.known, np.arange(20) < 12)


def test_seeds_are_tracked_and_lifted() -> None:
    scene = two_plates()
    for k in (0, 1, 2):
        pixels = scene.some_pixels(k, 60, border=8)
        paths = track_seeds(scene.pictures, pixels, np.random.default_rng(0))
        np.testing.assert_array_equal(paths.pixels, pixels)
        truth = scene.motion(k).apply(scene.points(pixels))
        error = np.linalg.norm(paths.xyz_cam - truth, axis=-1)
        assert paths.known[0].all()
        assert paths.known[FRAMES // 2].mean() > 0.6, k
        assert np.median(error[paths.known]) < 0.006, k


def test_no_more_seeds_are_tracked_than_are_of_use() -> None:
    scene = two_plates()
    pixels = scene.pixels(0)
    assert len(pixels) > 2000
    paths = track_seeds(scene.pictures, pixels, np.random.default_rng(0))
    assert len(paths.pixels) == 1000
    assert len(np.unique(paths.pixels, axis=0)) == 1000
