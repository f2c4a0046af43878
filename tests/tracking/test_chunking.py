"""Stitching: what chunks are asked, how they are merged, and that what is lost is not passed off as found."""

import tracemalloc
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest

from flowlab.config import SettingsError
from flowlab.geometry.camera import Camera
from flowlab.records import Clip, Tracks2D
from flowlab.testing.trackers import FRAMES, rolling
from flowlab.tracking.base import Session, Tracker
from flowlab.tracking.chunking import ChunkSettings, follow
from flowlab.tracking.trackers.lucas_kanade import LucasKanade

QUERIES = np.array([[10.0, 20], [30, 25.5], [40, 12]], np.float32)
VELOCITY = np.float32([0.5, -0.25])
Rule = Callable[[np.ndarray, int, np.ndarray], dict[str, np.ndarray]]
"""What a tracker answers for frames (K, 1) of a chunk from ``start``, given the true positions (K, M, 2)."""


def blank(frames: int) -> Clip:
    camera = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(4))
    return Clip(np.zeros((frames, 48, 64, 3), np.uint8), np.ones((frames, 48, 64), np.float32), camera)


class Scripted(Tracker):
    """Points move at one velocity, from wherever a chunk is asked for them; ``rule`` changes what it says."""

    name: ClassVar[str] = "scripted"
    license: ClassVar[str] = "none"
    rule: Any = None
    asked: Any

    def open(self, clip: Clip) -> Session:
        return ScriptedSession(self)


class Whole(Scripted):
    chunked: ClassVar[bool] = False


class ScriptedSession:
    def __init__(self, tracker: Scripted) -> None:
        self.tracker = tracker

    def track(self, queries_txy: np.ndarray, start: int, stop: int) -> Tracks2D:
        self.tracker.asked.append((start, stop, queries_txy.copy()))
        t = np.arange(start, stop)[:, None]
        xy = queries_txy[:, 1:] + (t - start)[..., None] * VELOCITY
        shape = xy.shape[:2]
        fields = {"xy": xy, "visible": np.ones(shape, bool), "confidence": np.ones(shape)}
        fields |= self.tracker.rule(t, start, xy) if self.tracker.rule else {}
        as_stored = {k: v.astype(bool if k == "visible" else np.float32) for k, v in fields.items()}
        return Tracks2D(**as_stored)


def run(frames: int, rule: Rule | None = None, kind: type[Scripted] = Scripted, **chunks: int) -> tuple[Tracks2D, list]:
    tracker = kind(rule=rule, asked=[])
    tracks = follow(blank(frames), QUERIES, tracker, ChunkSettings(**chunks))
    assert np.isfinite(tracks.xy).all()
    assert ((tracks.confidence >= 0) & (tracks.confidence <= 1)).all()
    return tracks, tracker.asked


def truth(frames: int) -> np.ndarray:
    return QUERIES + np.arange(frames)[:, None, None] * VELOCITY


@pytest.mark.parametrize(("length", "stride", "frames"), [(33, 8, 70), (33, 1, 40), (5, 4, 22), (10, 3, 4), (33, 8, 2)])
def test_chunks_are_asked_where_those_before_have_led(length: int, stride: int, frames: int) -> None:
    tracks, asked = run(frames, length=length, stride=stride)
    assert [a[0] for a in asked] == list(range(0, frames - 1, stride))
    for start, stop, queries in asked:
        assert stop == min(start + length, frames)
        assert queries.dtype == np.float32
        assert (queries[:, 0] == start).all()
        np.testing.assert_array_equal(queries[:, 1:], tracks.xy[start])
    np.testing.assert_allclose(tracks.xy, truth(frames), atol=1e-4)
    np.testing.assert_array_equal(tracks.xy[0], QUERIES)
    assert tracks.visible.all()


def test_a_tracker_that_wants_the_clip_whole_gets_it_whole() -> None:
    tracks, asked = run(70, kind=Whole)
    assert [(a[0], a[1]) for a in asked] == [(0, 70)]
    np.testing.assert_allclose(tracks.xy, truth(70), atol=1e-4)


def test_the_paper_says_33_frames_and_a_stride_of_1() -> None:
    assert ChunkSettings().length == 33
    _, asked = run(36, length=33, stride=1)
    assert [a[:2] for a in asked[:3]] == [(0, 33), (1, 34), (2, 35)]


def test_one_frame_is_only_what_was_asked() -> None:
    tracks, asked = run(1)
    assert not asked
    np.testing.assert_array_equal(tracks.xy, QUERIES[None])
    assert tracks.visible.all()


def test_chunks_that_leave_a_gap_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"stride \(8\) must be below length \(8\): chunks have to overlap"):
        ChunkSettings(length=8, stride=8)


def test_disagreement_is_how_far_apart_the_chunks_are() -> None:
    """A drift with the square of the time since a chunk's start: where two chunks overlap, it is known how far."""
    drift = 0.01

    def rule(t: np.ndarray, start: int, xy: np.ndarray) -> dict[str, np.ndarray]:
        return {"xy": xy + drift * np.square(t - start)[..., None] * (1, 0)}

    tracks, _ = run(14, rule, length=12, stride=8)
    assert tracks.disagreement is not None
    assert (tracks.disagreement[:9] == -1).all()  # one chunk only
    t = np.array([9, 10, 11])
    first, second = drift * t**2, drift * 8**2 + drift * (t - 8) ** 2
    np.testing.assert_allclose(tracks.disagreement[9:12], np.repeat((first - second)[:, None], 3, 1), atol=1e-4)
    assert (tracks.disagreement[12:] == -1).all()


