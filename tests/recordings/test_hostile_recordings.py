"""Recordings of strangers: whatever their files hold, there is a recording or one sentence; nothing else happens."""

import bz2
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import cv2
import lz4.frame
import numpy as np
import pytest
from real_recordings import INTRINSICS, colors, opened, write_folder, write_yaml
from synthetic import call_cli
from test_arrays_reader import write_npy, write_npz
from test_rh20t_reader import GRIPPER, MS, SERIAL, TCP, write_calibration, write_camera, write_rows

from flowlab.errors import DataError
from flowlab.recordings.base import BadImage, ImageStream, Streams, read_streams
from flowlab.recordings.image_files import decode_color, decode_depth
from flowlab.recordings.readers.ros_limits import limited_memory, unpack
from flowlab.recordings.readers.safe_pickle import pickled_numbers
from flowlab.recordings.recording_yaml import Metadata
from tests.thoroughness import examples

Spoil = Callable[[Path], Any]


def png_of(width: int, height: int) -> bytes:
    """A whole PNG, with right checksums, that claims another size than it has."""
    content = bytearray(cv2.imencode(".png", np.zeros((8, 8), np.uint16))[1].tobytes())
    content[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    return bytes(content)


def jpeg_of(width: int, height: int) -> bytes:
    """A JPEG that claims another size than it has."""
    content = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = content.index(b"\xff\xc0")
    content[at + 5 : at + 9] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return bytes(content)


class TestPictures:
    @pytest.mark.parametrize("content", [png_of(16_000, 16_000), png_of(1 << 31, 1), jpeg_of(60_000, 60_000)])
    def test_a_size_that_fills_memory_is_refused_on_the_header(self, content: bytes) -> None:
        with pytest.raises(BadImage, match=r"says it has \d+ x \d+ pixels, expected 1 to 64,000,000"):
            decode_depth(content)

    def test_a_size_is_found_behind_a_thumbnail(self) -> None:
        content = jpeg_of(60_000, 60_000)
        small = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
        inside = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small
        with pytest.raises(BadImage, match="60000 x 60000"):
            decode_color(content[:2] + inside + content[2:])

    def test_a_jpeg_of_a_thousand_passes_is_refused(self) -> None:
        content = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
        with pytest.raises(BadImage, match="more than 100 passes"):
            decode_color(content[:-2] + b"\xff\xda\x00\x02" * 1000 + content[-2:])

    def test_only_png_and_jpeg_are_decoded(self) -> None:
        for suffix in (".tiff", ".bmp", ".webp"):
            with pytest.raises(BadImage, match="is neither PNG nor JPEG"):
                decode_color(cv2.imencode(suffix, np.zeros((8, 8, 3), np.uint8))[1].tobytes())

    @pytest.mark.parametrize("how", ["device", "pipe", "circle"])
    def test_what_is_no_file_is_bad(self, tmp_path: Path, how: str) -> None:
        path = write_folder(tmp_path / "r")
        picture = path / "color/0002.png"
        picture.unlink()
        if how == "pipe":
            os.mkfifo(picture)
        else:
            picture.symlink_to("/dev/zero" if how == "device" else picture)
        bad = opened(path, max_bad_share=0.5).frame_check.bad
        assert [b.name for b in bad] == ["color/0002.png"]
        assert bad[0].reason.startswith("cannot be read (")

    def test_pictures_too_narrow_to_be_shrunk_are_named(self, tmp_path: Path) -> None:
        path = write_folder(tmp_path / "r")
        for k in range(6):
            cv2.imwrite(str(path / "color" / f"{k:04d}.png"), np.full((1, 640, 3), k, np.uint8))
        with pytest.raises(DataError, match=r"color/0000\.png is 640x1: too narrow"):
            opened(path)


def _yaml(**keys: Any) -> Spoil:
    return lambda path: write_yaml(
        path / "recording.yaml", **{"fps": 10, "depth_unit_m": 0.001, "intrinsics": INTRINSICS, **keys}
    )


def test_a_state_as_large_as_float32_can_be_prints_no_warning(tmp_path: Path) -> None:
    np.save(write_folder(tmp_path / "r", state="state.npy") / "state.npy", np.float32([[3e38] * 3, [-3e38] * 3] * 3))
    with warnings.catch_warnings(action="error"):
        opened(tmp_path / "r")


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (_yaml(times="../../etc/passwd"), "times: must name a file in the recording's folder"),
        (_yaml(state="/etc/passwd"), "state: must name a file in the recording's folder"),
        (_yaml(color="a\0b"), "color: must name a file in the recording's folder"),
        (_yaml(fps=float("inf")), "fps: Input should be a finite number"),
        (_yaml(T_world_cam=[[1e200] * 4] * 4), "T_world_cam: must be a rigid transform"),
        (_yaml(T_world_cam=[[float("nan")] * 4] * 4), "T_world_cam"),
        (_yaml(intrinsics={**INTRINSICS, "distortion": [0.1, 0.2]}), "has 2 coefficients, expected 4, 5, 8, 12 or 14"),
        (_yaml(task=["x" * 100_000]), r"task: Input should be a valid string \(found \['xxx"),
        (lambda p: (p / "recording.yaml").write_bytes(b"fps: \xff"), "is no UTF-8 text"),
        (lambda p: (p / "recording.yaml").write_text("[" * 500), "nested too deep"),
        (lambda p: (p / "intrinsic.json").write_text("9" * 5000), r"intrinsic\.json: not valid JSON"),
        (lambda p: (p / "intrinsic.json").write_text("[]"), r"intrinsic\.json: is not what Open3D writes"),
    ],
)  # fmt: skip
def test_what_a_plain_folder_may_not_say(tmp_path: Path, spoil: Spoil, sentence: str) -> None:
    path = write_folder(tmp_path / "r")
    spoil(path)
    with pytest.raises(DataError, match=sentence) as found:
        opened(path)
    assert len(str(found.value)) < 1000


