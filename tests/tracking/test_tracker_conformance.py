"""The shipped checks of trackers: ours keep every promise, and whoever breaks one is told which."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, ClassVar

import numpy as np
import pytest

from flowlab.errors import RecordError
from flowlab.records import Clip, Tracks2D
from flowlab.testing.trackers import CHECKS, HEIGHT, WIDTH, check_tracker, rolling
from flowlab.tracking.base import Session, Tracker
from flowlab.tracking.trackers.lucas_kanade import LucasKanade

Track = Callable[[Session, np.ndarray, int, int], Tracks2D]


@pytest.mark.parametrize("check", CHECKS)
def test_lucas_kanade_keeps_every_promise(check: Callable[[type[Tracker]], None]) -> None:
    check(LucasKanade)


def test_the_clip_of_the_checks_moves_as_it_says() -> None:
    """Color and depth at a point are those at the point's first pixel, wherever it has moved by whole pixels."""
    clip = rolling().clip
    assert WIDTH != HEIGHT
    v, u = np.mgrid[30 : HEIGHT - 30, 30 : WIDTH - 30].reshape(2, -1)
    there = rolling().move(np.stack([u, v], -1), 0, 8)
    whole = (np.abs(there - there.round()).max(-1) < 0.03) & (there > 0).all(-1) & (there < (WIDTH, HEIGHT)).all(-1)
    assert whole.sum() > 5
    x, y = there[whole].round().astype(int).T
    np.testing.assert_allclose(clip.depth[8, y, x], clip.depth[0, v[whole], u[whole]], atol=2e-4)
    np.testing.assert_allclose(clip.rgb[8, y, x], clip.rgb[0, v[whole], u[whole]].astype(int), atol=4)
    assert np.linalg.norm(there - np.stack([u, v], -1), axis=-1).min() > 8


def broken(track: Track, **attributes: Any) -> type[Tracker]:
    """A tracker that has got one thing wrong; what it would do right is Lucas-Kanade's."""

    class Broken(Tracker):
        name: ClassVar[str] = attributes.get("name", "broken")
        license: ClassVar[str] = attributes.get("license", "none")

        def open(self, clip: Clip) -> Session:
            return BrokenSession(LucasKanade().open(clip))

    class BrokenSession:
        def __init__(self, right: Session) -> None:
            self.right = right

        def track(self, queries_txy: np.ndarray, start: int, stop: int) -> Tracks2D:
            return track(self.right, queries_txy, start, stop)

    return Broken


def alter(change: Callable[[Tracks2D, np.ndarray, int], Tracks2D]) -> Track:
    """Wrong in what it returns."""
    return lambda right, queries, start, stop: change(right.track(queries, start, stop), queries, start)


def unchecked(tracks: Tracks2D, **changes: Any) -> Tracks2D:
    """The record with fields that our tests, but no plug-in's, would check when it is made."""
    changed = object.__new__(Tracks2D)
    for field in fields(Tracks2D):
        object.__setattr__(changed, field.name, changes.get(field.name, getattr(tracks, field.name)))
    return changed


def right(session: Session, queries: np.ndarray, start: int, stop: int) -> Tracks2D:
    return session.track(queries, start, stop)


def swapped_queries(session: Session, queries: np.ndarray, start: int, stop: int) -> Tracks2D:
    """Takes (t, y, x) and answers (y, x), as a thoughtless wrapper of tapnet would: all is well at the query."""
    tracks = session.track(queries[:, [0, 2, 1]], start, stop)
    return replace(tracks, xy=tracks.xy[..., ::-1].copy())


def shifted_after_query(tracks: Tracks2D, queries: np.ndarray, start: int) -> Tracks2D:
    after = start + np.arange(len(tracks.xy))[:, None] > queries[:, 0]
    return replace(tracks, xy=tracks.xy + np.float32(0.5) * after[..., None])


def seen_before_query(tracks: Tracks2D, queries: np.ndarray, start: int) -> Tracks2D:
    return replace(tracks, visible=np.ones_like(tracks.visible))


def lost_as_nan(tracks: Tracks2D, queries: np.ndarray, start: int) -> Tracks2D:
    outside = ((tracks.xy < 0) | (tracks.xy > (WIDTH - 1, HEIGHT - 1))).any(-1) | ~tracks.visible
    return replace(tracks, xy=np.where(outside[..., None], np.float32(np.nan), tracks.xy))


def behind(tracks: Tracks2D) -> np.ndarray:
    """Positions with z backward, as OpenGL has it."""
    return -in_pixels(tracks)


