"""Lucas-Kanade on pictures whose motion is exactly known: sliding, turning, covered, leaving, blank."""

import cv2
import numpy as np
import pytest

from flowlab.geometry.camera import Camera
from flowlab.records import Clip, Tracks2D
from flowlab.testing.trackers import FRAMES, rolling
from flowlab.tracking.trackers.lucas_kanade import LucasKanade

RNG = np.random.default_rng(0)
TEXTURE = cv2.GaussianBlur(RNG.integers(0, 256, (128, 192, 3)).astype(np.float32), (0, 0), 1.5)
TEXTURE = ((TEXTURE - TEXTURE.mean()) * 4 + 128).clip(0, 255).astype(np.uint8)
GRID = np.stack(np.meshgrid(np.arange(24, 100, 12), np.arange(24, 80, 11)), -1).reshape(-1, 2).astype(np.float32)


def clip_of(rgb: np.ndarray) -> Clip:
    height, width = rgb.shape[1:3]
    camera = Camera(width, height, np.array([[150.0, 0, width / 2], [0, 150, height / 2], [0, 0, 1]]), np.eye(4))
    return Clip(np.ascontiguousarray(rgb), np.ones(rgb.shape[:3], np.float32), camera)


def sliding(frames: int, dx: int, dy: int) -> Clip:
    """A window of 124 x 100 pixels that slides over the texture: its content moves by (-dx, -dy) a frame."""
    return clip_of(np.stack([TEXTURE[dy * t : dy * t + 100, dx * t : dx * t + 124] for t in range(frames)]))


def covered(frames: int, hidden: range) -> Clip:
    """The texture at rest, and in frames ``hidden`` another one in front of its left half."""
    rgb = np.repeat(TEXTURE[None, :100, :124], frames, 0)
    rgb[hidden.start : hidden.stop, :, :62] = TEXTURE[28:128, 110:172]
    return clip_of(rgb)


def track(clip: Clip, xy: np.ndarray = GRID, t: int = 0, **options: float) -> Tracks2D:
    queries = np.insert(xy, 0, t, axis=1).astype(np.float32)
    return LucasKanade(**options).open(clip).track(queries, 0, len(clip))


def error(tracks: Tracks2D, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(tracks.xy - truth, axis=-1)


@pytest.mark.parametrize(("dx", "dy"), [(3, 2), (1, 0), (0, 1), (5, 2)])
def test_a_sliding_plane_is_followed_to_a_twentieth_of_a_pixel(dx: int, dy: int) -> None:
    clip = sliding(9, dx, dy)
    truth = GRID - np.arange(9)[:, None, None] * (dx, dy)
    there = (truth > 10).all((0, 2))
    tracks = track(clip, GRID[there])
    assert there.sum() > 8
    assert error(tracks, truth[:, there]).max() < 0.05
    assert tracks.visible.all()
    assert tracks.confidence.min() > 0.95
    assert tracks.forward_backward is not None
    assert 0 <= tracks.forward_backward.min() <= tracks.forward_backward.max() < 0.05


def test_a_turning_plane_is_followed_to_half_a_pixel() -> None:
    xy = GRID[GRID[:, 1] < 80] + np.float32(0.3)
    truth = rolling().move(xy, 0, np.arange(FRAMES)[:, None])
    inside = ((truth > 12) & (truth < (180, 116))).all((0, 2))
    tracks = track(rolling().clip, xy[inside])
    assert np.median(error(tracks, truth[:, inside])[-1]) < 0.5
    assert tracks.visible.mean() > 0.95


def test_points_are_followed_from_their_own_frames_on() -> None:
    alone = track(sliding(9, 2, 1), GRID, t=4)
    session = LucasKanade().open(sliding(9, 2, 1))
    queries = np.concatenate([np.insert(GRID, 0, t, axis=1) for t in (0, 4)]).astype(np.float32)
    both = session.track(queries, 0, 9)
    np.testing.assert_array_equal(both.xy[:, len(GRID) :], alone.xy)
    assert not alone.visible[:4].any()
    assert alone.forward_backward is not None
    assert (alone.forward_backward[:4] == -1).all()
    np.testing.assert_array_equal(alone.xy[:5], np.broadcast_to(GRID, (5, *GRID.shape)))


def test_a_covered_point_is_lost_and_found_again_where_it_was() -> None:
    tracks = track(covered(12, range(4, 9)))
    hidden, still = GRID[:, 0] < 46, GRID[:, 0] > 78  # the window reaches 10 pixels to the side
    assert tracks.visible[4:9, hidden].mean() < 0.2
    assert tracks.visible[9:, hidden].mean() > 0.9
    seen = tracks.visible[9:, hidden]
    assert error(tracks, GRID)[9:, hidden][seen].max() < 0.3
    assert tracks.confidence[4:9, hidden].mean() < 0.4
    assert tracks.visible[:, still].all()
    assert error(tracks, GRID)[:, still].max() < 0.3


def test_forward_backward_error_tells_good_from_bad() -> None:
    """A frame of another scene altogether leads nowhere, and back to somewhere else."""
    rgb = sliding(3, 1, 0).rgb.copy()
    rgb[2] = TEXTURE[28:, 60:184]
    tracks = track(clip_of(rgb))
    assert tracks.forward_backward is not None
    back = np.where(tracks.forward_backward < 0, np.inf, tracks.forward_backward)
    assert np.median(back[1]) < 0.05
    assert np.median(back[2]) > 10 * np.median(back[1])
    assert tracks.visible[2].mean() < 0.4


def test_points_that_leave_the_picture_are_not_visible_and_still_somewhere() -> None:
    clip = sliding(13, 5, 0)
    tracks = track(clip)
    gone = (GRID[:, 0] - 5 * np.arange(13)[:, None]) < -3
    assert gone.any()
    assert not tracks.visible[gone].any()
    assert np.isfinite(tracks.xy).all()
    assert ((tracks.xy >= 0) & (tracks.xy <= (123, 99))).all()


def test_a_blank_wall_is_nothing_to_be_sure_of() -> None:
    tracks = track(clip_of(np.full((4, 60, 80, 3), 128, np.uint8)), GRID[GRID.max(1) < 50])
    assert np.isfinite(tracks.xy).all()
    assert not tracks.visible[1:].any()
    assert (tracks.confidence[1:] == 0).all()
    assert tracks.forward_backward is not None
    assert (tracks.forward_backward[1:] == -1).all()


def test_noise_of_the_sensor_moves_points_by_little() -> None:
    clip, rng = sliding(9, 2, 1), np.random.default_rng(0)
    noisy = (clip.rgb + rng.normal(0, 4, clip.rgb.shape)).clip(0, 255).astype(np.uint8)
    truth = GRID - np.arange(9)[:, None, None] * (2, 1)
    assert np.median(error(track(clip_of(noisy)), truth)[-1]) < 0.2


def test_frames_are_let_go_when_they_are_behind() -> None:
    clip = sliding(12, 1, 1)
    session = LucasKanade().open(clip)
    for start in (0, 4, 8):
        session.track(np.insert(GRID, 0, start, axis=1).astype(np.float32), start, start + 4)
        assert set(session._gray) == set(range(start, start + 4))