def _header(shape: str, descr: str = "'<f4'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    "content",
    [
        _header("(100000000000000000000,)"), _header("(1000000000000, 0)"), _header("(2.5,)"), _header("'a'"),
        _header("()"),
        _header("(" * 200), _header("(3,)", "'|O'"), _header("(3,)", "'|V0'"), b"", b"\x93NUMPY", _header("(1, 0, 3)"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("where", ["state.npy", "times.npy", "depth/0001.npy", "rgb.npy", "tcp"])
def test_arrays_that_are_none_are_one_sentence(tmp_path: Path, where: str, content: bytes) -> None:
    if where == "tcp":
        path = write_episode(tmp_path)
        (path / f"cam_{SERIAL}/tcp/{MS[0] + 4}.npy").write_bytes(content)
    elif where == "rgb.npy":
        path = write_npy(tmp_path / "r")
        next(path.glob("[ri]*g*.npy")).write_bytes(content)
        write_yaml(path / "recording.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
    else:
        path = write_folder(tmp_path / "r", state="state.npy", times="times.npy")
        np.save(path / "state.npy", np.zeros((6, 2)))
        np.save(path / "times.npy", np.arange(6.0))
        (path / where).write_bytes(content)
    with pytest.raises(DataError) as found:
        opened(path, max_bad_share=0.0)
    assert len(str(found.value)) < 1000


def write_episode(folder: Path) -> Path:
    """An episode of RH20T."""
    episode = folder / "train/ep_1"
    camera = write_camera(episode)
    write_rows(camera / "tcp", TCP, late_ms=4)
    write_rows(camera / "gripper_command", GRIPPER)
    write_calibration(folder)
    (episode / "timestamp.txt").write_text("1649\n")
    return episode


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("metadata.json", b'{"finish_time": "soon"}', "'finish_time' is 'soon', expected a number"),
        ("metadata.json", b'{"rating": [1]}', r"'rating' is \[1\], expected a number"),
        ("metadata.json", b"[1]", r"holds \[1\], expected names and values"),
        ("metadata.json", b"\xff", "is no UTF-8 text"),
        ("metadata.json", b'{"finish_time": ' + b"9" * 400 + b"}", "expected a number"),
        ("timestamp.txt", b"../../../etc\n", r"its calibration is called '\.\./\.\./\.\./etc'"),
        ("timestamp.txt", b"\xff\xfe", "is no UTF-8 text"),
    ],
)
def test_what_rh20t_files_may_not_say(tmp_path: Path, name: str, content: bytes, sentence: str) -> None:
    episode = write_episode(tmp_path)
    (episode / name).write_bytes(content)
    with pytest.raises(DataError, match=sentence):
        opened(episode)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({SERIAL: np.zeros((4, 4))}, "the pose of camera 750612070851 must be a rigid transform"),
        ({SERIAL: np.full((4, 4), np.nan)}, "has 16 numbers for camera 750612070851, expected 16 that are finite"),
        ({SERIAL: np.eye(3)}, "has 9 numbers for camera"),
        ({SERIAL: "text"}, "holds 'text', expected numbers"),
    ],
)
def test_a_pose_that_is_none_is_told(tmp_path: Path, values: Any, sentence: str) -> None:
    episode = write_episode(tmp_path)
    np.save(tmp_path / "calib/1649/extrinsics.npy", values, allow_pickle=True)
    with pytest.raises(DataError, match=sentence):
        opened(episode)


