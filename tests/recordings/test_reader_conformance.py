"""The shipped checks of readers: ours keep every promise, and whoever breaks one is told which."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from real_recordings import INTRINSICS, STEPS, colors, counts, write_folder, write_png, write_yaml

from flowlab.recordings.base import BadImage, ImageStream, Reader, Streams
from flowlab.recordings.readers.arrays import ArraysReader
from flowlab.recordings.readers.hdf5 import HDF5Reader
from flowlab.recordings.readers.lerobot import LeRobotReader
from flowlab.recordings.readers.plain import PlainReader
from flowlab.recordings.readers.realsense import RealSenseReader
from flowlab.recordings.readers.rh20t import RH20TReader
from flowlab.recordings.readers.ros import ROSReader
from flowlab.recordings.readers.tum import TUMReader
from flowlab.recordings.recording_yaml import Metadata
from flowlab.testing.readers import CHECKS, MakeReader, check_reader, check_recognized


def plain(folder: Path) -> Path:
    path = write_folder(folder / "rec", state="state.csv")
    rows = [f"{t},{t * t}" for t in range(STEPS)]
    (path / "state.csv").write_text("\n".join(rows) + "\n")
    return path


def arrays(folder: Path) -> Path:
    state = np.arange(2 * STEPS, dtype=np.float32).reshape(-1, 2)
    np.savez_compressed(folder / "ep.npz", img=colors(), depth=counts(), agent_pos=state, action=state)
    write_yaml(folder / "ep.yaml", fps=10)
    return folder / "ep.npz"


def arrays_folder(folder: Path) -> Path:
    (folder / "ep").mkdir()
    np.save(folder / "ep" / "rgb.npy", colors())
    np.save(folder / "ep" / "depth.npy", counts())
    write_yaml(folder / "ep" / "recording.yaml", fps=10)
    return folder / "ep"


def tum(folder: Path) -> Path:
    path = folder / "seq"
    for name, pictures in (("rgb", colors()), ("depth", counts())):
        for t, picture in enumerate(pictures):
            write_png(path / name / f"{t}.png", picture)
        (path / f"{name}.txt").write_text("".join(f"{t / 30:.6f} {name}/{t}.png\n" for t in range(STEPS)))
    return path


def rh20t(folder: Path) -> Path:
    path = folder / "scene"
    for t in range(STEPS):
        write_png(path / "cam_7/color" / f"{1000 + 100 * t}.png", colors()[t])
        write_png(path / "cam_7/depth" / f"{1000 + 100 * t}.png", counts()[t])
    (path / "tcp").mkdir()
    for t in range(STEPS):
        np.save(path / "tcp" / f"{1000 + 100 * t}.npy", np.arange(7.0) + t)
    return path


def ros_bag(folder: Path) -> Path:
    from test_ros_reader import say_robot_and_camera, write_kind

    return write_kind(folder, "bag", say_robot_and_camera)


def ros_folder(folder: Path) -> Path:
    from test_ros_reader import say_robot_and_camera, write_kind

    return write_kind(folder, "mcap", say_robot_and_camera)


def hdf5(folder: Path) -> Path:
    from hdf5_files import robomimic

    return robomimic(folder / "demos.hdf5", demos=1)


def lerobot(folder: Path) -> Path:
    from lerobot_files import v3

    return v3(folder / "d", demos=1, color="png", depth="tiff")


def lerobot_videos(folder: Path) -> Path:
    from lerobot_files import v21

    return v21(folder / "d", demos=1, depth="video")


def realsense(folder: Path) -> Path:
    pytest.importorskip("open3d")
    from test_realsense_reader import write_sdk_bag

    return write_sdk_bag(folder / "desk.bag")


RECORDINGS: tuple[tuple[MakeReader, Callable[[Path], Path]], ...] = (
    (PlainReader, plain),
    (ArraysReader, arrays),
    (ArraysReader, arrays_folder),
    (TUMReader, tum),
    (RH20TReader, rh20t),
    (ROSReader, ros_bag),
    (ROSReader, ros_folder),
    (HDF5Reader, hdf5),
    (LeRobotReader, lerobot),
    (LeRobotReader, lerobot_videos),
    pytest.param(RealSenseReader, realsense, marks=pytest.mark.slow),  # type: ignore[arg-type]
)


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize(("make", "write"), RECORDINGS)
def test_our_readers_keep_every_promise(
    make: MakeReader,
    write: Callable[[Path], Path],
    check: Callable[[MakeReader, Path], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "given").mkdir()
    check(make, write(tmp_path / "given"))


class Boxes:
    """A reader of folders called ``*.box`` that breaks nothing; what it does right is the plain reader's."""

    name = "boxes"
    expects = "a folder called *.box"
    fallback = False

    def probe(self, path: Path) -> bool:
        return path.suffix == ".box" and path.is_dir()

    def read(self, path: Path, given: Metadata) -> Streams:
        return PlainReader().read(path, given)


