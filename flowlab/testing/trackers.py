"""Does a tracker keep its promises? Checks for authors of plug-ins, against a clip whose motion is exactly known.

In the tests of a plug-in::

    from flowlab.testing.trackers import CHECKS

    @pytest.mark.parametrize("check", CHECKS)
    def test_tracker(check):
        check(MyTracker)
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
from jaxtyping import Float, Num

from flowlab.geometry.camera import Camera
from flowlab.records import Clip, Tracks2D
from flowlab.testing.promises import require, require_words
from flowlab.tracking.base import Tracker

WIDTH, HEIGHT, FRAMES = 192, 128, 10
AXIS = np.array([60.0, -150.0])
"""Pixel of the optical axis, about which the camera rolls: off the picture, so that all of it moves sideways."""
ROLL = np.array([0.004, 0.0006])
"""Speed [rad per frame] and half the acceleration: a part of the clip cannot be taken for another."""
BIAS_PX = 0.25
"""Half of what a wrong convention of pixel centers makes."""
MEDIAN_PX = 1.0
SAME_PX = 0.01

_CHANNELS = {"xy": (2,), "xyz_cam": (3,)}
"""What fields of a record have besides frames and points."""

MakeTracker = Callable[[], Tracker]


@dataclass(frozen=True, slots=True)
class Rolling:
    """A camera that rolls about its optical axis before a curved, textured surface."""

    clip: Clip

    def move(
        self, xy: Num[np.ndarray, "*#batch 2"], start: np.ndarray | int, stop: np.ndarray | int
    ) -> Float[np.ndarray, "*out 2"]:
        """Where points (..., 2) of frame ``start`` are in frame ``stop``; exact, whatever their depth."""
        return _turn(xy, _angle(np.asarray(stop)) - _angle(np.asarray(start)))


def _angle(t: np.ndarray) -> np.ndarray:
    """How far the camera has rolled at frame t [rad]."""
    return t * ROLL[0] + t**2 * ROLL[1]


def _turn(xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) turned about the axis by an angle (...) [rad], x towards y."""
    dx, dy = np.moveaxis(xy - AXIS, -1, 0)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * dx - s * dy, s * dx + c * dy], -1) + AXIS


@cache
def rolling() -> Rolling:
    """The clip of all checks. Every pixel is computed at its center from plane waves, nothing is interpolated."""
    rng = np.random.default_rng(0)
    angle, length = rng.uniform(0, np.pi, 24), rng.uniform(7, 40, 24)
    wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    phase, strength = rng.uniform(0, 2 * np.pi, 24), rng.normal(size=(24, 3))
    v, u = np.indices((HEIGHT, WIDTH))
    pixel = np.stack([u, v], -1)
    rgb, depth = np.empty((FRAMES, HEIGHT, WIDTH, 3), np.uint8), np.empty((FRAMES, HEIGHT, WIDTH), np.float32)
    for t in range(FRAMES):
        origin = _turn(pixel, -_angle(np.asarray(t)))
        light = np.cos(origin @ wave + phase) @ strength
        rgb[t] = (128 + 10 * light).clip(0, 255).round()
        depth[t] = 1 + 0.1 * np.sin(origin[..., 0] / 30) * np.cos(origin[..., 1] / 25)
    K = np.array([[200.0, 0, AXIS[0]], [0, 200, AXIS[1]], [0, 0, 1]])
    return Rolling(Clip(rgb, depth, Camera(WIDTH, HEIGHT, K, np.eye(4))))


def check_tracker(make: MakeTracker) -> None:
    """Raise an AssertionError that says which promise a tracker breaks. ``make`` makes it, as its class does."""
    for check in CHECKS:
        check(make)


def check_description(make: MakeTracker) -> None:
    """It has a name and a license, and describes itself in JSON."""
    tracker = make()
    require(isinstance(tracker, Tracker), f"it must be a Tracker, but is a {type(tracker).__name__}")
    require_words(tracker, "name", "license")
    try:
        json.dumps(tracker.describe())
    except TypeError as error:
        raise AssertionError(f"describe() must give JSON values only: {error}") from error


