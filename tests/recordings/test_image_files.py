"""Decoding of pictures: what is damaged is noticed, by our own look and not by the decoder's mood."""

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import colors, counts
from thoroughness import examples

from flowlab.recordings.base import BadImage
from flowlab.recordings.image_files import (
    DEPTH_SUFFIXES,
    color_stream,
    decode_color,
    decode_depth,
    depth_stream,
    list_images,
    natural_key,
)

RGB, DEPTH = colors(1)[0], counts(1)[0]


def png(picture: np.ndarray) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1] if picture.ndim == 3 else picture))[1].tobytes()


def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


def test_pictures_come_back_as_they_were() -> None:
    np.testing.assert_array_equal(decode_color(png(RGB)), RGB)
    np.testing.assert_array_equal(decode_depth(png(DEPTH)), DEPTH)
    assert np.abs(decode_color(jpeg(RGB)).astype(int) - RGB).mean() < 4


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(st.sampled_from([png(RGB), png(DEPTH)]), st.floats(0, 1, exclude_max=True))
def test_a_png_cut_anywhere_is_bad(content: bytes, share: float) -> None:
    with pytest.raises(BadImage, match=r"is empty|truncated|neither PNG"):
        decode_color(content[: int(share * len(content))])


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(st.integers(8, len(png(DEPTH)) - 1), st.integers(1, 255))
def test_a_png_with_any_byte_changed_is_bad(at: int, change: int) -> None:
    content = bytearray(png(DEPTH))
    content[at] ^= change
    with pytest.raises(BadImage):
        decode_depth(bytes(content))


def test_a_cut_jpeg_is_bad() -> None:
    content = jpeg(RGB)
    with pytest.raises(BadImage, match="truncated"):
        decode_color(content[: len(content) // 2])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (png(RGB), r"has the shape \(24, 32, 3\)"),
        (png((DEPTH // 8).astype(np.uint8)), "has the type uint8, depth is 16 bit or float"),
        (b"no picture at all", "is neither PNG nor JPEG"),
    ],
)
def test_what_is_no_depth_is_named(content: bytes, message: str) -> None:
    with pytest.raises(BadImage, match=message):
        decode_depth(content)


@pytest.mark.parametrize("save", [np.save, np.savez_compressed])
def test_depth_may_be_an_array(tmp_path: Path, save: Callable[[Path, np.ndarray], None]) -> None:
    file = tmp_path / ("0.npy" if save is np.save else "0.npz")
    save(file, DEPTH[..., None])
    assert list_images(tmp_path, DEPTH_SUFFIXES) == [file]
    stream = depth_stream([file], np.zeros(1))
    np.testing.assert_array_equal(stream.read(0), DEPTH)
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(BadImage, match="cannot be read"):
        stream.read(0)


def test_a_file_that_went_away_is_bad(tmp_path: Path) -> None:
    with pytest.raises(BadImage, match=r"cannot be read \(there is no such file"):
        color_stream([tmp_path / "gone.png"], np.zeros(1)).read(0)


def test_a_turned_jpeg_stays_as_stored() -> None:
    """A camera's wish to see it turned is not followed: depth would not be."""
    content = jpeg(RGB)
    exif = (
        b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00\x00\x00"
    )
    turned = content[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + content[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (32, 24, 3)
    assert decode_color(turned).shape == (24, 32, 3)


def test_names_sort_as_people_count(tmp_path: Path) -> None:
    names = ["f1.png", "f2.png", "f10.png", "g1.png"]
    for name in (*reversed(names), ".f0.png", "f3.txt"):
        (tmp_path / name).touch()
    assert [f.name for f in list_images(tmp_path, (".png",))] == names
    assert sorted(["b", "10", "9", "a2", "a"], key=natural_key) == ["9", "10", "a", "a2", "b"]


def test_looking_at_a_frame_takes_little() -> None:
    """One color and one depth picture of 640x480; the bound is wide, for machines that are busy."""
    rng = np.random.default_rng(0)
    rgb = png(cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3)).astype(np.uint8), (0, 0), 3))
    depth = png((1000 + cv2.GaussianBlur(rng.normal(0, 9e3, (480, 640)), (0, 0), 9)).astype(np.uint16))
    taken = []
    for _ in range(10):
        start = time.perf_counter()
        decode_color(rgb)
        decode_depth(depth)
        taken.append(time.perf_counter() - start)
    assert min(taken) < 0.03
