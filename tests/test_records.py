"""Records refuse what does not fit them, in one sentence, and say in one line what they hold."""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import jaxtyping
import numpy as np
import pytest
from synthetic import CAMERA, make_episode, with_quality

import flowlab.records
from flowlab.errors import DataError, RecordError
from flowlab.geometry.camera import Camera
from flowlab.records import Clip, Entity, Episode, Frame, Observation, Queries, Role, Tracks2D
from flowlab.shapes import Record


@pytest.fixture(autouse=True)
def as_for_users() -> Iterator[None]:
    """Without the types that are checked in tests only, and would complain first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


EPISODE = with_quality(make_episode(depth=True, rgb=True))
DEPTH = np.ones((12, 16), np.float32)
TILTED = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0.01, 1, 0], [0, 0, 0, 1]])


def camera(**changes: Any) -> Camera:
    return replace(CAMERA, **changes)


def with_k(row: int, column: int, value: float) -> np.ndarray:
    K = CAMERA.K.copy()
    K[row, column] = value
    return K


def queries(**changes: Any) -> Queries:
    return replace(EPISODE.queries, **changes)


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "K is a pose": (lambda: camera(K=np.eye(4)), "Camera.K has the shape (4, 4), expected (3, 3)"),
    "pose is a rotation": (lambda: camera(T_world_cam=np.eye(3)), "Camera.T_world_cam has the shape (3, 3), expected"),
    "no camera": (lambda: Frame(DEPTH, np.eye(4)), "Frame.camera is float64[4, 4], expected a Camera"),  # type: ignore[arg-type]
    "camera is None": (lambda: Frame(DEPTH, None), "Frame.camera is None, expected a Camera"),  # type: ignore[arg-type]
    "tracks of another kind": (
        lambda: replace(EPISODE, tracks=EPISODE.queries),  # type: ignore[arg-type]
        "Episode.tracks is Queries(...), expected a Tracks3D",
    ),
    "quality is an array": (
        lambda: replace(EPISODE.tracks, quality=np.zeros(3)),  # type: ignore[arg-type]
        "Tracks3D.quality is float64[3], expected a Quality",
    ),
    "no pixels": (lambda: camera(width=0), "Camera.width is 0, expected a number of pixels above 0"),
    "not finite": (lambda: camera(T_world_cam=np.full((4, 4), np.nan)), "Camera.T_world_cam holds a number"),
    "focal length of 0": (lambda: camera(K=with_k(0, 0, 0)), "Camera.K has the focal lengths 0 and"),
    "skewed": (lambda: camera(K=with_k(0, 1, 5.0)), "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
    "K transposed": (lambda: camera(K=CAMERA.K.T.copy()), "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
    "pose transposed": (
        lambda: camera(T_world_cam=CAMERA.T_world_cam.T.copy()),
        "Camera.T_world_cam has the last row",
    ),
    "scaled": (lambda: camera(T_world_cam=np.diag([2.0, 2, 2, 1])), "Camera.T_world_cam holds no rotation (it"),
    "sheared": (lambda: camera(T_world_cam=TILTED), "holds no rotation (it is off by 0.01)"),
    "mirrored": (lambda: camera(T_world_cam=np.diag([1.0, 1, -1, 1])), "holds no rotation (it mirrors)"),
    "a list": (lambda: camera(K=CAMERA.K.tolist()), "Camera.K is list, expected a NumPy array of float64"),
    "millimeters": (
        lambda: Frame((1000 * DEPTH).astype(np.uint16), CAMERA),
        "Frame.depth is uint16, expected float32; give meters, of millimeters (depth / 1000).astype(np.float32)",
    ),
    "camera of other pictures": (
        lambda: Frame(DEPTH.T.copy(), CAMERA),
        "Frame.depth has the shape (16, 12), expected (12, 16), as camera.height has 12 for H",
    ),
    "negative depth": (lambda: Frame(DEPTH - 2 * np.eye(12, 16, 3, np.float32), CAMERA), "is -1 m at pixel (3, 0)"),
    "one picture": (lambda: Frame(DEPTH[None], CAMERA), "Frame.depth has the shape (1, 12, 16), expected (H, W)"),
    "color in floats": (
        lambda: Frame(DEPTH, CAMERA, rgb=np.zeros((12, 16, 3))),
        "Frame.rgb is float64, expected uint8",
    ),
    "a picture missing": (
        lambda: Clip(np.zeros((3, 12, 16, 3), np.uint8), np.ones((2, 12, 16), np.float32), CAMERA),
        "Clip.depth has the shape (2, 12, 16), expected (3, 12, 16), as rgb has 3 for T",
    ),
    "more points than there are": (lambda: queries(count=9), "Queries.count is 9, expected 0 to 8"),
    "an owner that is nothing": (
        lambda: queries(entities=(Entity("x", "x", Role.OBJECT),)),
        "Queries.owner ranges from 0 to 1, expected -1 to 0",
    ),
    "owners of fewer points": (lambda: queries(owner=np.zeros(7, np.int16)), "Queries.owner has the shape (7,)"),
    "a step less": (
        lambda: replace(EPISODE, action=EPISODE.action[:-1]),
        "Episode.action has the shape (11, 4), expected (12, A), as ",
    ),
    "tracks of other steps": (
        lambda: replace(EPISODE, tracks=make_episode(steps=9).tracks),
        "Episode.time_s has the shape (12,), expected (9,), as tracks.",
    ),
    "tracks of other points": (
        lambda: replace(EPISODE, tracks=make_episode(queries=5).tracks),
        "is 5 long in M, and queries.xyz_world is 8",
    ),
    "quality of other points": (
        lambda: replace(EPISODE.tracks, quality=with_quality(make_episode(queries=5)).tracks.quality),
        "Tracks3D.xyz_world has the shape (12, 8, 3), expected (12, 5, 3), as quality.sigma has 5 for M",
    ),
    "visibility in numbers": (
        lambda: Tracks2D(np.zeros((2, 3, 2), np.float32), np.ones((2, 3), np.float32), np.ones((2, 3), np.float32)),
        "Tracks2D.visible is float32, expected bool",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_value_is_one_sentence(what: str) -> None:
    make, sentence = WRONG[what]
    with pytest.raises(RecordError) as error:
        make()
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)
    assert isinstance(error.value, ValueError)
    assert isinstance(error.value, DataError)


def test_what_is_right_within_rounding_is_taken() -> None:
    camera(T_world_cam=np.round(CAMERA.T_world_cam @ np.array(
        [[0.8660254, -0.5, 0, 0], [0.5, 0.8660254, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), 4))  # fmt: skip
    Frame(DEPTH.astype(np.float64), CAMERA)
    Frame(np.where(DEPTH > 0, np.nan, 1).astype(np.float32), CAMERA)
    Queries(np.zeros((0, 3), np.float32), np.zeros(0, np.int16), 0)
    queries(owner=np.full(8, -1, np.int16), entities=())


def records_in(record: Record) -> list[Record]:
    inner = [getattr(record, f.name) for f in fields(record)]  # type: ignore[arg-type]
    return [record, *(r for x in inner if isinstance(x, Record) for r in records_in(x))]


@pytest.mark.parametrize("record", records_in(EPISODE), ids=lambda r: type(r).__name__)
def test_a_record_shows_shapes_and_no_values(record: Record) -> None:
    text = repr(record)
    assert text.startswith(f"{type(record).__name__}(")
    assert "\n" not in text
    assert len(text) < 400
    for f in fields(record):  # type: ignore[arg-type]
        value = getattr(record, f.name)
        if isinstance(value, np.ndarray):
            assert f"{f.name}={value.dtype}[{', '.join(map(str, value.shape))}]" in text


def test_a_record_leaves_out_what_it_lacks() -> None:
    text = repr(make_episode(3))
    assert text.startswith("Episode(task='roll', seed=3, camera=Camera(...), time_s=float64[12], ")
    assert "depth" not in text
    assert "extras={rand_vec}" in text


def test_every_record_shares_the_checks_and_the_repr() -> None:
    made: list[type] = [x for x in vars(flowlab.records).values() if isinstance(x, type) and is_dataclass(x)]
    arrays = [cls for cls in made if cls is not Entity]
    assert Episode in arrays
    for cls in arrays:
        assert issubclass(cls, Record), cls
        assert cls.__repr__ is Record.__repr__, cls


D = np.ones((12, 16), np.float32)
RGB = np.zeros((1, 12, 16, 3), np.uint8)
NOWHERE = np.zeros((2, 3, 2), np.float32)
SEEN, SURE = np.ones((2, 3), bool), np.ones((2, 3), np.float32)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda e: Frame(np.ma.masked_array(D), CAMERA), r"Frame\.depth is MaskedArray"),
        (lambda e: Frame(D, CAMERA, entities=(1, 2)), r"Frame\.entities is 2 x int, expected a tuple of Entity"),
        (lambda e: Clip(RGB, -D[None], CAMERA), r"Clip\.depth is -1 m"),
        (lambda e: Clip(RGB, np.nan * D[None], CAMERA), r"Clip\.depth is nan m .* 0 where nothing is read"),
        (lambda e: Clip(RGB, np.where(D > 0, np.inf, D)[None], CAMERA), r"Clip\.depth is inf m"),
        (lambda e: replace(e.queries, count=1.5), r"Queries\.count is 1\.5, expected a whole number"),
        (lambda e: replace(e.queries, count="2"), r"Queries\.count is '2', expected a whole number"),
        (lambda e: Observation(np.zeros((2, 3), np.float32), -1), r"Observation\.count is -1, expected 0 to 2"),
        (lambda e: Tracks2D(NOWHERE * np.nan, SEEN, SURE), r"Tracks2D\.xy holds a number that is not finite"),
        (lambda e: Tracks2D(NOWHERE, SEEN, SURE * 7), r"Tracks2D\.confidence ranges from 7 to 7, expected 0 to 1"),
        (lambda e: Camera(128.5, 2, CAMERA.K, np.eye(4)), r"Camera\.width is 128\.5, expected a whole number"),
        (lambda e: Camera("a", 2, CAMERA.K, np.eye(4)), r"Camera\.width is 'a'"),
        (lambda e: replace(e, task=3), r"Episode\.task is 3, expected text"),
        (lambda e: replace(e, seed="x"), r"Episode\.seed is 'x', expected a whole number"),
        (lambda e: replace(e, extras=[1]), r"Episode\.extras is 1 x int, expected names and values"),
        (lambda e: replace(e, time_s=e.time_s[::-1].copy()).check_numbers(), r"Episode\.time_s is .* s in row 1 after"),
        (lambda e: replace(e, state=e.state * np.nan).check_numbers(), r"Episode\.state is not finite in row 0"),
        (lambda e: replace(e, point_count=e.point_count + 1).check_numbers(), "point_count ranges from 0 to 65"),
        (lambda e: replace(e, seed=-1).check_numbers(), r"Episode\.seed is -1, expected 0 or more"),
    ],
)  # fmt: skip
def test_odd_values_are_one_sentence(make: Callable[[Episode], Any], sentence: str) -> None:
    with pytest.raises(RecordError, match=sentence):
        make(make_episode())