def test_the_chunk_that_agrees_with_most_is_taken_and_the_sure_count_for_more() -> None:
    def outlier(confidence: float) -> Rule:
        def rule(t: np.ndarray, start: int, xy: np.ndarray) -> dict[str, np.ndarray]:
            off = (start == 4) & (t > 8)
            sure = np.where(off | (t <= 8), 1.0, confidence) + 0 * xy[..., 0]
            return {"xy": xy + 5.0 * off[..., None], "confidence": sure, "forward_backward": off + 0 * xy[..., 0]}

        return rule

    kept, _ = run(11, outlier(1.0), length=11, stride=2)
    np.testing.assert_allclose(kept.xy, truth(11), atol=1e-4)  # one against many, all as sure
    assert kept.forward_backward is not None
    assert (kept.forward_backward[9:] == 0).all()
    moved, _ = run(11, outlier(0.02), length=11, stride=2)
    np.testing.assert_allclose(moved.xy[10] - truth(11)[10], 5, atol=1e-4)  # one who knows against many who do not


def hidden_in(frames: range) -> Rule:
    """A tracker without memory: a point hidden in some frames is not seen there, but taken up again if asked."""

    def rule(t: np.ndarray, start: int, xy: np.ndarray) -> dict[str, np.ndarray]:
        hidden = (t >= frames.start) & (t < frames.stop) & (np.arange(3) == 1) & (t > start)
        return {"visible": ~hidden, "confidence": np.where(hidden, 0.1, 0.9)}

    return rule


def test_a_point_is_found_again_by_a_chunk_that_began_while_it_was_seen() -> None:
    tracks, _ = run(40, hidden_in(range(10, 20)), length=16, stride=4)
    seen = np.ones((40, 3), bool)
    seen[10:20, 1] = False
    np.testing.assert_array_equal(tracks.visible, seen)


def test_a_point_is_not_found_again_only_because_a_chunk_begins() -> None:
    """Chunks that begin while it is hidden say they see it: it might be whatever hides it."""
    tracks, _ = run(60, hidden_in(range(10, 30)), length=16, stride=4)
    assert not tracks.visible[10:, 1].any()
    assert tracks.confidence[30:, 1].max() == 0
    assert tracks.visible[:, [0, 2]].all()
    np.testing.assert_allclose(tracks.xy, truth(60), atol=1e-3)  # it still is somewhere


def test_one_doubtful_chunk_is_not_enough_to_see_a_point() -> None:
    def rule(t: np.ndarray, start: int, xy: np.ndarray) -> dict[str, np.ndarray]:
        doubts = (start == 2) & (t > 4) & (xy[..., 0] > 0)
        return {"visible": doubts | (t <= 4), "confidence": np.where(doubts, 0.3, 0.9)}

    tracks, _ = run(7, rule, length=7, stride=2)
    assert tracks.visible[:5].all()
    assert not tracks.visible[5:].any()


def test_no_chunk_is_surer_than_its_start() -> None:
    tracks, _ = run(30, lambda t, start, xy: {"confidence": 0.9 + 0 * xy[..., 0]}, length=5, stride=4)
    starts = np.arange(4, 29, 4)
    np.testing.assert_allclose(tracks.confidence[starts], np.repeat(0.9 ** (starts / 4)[:, None], 3, 1), rtol=1e-5)


def test_what_a_tracker_does_not_measure_is_marked_so() -> None:
    tracks, _ = run(12, length=6, stride=3)
    assert tracks.forward_backward is not None
    assert (tracks.forward_backward[0] == 0).all()
    assert (tracks.forward_backward[1:] == -1).all()


def test_no_queries() -> None:
    none = follow(rolling().clip, np.empty((0, 2), np.float32), LucasKanade(), ChunkSettings(length=4, stride=2))
    assert none.xy.shape == (FRAMES, 0, 2)
    assert none.visible.shape == (FRAMES, 0)


def test_lucas_kanade_in_chunks_stays_on_the_turning_surface() -> None:
    xy = np.stack(np.meshgrid(np.arange(24.0, 150, 18), np.arange(24.0, 104, 16)), -1).reshape(-1, 2)
    path = rolling().move(xy, 0, np.arange(FRAMES)[:, None])
    inside = ((path > 14) & (path < (178, 114))).all((0, 2))
    tracks = follow(rolling().clip, xy[inside].astype(np.float32), LucasKanade(), ChunkSettings(length=5, stride=2))
    error = np.linalg.norm(tracks.xy - path[:, inside], axis=-1)
    assert error.max() < 0.8
    assert np.median(error) < 0.15
    assert tracks.visible.mean() > 0.95


def test_memory_does_not_grow_with_the_clip() -> None:
    """Of 300 frames and 100 points in chunks of stride 1, no more than those of the chunks that overlap is kept."""
    queries = np.random.default_rng(0).uniform(0, 48, (100, 2)).astype(np.float32)
    peak = {}
    for frames in (60, 300):
        tracker = Scripted(asked=[])
        clip = blank(frames)
        tracemalloc.start()
        follow(clip, queries, tracker, ChunkSettings(length=33, stride=1))
        peak[frames] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        tracker.asked.clear()
    result = 300 * 100 * (8 + 1 + 3 * 4)
    assert peak[300] - peak[60] < 1.2 * result + 300 * 100 * 3 * 4  # the result, and what the script notes down