class TestArchives:
    def test_a_bomb_is_told_before_it_is_unpacked(self, tmp_path: Path) -> None:
        path = write_npz(tmp_path / "ep.npz")
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("x.npy", "w") as member:
            for _ in range(1100):
                member.write(bytes(1 << 20))
        write_yaml(tmp_path / "ep.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
        with pytest.raises(DataError, match=r"ep\.npz: unpacks to 1,\d+,\d+,\d+ bytes, expected at most 1,073,741,824"):
            opened(path)

    def test_nothing_is_left_where_it_was_unpacked_and_names_lead_nowhere(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        room = tmp_path / "room"
        room.mkdir()
        monkeypatch.setattr("tempfile.tempdir", str(room))
        path = write_npz(tmp_path / "ep.npz")
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("../../evil.npy", b"x")
            archive.writestr("/abs.npy", b"x")
        write_yaml(tmp_path / "ep.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
        recording = opened(path)
        np.testing.assert_array_equal(recording.frame(1).rgb, colors(2)[1])
        assert list(room.iterdir()) == []
        assert not list(tmp_path.rglob("*evil*"))

    def test_a_member_that_is_no_array_is_named(self, tmp_path: Path) -> None:
        path = write_npz(tmp_path / "ep.npz")
        with zipfile.ZipFile(path) as archive:
            members = {n: archive.read(n) for n in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, b"no array" if name == "depth.npy" else content)
        write_yaml(tmp_path / "ep.yaml", fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)
        with pytest.raises(DataError, match=r"ep\.npz: depth\.npy: not a readable NumPy file"):
            opened(path)


class TestPickles:
    def stored(self, path: Path, content: bytes) -> Path:
        file = io.BytesIO()
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})  # type: ignore[arg-type]
        path.write_bytes(file.getvalue() + content)
        return path

    @pytest.mark.parametrize("protocol", [2, 3, 4, 5])
    def test_plain_arrays_of_every_protocol_are_read(self, tmp_path: Path, protocol: int) -> None:
        numbers = np.arange(12.0).reshape(3, 4)
        values = {"a": numbers, 7: [numbers[:, ::2], numbers.T], "big": np.asfortranarray(numbers.astype(">f4"))}
        path = self.stored(tmp_path / "x.npy", pickle.dumps(np.array(values, object), protocol))
        np.testing.assert_array_equal(pickled_numbers(path, "a"), numbers.ravel())
        np.testing.assert_array_equal(pickled_numbers(path, "big"), numbers.ravel())
        np.testing.assert_array_equal(pickled_numbers(path, "7"), [*numbers[:, ::2].ravel(), *numbers.T.ravel()])
        assert pickled_numbers(path, "b") is None

    @pytest.mark.parametrize(
        "content",
        [
            b"cos\nsystem\n(S'true'\ntR.",
            b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8K\x00K\x01tR(K\x03X\x01\x00\x00\x00<N(K\x01tNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb.",
            b"\x80\x04j\xff\xff\xff\x7f.", b"\x80\x04Nr\xff\xff\xff\x7f.", b"\x80\x04" + b"(" * 100_001, b"\x80\x04].",
            b"b", b"",
            b"\x80\x04}\x94h\x00h\x00s.", b"\x80\x04K\x01\x85R.", b"\x80\x04\x82\x01.", b"cnumpy\nndarray\n)R.",
        ],
    )  # fmt: skip
    def test_anything_else_is_one_sentence(self, tmp_path: Path, content: bytes) -> None:
        with pytest.raises(DataError, match=r"x\.npy: cannot be read"):
            pickled_numbers(self.stored(tmp_path / "x.npy", content), "a")

    def test_no_mutation_crashes_or_runs(self, tmp_path: Path) -> None:
        """In a process of its own, for a crash would end this one."""
        command = [sys.executable, "-m", "tests.campaigns.fuzz", "--kind", "pickle", "--count", str(examples(2))]
        found = subprocess.run([*command, "--keep", tmp_path], capture_output=True, text=True, check=False)
        assert found.returncode == 0, found.stdout + found.stderr


class TestROS:
    @pytest.mark.parametrize("form", ["bz2", "lz4"])
    def test_a_bomb_is_not_unpacked(self, form: str) -> None:
        pack, unpacker = {
            "bz2": (bz2.compress, bz2.BZ2Decompressor), "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
        }[form]  # fmt: skip
        assert unpack(unpacker, pack(b"ab") + pack(b"c")) == b"abc"
        with pytest.raises(ValueError, match="unpacks to more than the 1,000 bytes"):
            unpack(unpacker, pack(bytes(1 << 24)), 1000)
        with pytest.raises(ValueError, match="cut short"):
            unpack(unpacker, pack(bytes(1 << 16))[:-5])

    def test_memory_beyond_a_limit_is_an_error_and_the_limit_ends(self) -> None:
        with limited_memory(1 << 28), pytest.raises(MemoryError):
            np.ones(1 << 29, np.uint8)
        assert np.ones(1 << 29, np.uint8).size == 1 << 29


class Broken:
    """A reader of somebody's that fails in some way."""

    name: ClassVar[str] = "broken"
    expects: ClassVar[str] = "anything"
    fallback: ClassVar[bool] = False

    def __init__(self, result: Any) -> None:
        self._result = result

    def probe(self, path: Path) -> bool:
        return True

    def read(self, path: Path, given: Metadata) -> Any:
        if isinstance(self._result, Exception):
            raise self._result
        return self._result


def _pictures(time_s: Any, read: Any = lambda i: np.zeros((2, 2, 3), np.uint8)) -> ImageStream:
    return ImageStream(("a", "b"), time_s, read)


@pytest.mark.parametrize(
    ("result", "sentence"),
    [
        (KeyError("x"), r"the reader 'broken' cannot read it \(KeyError: 'x'\)"),
        (RecursionError("deep"), "RecursionError: deep"),
        (None, "gives None, expected Streams"),
        (Streams(_pictures([0.0, 1.0]), _pictures(np.arange(2.0))), r"gives \[0.0, 1.0\] as the times of pictures"),
        (
            Streams(_pictures(np.arange(2.0)), _pictures(np.array([0, np.nan]))),
            "gives times of pictures that are not fin",
        ),
    ],
)
def test_what_a_reader_of_others_does_is_told_with_its_name(tmp_path: Path, result: Any, sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        read_streams(Broken(result), tmp_path, Metadata())


def test_a_picture_that_a_reader_fails_on_is_bad(tmp_path: Path) -> None:
    def fails(index: int) -> np.ndarray:
        raise cv2.error("no")

    streams = read_streams(
        Broken(Streams(_pictures(np.arange(2.0), fails), _pictures(np.arange(2.0)))), tmp_path, Metadata()
    )
    with pytest.raises(BadImage, match=r"cannot be read \(error: no\)"):
        streams.color.read(0)


def test_through_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A recording that is hostile in several ways is one sentence, and its neighbor is labeled all the same."""
    write_folder(tmp_path / "in/good", task="pour")
    write_folder(tmp_path / "in/bad", task="pour", times="../good/recording.yaml")
    (tmp_path / "in/bad/yaml.py").write_text("raise SystemExit('it ran')")
    code, out, err = call_cli(capsys, "track-real", tmp_path / "in", "--dry-run")
    assert "Traceback" not in out + err
    assert "must name a file in the recording's folder" in out + err
    assert code in (0, 3)
    shutil.rmtree(tmp_path / "in")
    assert json.dumps(out)
