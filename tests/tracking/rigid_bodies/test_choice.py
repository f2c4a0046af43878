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
def speckled() -> tuple[Scene, np.ndarray, list[RigidMotion]]:
    """Points of a plate that look otherwise in the first picture than later, so that to be hidden costs hardly more
    than to be seen; how the plate moves, and a motion that takes it behind the rest, where nothing can contradict."""
    base = two_plates()
    uv = base.some_pixels(1, 12, border=10)
    rgb = base.clip.rgb.copy()
    for u, v in uv:
        rgb[0, v - 1 : v + 2, u - 1 : u + 2] = 0.62 * rgb[0, v, u] + 0.38 * np.array([255, 0, 255])
    clip = Clip(rgb, base.clip.depth, base.clip.camera)
    seen, true = Scene(base.plates, clip, base.owner, extract_features(clip, 4.0)), base.motion(1)
    back = np.where(np.arange(FRAMES) > 0, 0.15, 0)[:, None] * [0, 0, 1.0]
    return seen, uv, [true, RigidMotion(true.R, true.t + back)]


HIDDEN, UNEXPLAINED = 0.6 + 0.08, 0.62
"""What it costs to be taken away and hidden in all frames, and a cost at which the pictures alone no longer tell."""


def test_a_point_that_nothing_explains_goes_where_it_was_followed(
    speckled: tuple[Scene, np.ndarray, list[RigidMotion]],
) -> None:
    seen, uv, motions = speckled
    for k in (1, 2):
        found = choice(seen, uv, motions, motions[k - 1].apply(seen.points(uv)))
        assert (found.motion == k)[found.cost > UNEXPLAINED].all()
        assert (found.cost > UNEXPLAINED).sum() > 2


def test_a_point_that_was_hardly_followed_is_judged_by_the_pictures_alone(
    speckled: tuple[Scene, np.ndarray, list[RigidMotion]],
) -> None:
    seen, uv, motions = speckled
    path, frame = motions[1].apply(seen.points(uv)), np.arange(FRAMES)[:, None]
    alone, hardly, enough = (choice(seen, uv, motions, path, frame <= n) for n in (-1, 2, 3))
    np.testing.assert_array_equal(hardly.against, alone.against)  # the first frame is the question, no answer
    assert (enough.against > alone.against).any()


def test_a_point_that_nothing_explains_goes_with_what_is_around_it(
    speckled: tuple[Scene, np.ndarray, list[RigidMotion]],
) -> None:
    seen, uv, motions = speckled
    found = choice(seen, uv, motions, motions[1].apply(seen.points(uv)), believed=False)
    assert (found.motion == 1).mean() > 0.9
    unexplained = found.cost > UNEXPLAINED
    assert unexplained.sum() > 2
    assert (found.against[2, unexplained] > HIDDEN + 0.005).all()


def test_what_the_pictures_explain_does_not_go_where_it_was_followed() -> None:
    seen = two_plates()
    uv = seen.some_pixels(1, 40, border=4)
    motions = [seen.motion(1), seen.motion(2)]
    apart, along = (choice(seen, uv, motions, m.apply(seen.points(uv))) for m in motions)
    explained = apart.cost < 0.5
    assert explained.mean() > 0.9
    np.testing.assert_array_equal(apart.against[:, explained], along.against[:, explained])


def test_what_a_motion_explains_stays_with_it_whatever_is_around() -> None:
    """A plate's border, next to the other things that are near it."""
    seen = two_plates()
    uv = seen.some_pixels(1, 60, border=2)
    path = seen.motion(1).apply(seen.points(uv))
    found = choice(seen, uv, [seen.motion(1), seen.motion(2)], path, believed=False)
    assert (found.motion == 1).mean() > 0.95


@pytest.mark.parametrize("seed", [1, 4])
def test_the_border_of_a_card_that_slides_on_a_table_goes_with_it(seed: int) -> None:
    """Of depth nothing tells it from the table, which stands still all around and has the mean color of the border."""
    card = moving_planes.moving(
        (0.3, 0.22), (-0.12, 0, 0.999), np.array([0.012, 0.002, 0]), np.array([0, 0, 0.01]), FRAMES, seed
    )
    seen = scene([moving_planes.wall(1.0, FRAMES), card], noise=0.001)
    border = seen.owner == 1
    border[tuple(seen.pixels(1, 1).T[::-1])] = False
    uv = np.argwhere(border)[:, ::-1].astype(np.int32)
    found = choice(seen, uv, [seen.motion(1)], np.zeros((FRAMES, len(uv), 3)), believed=False)
    assert (found.motion == 1).mean() > 0.95