def check_record(make: MakeTracker) -> None:
    """Shapes, types and ranges are right, and nothing that was given is written into."""
    queries, clip = _queries(0), rolling().clip
    before = queries.copy(), clip.rgb.copy(), clip.depth.copy()
    _check_record(make().open(clip).track(queries, 0, FRAMES), FRAMES, len(queries))
    given = zip((queries, clip.rgb, clip.depth), before, strict=True)
    require(all(np.array_equal(a, b) for a, b in given), "queries and clip must not be written into")


def check_query_frame(make: MakeTracker) -> None:
    """At its own frame a point is where it was asked for, and visible; before it, held there and not visible."""
    queries = _queries(0, 4, 7)
    tracks = make().open(rolling().clip).track(queries, 0, FRAMES)
    _check_record(tracks, FRAMES, len(queries))
    off = np.abs(tracks.xy - queries[:, 1:]).max(-1)
    t, own = np.arange(FRAMES)[:, None], queries[:, 0]
    require(
        off[t == own].max() < SAME_PX,
        f"at the frame of its query a point must be where the query says, but is up to {off[t == own].max():.2f} px "
        "away; queries are (t, x, y), tracks (x, y), pixel centers integers",
    )
    require(tracks.visible[t == own].all(), "a point must be visible at the frame of its query")
    require(off[t < own].max() < SAME_PX, "before the frame of its query a point must be held where the query says")
    require(not tracks.visible[t < own].any(), "before the frame of its query a point must not be visible")


def check_motion(make: MakeTracker) -> None:
    """Points follow the picture, forth from their own frames: to the pixel, and without a shift."""
    for queries in (_queries(0), _queries(0, 2, 5)):
        _check_motion(make().open(rolling().clip).track(queries, 0, FRAMES), queries, 0)


def check_part(make: MakeTracker) -> None:
    """A part of a clip may be asked for, in any order: row k is frame ``start + k``."""
    session = make().open(rolling().clip)
    for start, stop in ((4, FRAMES), (2, 7), (3, 4)):
        queries = _queries(start, min(start + 1, stop - 1))
        tracks = session.track(queries, start, stop)
        _check_record(tracks, stop - start, len(queries))
        _check_motion(tracks, queries, start)


def check_repeatable(make: MakeTracker) -> None:
    """The same question has the same answer, in the same session and in another."""
    queries, session = _queries(0, 3), make().open(rolling().clip)
    first = session.track(queries, 0, FRAMES)
    for again in (session.track(queries, 0, FRAMES), make().open(rolling().clip).track(queries, 0, FRAMES)):
        same = np.abs(first.xy - again.xy).max() < SAME_PX and np.array_equal(first.visible, again.visible)
        require(same, "the same queries must be answered in the same way every time; seed whatever is random")


def check_no_queries(make: MakeTracker) -> None:
    """No points is a question, too."""
    _check_record(make().open(rolling().clip).track(np.empty((0, 3), np.float32), 0, FRAMES), FRAMES, 0)


def check_border(make: MakeTracker) -> None:
    """Points may lie in the corners, and leave the picture."""
    corners = np.array([[0, x, y] for x in (0, WIDTH - 1) for y in (0, HEIGHT - 1)], np.float32)
    tracks = make().open(rolling().clip).track(corners, 0, FRAMES)
    _check_record(tracks, FRAMES, len(corners))
    off = np.abs(tracks.xy[0] - corners[:, 1:]).max()
    require(off < SAME_PX, f"a query in a corner of the picture must stay there at its frame, but is {off:.2f} px away")


CHECKS: tuple[Callable[[MakeTracker], None], ...] = (
    check_description,
    check_record,
    check_query_frame,
    check_motion,
    check_part,
    check_repeatable,
    check_no_queries,
    check_border,
)
"""Every promise of :class:`~flowlab.tracking.base.Session`, one at a time."""


