"""Which motion carries a point, where the pictures alone would not tell, or tell it wrong."""

import moving_planes
import numpy as np
import pytest
from rigid_body_scenes import FRAMES, Scene, fit_of, scene, two_plates

from flowlab.records import Clip
from flowlab.tracking.trackers.rigid_bodies.choice import FollowedPoints, MotionChoice, choose_motions
from flowlab.tracking.trackers.rigid_bodies.features import extract_features
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion


def choice(
    seen: Scene, uv: np.ndarray, motions: list[RigidMotion], followed: np.ndarray, believed: np.ndarray | bool = True
) -> MotionChoice:
    fit, xyz = fit_of(seen, *motions), seen.points(uv)
    z = seen.pictures.depth[0, uv[:, 1], uv[:, 0]].astype(float)
    paths = np.stack([m.apply(xyz) for m in fit.motions])
    return choose_motions(fit, uv, z, paths, FollowedPoints(followed, np.broadcast_to(believed, followed.shape[:2])))


@pytest.fixture(scope="module")
def plain() -> Scene:
    """A plate without texture comes nearer before a wall without texture."""
    step = np.array([0, 0, -0.012])
    made = scene([
        moving_planes.wall(1.2, FRAMES),
        moving_planes.moving((0.4, 0.4), (0, 0, 1.0), step, np.zeros(3), FRAMES, 1),
    ])  # fmt: skip
    clip = Clip(np.full_like(made.clip.rgb, 128), made.clip.depth, made.clip.camera)
    return Scene(made.plates, clip, made.owner, extract_features(clip, 4.0))


def test_of_motions_that_look_alike_a_point_takes_the_one_along_which_it_was_followed(plain: Scene) -> None:
    straight = plain.motion(1)
    aside = np.linspace(0, 0.05, FRAMES)[:, None] * [1.0, 0, 0]
    sliding = RigidMotion(straight.R, straight.t + aside)
    uv = plain.some_pixels(1, 30, border=16)
    for k, motion in ((1, straight), (2, sliding)):
        path = motion.apply(plain.points(uv))
        found = choice(plain, uv, [straight, sliding], path)
        assert (found.motion == k).all()
        assert (found.cost < 0.25).all(), "what is elsewhere is no worse explained by the pictures"


def test_a_point_that_was_hardly_followed_is_judged_by_the_pictures_alone(plain: Scene) -> None:
    straight = plain.motion(1)
    sliding = RigidMotion(straight.R, straight.t + np.linspace(0, 0.05, FRAMES)[:, None] * [1.0, 0, 0])
    uv = plain.some_pixels(1, 30, border=16)
    path, frame = sliding.apply(plain.points(uv)), np.arange(FRAMES)[:, None]
    alone, hardly, enough = (choice(plain, uv, [straight, sliding], path, frame <= n) for n in (-1, 2, 3))
    np.testing.assert_array_equal(hardly.against, alone.against)  # the first frame is the question, no answer
    assert (enough.against > alone.against).any()


def test_a_point_that_nothing_explains_goes_with_what_is_around_it() -> None:
    """And not with a motion that takes it behind what is in front, where nothing can contradict."""
    base = two_plates()
    uv = base.some_pixels(1, 12, border=10)
    rgb = base.clip.rgb.copy()
    for u, v in uv:  # a speck in the first picture alone
        rgb[0, v - 1 : v + 2, u - 1 : u + 2] = 0.62 * rgb[0, v, u] + 0.38 * np.array([255, 0, 255])
    clip = Clip(rgb, base.clip.depth, base.clip.camera)
    seen = Scene(base.plates, clip, base.owner, extract_features(clip, 4.0))
    true = seen.motion(1)
    back = np.where(np.arange(FRAMES) > 0, 0.15, 0)[:, None] * [0, 0, 1.0]
    unseen = RigidMotion(true.R, true.t + back)
    still = np.broadcast_to(seen.points(uv), (FRAMES, len(uv), 3))
    found = choice(seen, uv, [true, unseen], still.copy(), believed=False)
    hidden = 0.6 + 0.08  # what it costs to be taken away and hidden in all frames
    assert (found.motion == 1).mean() > 0.9
    assert ((found.motion == 1) & (found.cost > hidden)).sum() > 2


def test_what_a_motion_explains_stays_with_it_whatever_is_around() -> None:
    """A plate's border, next to the other things that are near it."""
    seen = two_plates()
    uv = seen.some_pixels(1, 60, border=2)
    path = seen.motion(1).apply(seen.points(uv))
    found = choice(seen, uv, [seen.motion(1), seen.motion(2)], path, believed=False)
    assert (found.motion == 1).mean() > 0.95