def in_pixels(tracks: Tracks2D) -> np.ndarray:
    """Pixels with depth, which are no positions."""
    return np.concatenate([tracks.xy, np.ones_like(tracks.xy[..., :1])], -1)


def late(session: Session, queries: np.ndarray, start: int, stop: int) -> Tracks2D:
    """Rows as if every clip began at frame 0."""
    return session.track(queries - np.float32([start, 0, 0]), 0, stop - start)


def random(tracks: Tracks2D, queries: np.ndarray, start: int) -> Tracks2D:
    after = start + np.arange(len(tracks.xy))[:, None] > queries[:, 0]
    noise = np.random.default_rng().normal(scale=0.1, size=tracks.xy.shape) * after[..., None]
    return replace(tracks, xy=(tracks.xy + noise).astype(np.float32))


def refuses_nothing(session: Session, queries: np.ndarray, start: int, stop: int) -> Tracks2D:
    if len(queries) == 0:
        raise IndexError("no points")
    return session.track(queries, start, stop)


def writes_into_queries(session: Session, queries: np.ndarray, start: int, stop: int) -> Tracks2D:
    tracks = session.track(queries, start, stop)
    queries[:, 1:] += 1
    return tracks


def pulls_inside(session: Session, queries: np.ndarray, start: int, stop: int) -> Tracks2D:
    inside = queries.copy()
    inside[:, 1:] = inside[:, 1:].clip(8, (WIDTH - 9, HEIGHT - 9))
    return session.track(inside, start, stop)


@pytest.mark.parametrize(
    ("track", "message"),
    [
        (swapped_queries, "half of the points are more than .* px from where they should be"),
        (
            alter(lambda k, q, s: replace(k, xy=k.xy[..., ::-1].copy())),
            r"where the query says, .* queries are \(t, x, y\)",
        ),
        (alter(shifted_after_query), r"points are shifted by \(\+0\.\d+, \+0\.\d+\) px; the center of the first pixel"),
        (
            alter(lambda k, q, s: replace(k, xy=k.xy + np.float32(0.5))),
            "at the frame of its query .* up to 0.50 px away",
        ),
        (alter(lambda k, q, s: unchecked(k, xy=k.xy.astype(float))), "xy must be float32, but is float64"),
        (
            alter(lambda k, q, s: unchecked(k, visible=k.visible.astype(np.float32))),
            "visible must be bool, but is float32",
        ),
        (alter(lambda k, q, s: unchecked(k, xy=k.xy.swapaxes(0, 1))), r"xy must have shape \(10, \d+, 2\), but has"),
        (alter(lambda k, q, s: replace(k, confidence=k.confidence * 2)), "confidence ranges from .*, expected 0 to 1"),
        (alter(lambda k, q, s: unchecked(k, residual=k.confidence[:1])), "residual must have shape"),
        (alter(lambda k, q, s: unchecked(k, xyz_cam=k.xy)), r"xyz_cam must have shape \(10, \d+, 3\), but has"),
        (alter(lambda k, q, s: replace(k, xyz_cam=behind(k))), "xyz_cam must lie before the camera"),
        (alter(lambda k, q, s: replace(k, xyz_cam=in_pixels(k))), "xyz_cam must project to xy, but is .* px away"),
        (alter(lambda k, q, s: (k.xy, k.visible)), "track.. must return a Tracks2D, but returns a tuple"),
        (alter(lambda k, q, s: replace(k, visible=k.visible & False)), "must be visible at the frame of its query"),
        (alter(seen_before_query), "before the frame of its query a point must not be visible"),
        (alter(lost_as_nan), "xy holds a number that is not finite"),
        (late, "from where they should be"),
        (alter(random), "answered in the same way every time"),
        (refuses_nothing, "no points"),
        (writes_into_queries, "must not be written into"),
        (pulls_inside, "a query in a corner of the picture must stay there"),
        (alter(lambda k, q, s: replace(k, visible=k.visible & (k.confidence == 1))), "only .*% of them are visible"),
    ],
)
def test_a_broken_promise_is_named(track: Track, message: str) -> None:
    with pytest.raises((AssertionError, IndexError, RecordError), match=message):
        check_tracker(broken(track))


def test_a_tracker_without_license_is_told_so() -> None:
    with pytest.raises(AssertionError, match="license must be some words, but is ''"):
        check_tracker(broken(right, license=""))


def test_what_is_no_tracker_is_told_so() -> None:
    with pytest.raises(AssertionError, match="it must be a Tracker, but is a dict"):
        check_tracker(dict)  # type: ignore[arg-type]


def test_what_breaks_nothing_passes() -> None:
    check_tracker(broken(right))