def _queries(*frames: int) -> np.ndarray:
    """Queries (M, 3), in turn in the given frames, of points that stay on the picture and off its border."""
    x, y = np.meshgrid(np.linspace(24, WIDTH - 24, 8), np.linspace(24, HEIGHT - 24, 5))
    txy = np.stack([np.resize(frames, x.size), x.ravel(), y.ravel()], 1).astype(np.float32)
    path = rolling().move(txy[:, 1:], txy[:, 0], np.arange(FRAMES)[:, None])
    return txy[((path > 16) & (path < (WIDTH - 17, HEIGHT - 17))).all((0, 2))]


def _check_record(tracks: Tracks2D, frames: int, points: int) -> None:
    """Require shapes, types and ranges of a record."""
    require(isinstance(tracks, Tracks2D), f"track() must return a Tracks2D, but returns a {type(tracks).__name__}")
    for field in fields(Tracks2D):
        value = getattr(tracks, field.name)
        if value is None and field.default is None:
            continue
        dtype = np.dtype(bool if field.name == "visible" else np.float32)
        shape = (frames, points, *_CHANNELS.get(field.name, ()))
        require(isinstance(value, np.ndarray), f"{field.name} must be a numpy array, but is a {type(value).__name__}")
        require(value.dtype == dtype, f"{field.name} must be {dtype}, but is {value.dtype}")
        require(value.shape == shape, f"{field.name} must have shape {shape}, but has {value.shape}")
        require(np.isfinite(value).all(), f"{field.name} must be finite, also where a point is lost")
    sure = tracks.confidence
    require(((sure >= 0) & (sure <= 1)).all(), "confidence must lie between 0 and 1")
    _check_positions(tracks)


def _check_positions(tracks: Tracks2D) -> None:
    """What a model says in 3D is what the tracks say in the picture."""
    if tracks.xyz_cam is None:
        return
    placed = (tracks.xyz_cam != 0).any(-1)
    require(
        (tracks.xyz_cam[placed][:, 2] > 0).all(),
        "xyz_cam must lie before the camera, z forward [m], or be (0, 0, 0) where no position is known",
    )
    uv, _ = rolling().clip.camera.project(tracks.xyz_cam[placed].astype(np.float64))
    off = np.linalg.norm(uv - tracks.xy[placed], axis=-1)[tracks.visible[placed]]
    median = float(np.median(off)) if len(off) else 0.0
    require(
        median < MEDIAN_PX,
        f"xyz_cam must project to xy, but is {median:.2f} px away; it is in the camera frame [m]: x right, y down, "
        "z forward",
    )


def _check_motion(tracks: Tracks2D, queries: np.ndarray, start: int) -> None:
    """Require that points are where the picture went."""
    t = start + np.arange(len(tracks.xy))[:, None]
    after = t > queries[:, 0]
    if not after.any():
        return
    truth = rolling().move(queries[:, 1:], queries[:, 0], t)
    error = (tracks.xy - truth)[after]
    median = float(np.median(np.linalg.norm(error, axis=-1)))
    swapped = float(np.median(np.linalg.norm((tracks.xy[..., ::-1] - truth)[after], axis=-1)))
    hint = "; x and y are swapped" if swapped < median / 4 else "; queries are (t, x, y), tracks (x, y)"
    require(median < MEDIAN_PX, f"half of the points are more than {median:.2f} px from where they should be{hint}")
    bias = np.median(error, axis=0)
    require(
        np.abs(bias).max() < BIAS_PX,
        f"points are shifted by ({bias[0]:+.2f}, {bias[1]:+.2f}) px; the center of the first pixel is (0, 0)",
    )
    seen = float(tracks.visible[after].mean())
    require(seen > 0.8, f"all points are in sight, but only {seen:.0%} of them are visible")
