"""What is taken along is told from what is only hidden, against scenes whose motion is known."""

from functools import cache

import moving_planes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body_scenes import Scene, scene
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.tracking.trackers.rigid_bodies.assignment import CellCosts, assign
from flowlab.tracking.trackers.rigid_bodies.attachment import attach, attached_bodies
from flowlab.tracking.trackers.rigid_bodies.bodies import new_body
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import segment_motion
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion

FRAMES, TAKEN, LET_GO = 30, 9, 22
REACH = np.array([0.0, -0.16, 0.0])
"""From where a hand ends to where it begins [m]."""


def hand_places() -> np.ndarray:
    """Where a hand is (T, 3) [m]: it comes down on a thing, goes to the right with it, and up again alone."""
    place = np.tile([-0.12, 0.02, 0.74], (FRAMES, 1))
    coming = np.arange(TAKEN + 1)
    place[coming] += REACH * (1 - coming / TAKEN)[:, None]
    moving = np.arange(TAKEN, LET_GO + 1)
    place[moving, 0] += 0.24 * (moving - TAKEN) / (LET_GO - TAKEN)
    place[LET_GO:] = place[LET_GO] + REACH * (np.arange(FRAMES - LET_GO) / (FRAMES - 1 - LET_GO))[:, None]
    return place


@cache
def taken_by_a_hand(along: bool, noise: float) -> Scene:
    """A thing that a hand hides for the most part, and takes along or not."""
    turns, hand = np.tile(np.eye(3), (FRAMES, 1, 1)), hand_places()
    thing = np.tile([-0.12, 0.06, 0.80], (FRAMES, 1))
    if along:
        thing += np.where(np.arange(FRAMES)[:, None] <= LET_GO, hand - hand[TAKEN], hand[LET_GO] - hand[TAKEN])
        thing[:TAKEN] = thing[TAKEN]
    plates = [moving_planes.Plate((0.11, 0.11), turns, thing, 1), moving_planes.Plate((0.16, 0.12), turns, hand, 2)]
    return scene([moving_planes.wall(1.2, FRAMES), *plates], noise)


def attached_thing(seen: Scene) -> RigidMotion | None:
    """How the thing was found to be taken along, from the hand's true motion and a thing that stands still."""
    grid = segment_motion(seen.pictures)
    hand = RigidBody(seen.pixels(2), seen.motion(2), np.ones(FRAMES, bool))
    thing = new_body(seen.pictures, grid, grid.valid & (seen.owner_of_cell == 1))
    bodies = [hand, thing]
    found = attached_bodies(
        seen.pictures, grid, bodies, assign(CellCosts(seen.pictures, grid), [b.motion for b in bodies])
    )
    cells = seen.owner_of_cell == 1
    of_it = [b for b in found if b.region is not None and cells[b.region].mean() > 0.9]
    return of_it[0].motion if of_it else None


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_what_a_hand_hides_and_takes_along_goes_with_it_and_rests_where_it_is_put(noise: float) -> None:
    seen = taken_by_a_hand(True, noise)
    found = attached_thing(seen)
    assert found is not None
    points = seen.points(seen.some_pixels(1, 60))
    off = np.linalg.norm(found.apply(points) - seen.motion(1).apply(points), axis=-1).mean(1)
    assert off.max() < 0.02
    assert off[-1] < 0.012  # where it rests tells when it was let go
    np.testing.assert_allclose(found.apply(points)[:TAKEN], points[None].repeat(TAKEN, 0), atol=0.006)


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_what_a_hand_only_hides_is_left_where_it_is(noise: float) -> None:
    assert attached_thing(taken_by_a_hand(False, noise)) is None


def motions(seed: int) -> RigidMotion:
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.2, (12, 3)), 0)).as_matrix()
    t = np.cumsum(rng.normal(0, 0.1, (12, 3)), 0)
    return RigidMotion(R @ R[0].T, t - (R @ R[0].T) @ t[0])


@settings(max_examples=examples(30), deadline=None, derandomize=True)
@given(seeds=st.tuples(st.integers(0, 99), st.integers(100, 199)), frame=st.integers(0, 11))
def test_what_is_attached_stays_where_it_is_on_what_holds_it(seeds: tuple[int, int], frame: int) -> None:
    before, after = map(motions, seeds)
    motion, points = attach(before, after, frame), np.random.default_rng(0).normal(0, 1, (5, 3))
    path = motion.apply(points)
    np.testing.assert_allclose(path[: frame + 1], before.apply(points)[: frame + 1], atol=1e-12)
    held = np.einsum("tji,tnj->tni", after.R, path - after.t[:, None])  # in the frame of what holds it
    np.testing.assert_allclose(held[frame:], held[frame : frame + 1].repeat(12 - frame, 0), atol=1e-9)
    np.testing.assert_allclose(motion.R @ motion.R.swapaxes(1, 2), np.eye(3)[None].repeat(12, 0), atol=1e-9)