@pytest.fixture
def box(tmp_path: Path) -> Path:
    for t, (rgb, depth) in enumerate(zip(colors(), counts(), strict=True)):
        write_png(tmp_path / "a.box" / "color" / f"{t}.png", rgb)
        write_png(tmp_path / "a.box" / "depth" / f"{t}.png", depth)
    write_yaml(tmp_path / "a.box" / "recording.yaml", fps=10, intrinsics=INTRINSICS)
    return tmp_path / "a.box"


def test_what_breaks_nothing_passes(box: Path) -> None:
    check_reader(Boxes, box)


def test_a_path_may_be_text(box: Path) -> None:
    for check in CHECKS:
        check(Boxes, str(box))


def changed(**attributes: Any) -> type[Reader]:
    return type("Changed", (Boxes,), attributes)


def altered(change: Callable[[Streams, Path], Streams]) -> dict[str, Any]:
    """Wrong in what it returns."""
    return {"read": lambda self, path, given: change(PlainReader().read(path, given), path)}


def color(change: Callable[[ImageStream], ImageStream]) -> dict[str, Any]:
    return altered(lambda streams, path: replace(streams, color=change(streams.color)))


def decode(change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    return color(lambda images: replace(images, read=lambda k: change(images.read(k))))


def unwary(images: ImageStream, path: Path) -> ImageStream:
    """Takes what OpenCV gives, None for a damaged picture."""
    files = sorted((path / "color").iterdir())
    return replace(images, read=lambda k: cv2.imread(str(files[k]))[..., ::-1])


def lenient(images: ImageStream) -> ImageStream:
    """A damaged picture is black."""

    def read(k: int) -> np.ndarray:
        try:
            return images.read(k)
        except BadImage:
            return np.zeros((24, 32, 3), np.uint8)

    return replace(images, read=read)


def wordless(images: ImageStream) -> ImageStream:
    def read(k: int) -> np.ndarray:
        try:
            return images.read(k)
        except BadImage:
            raise BadImage from None

    return replace(images, read=read)


def cached(images: ImageStream) -> ImageStream:
    """Gives out the pictures it keeps."""
    kept: dict[int, np.ndarray] = {}

    def read(k: int) -> np.ndarray:
        if k not in kept:
            kept[k] = images.read(k)
        return kept[k]

    return replace(images, read=read)


def indexed(streams: Streams, path: Path) -> Streams:
    (path / "index.json").write_text(str(path))
    return streams


def logged(streams: Streams, path: Path) -> Streams:
    Path("reader.log").write_text(os.fspath(path))
    return streams


def cleaned(streams: Streams, path: Path) -> Streams:
    for other in path.parent.glob("*.txt"):
        other.unlink()
    return streams


def noisy(picture: np.ndarray) -> np.ndarray:
    return picture ^ np.random.default_rng().integers(0, 2, picture.shape, np.uint8)


def counted_in_ms(images: ImageStream) -> ImageStream:
    return replace(images, time_s=images.time_s * 1e6)


def opens(self: object, path: Path) -> bool:
    return path.suffix == ".box" and any(path.iterdir())


def greedy(self: object, path: Path) -> bool:
    return path.is_dir()


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"name": ""}, "name must be some words, but is ''"),
        ({"fallback": 1}, "fallback must be True or False, but is 1"),
        ({"probe": lambda self, path: False}, "must recognize a.box, a recording of its layout"),
        ({"probe": greedy}, "must not recognize 'empty', which is something else"),
        ({"probe": lambda self, path: path.suffix == ".box" or path.read_text() == ""}, "raises IsADirectoryError"),
        ({"probe": lambda self, path: path.suffix == ".box"}, "must not recognize what is not there"),
        (color(counted_in_ms), "times must be clear, .* step by 1e.06 where fps is 10: no plausible"),
        (color(lambda i: replace(i, time_s=i.time_s[::-1])), "times must be clear, .* the stamps of color must rise"),
        (color(lambda i: replace(i, time_s=i.time_s.astype(np.float32))), r"must have times of float64 \[s\]"),
        (color(lambda i: replace(i, names=i.names[1:])), "the color stream must have a time for each of 5"),
        (decode(lambda p: p.astype(float)), "color pictures must be uint8, but are float64"),
        (decode(lambda p: p.transpose(2, 0, 1)), r"color pictures must be \(h, w, 3\), but are \(3, 24, 32\)"),
        (decode(noisy), "color picture 5 must be the same every time it is read"),
        (color(cached), "must not change where somebody writes into those that were given out"),
        (altered(indexed), "must not write into or beside a recording, but changes a.box/index.json"),
        (altered(cleaned), "must not write into or beside a recording, but changes beside.txt"),
        (altered(logged), "must not write into the current folder"),
        (altered(lambda s, p: replace(s, color=unwary(s.color, p))), "must be a BadImage or a DataError"),
        (color(lenient), "0.png, cut short, must be a BadImage, but is read as if it were whole"),
        (color(wordless), "must be a BadImage with its reason, but the reason is empty"),
    ],
)
def test_a_broken_promise_is_named(
    attributes: dict[str, Any], message: str, box: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match=message):
        check_reader(changed(**attributes), box)


def test_a_layout_that_somebody_else_reads_too_is_told(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="seq is claimed by the reader tum too"):
        check_recognized(changed(probe=greedy), tum(tmp_path))
