"""Files of strangers: whatever they hold, there is a value or one sentence."""

import io
import os
import tempfile
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.array_files import load_array, load_arrays, map_array
from flowlab.config import PlainName, Settings
from flowlab.errors import DataError, FlowlabError, UsageError
from flowlab.text import is_plain_name, printable, shown
from flowlab.untrusted import parse_json, parse_yaml, read_bytes, read_json


class TestText:
    @pytest.mark.parametrize(
        "name", ["", ".", "..", "../x", "/x", "a/b", "a\\b", "a\0b", ".hidden", "x" * 200, "a\nb", "\x1b[2J"]
    )
    def test_names_that_lead_elsewhere_are_refused(self, name: str) -> None:
        class Unit(Settings):
            name: PlainName

        assert not is_plain_name(name)
        with pytest.raises(UsageError, match="no plain name"):
            Unit(name=name)

    @given(st.text(st.characters(codec=None), max_size=40))
    @settings(max_examples=examples(200), deadline=None)
    def test_a_plain_name_names_one_file_of_a_folder(self, name: str) -> None:
        if is_plain_name(name):
            assert os.path.normpath(os.path.join("folder", name)) == os.path.join("folder", name)

    @given(st.text(st.characters(codec=None)))
    @settings(max_examples=examples(200), deadline=None)
    def test_messages_can_always_be_printed(self, text: str) -> None:
        message = str(FlowlabError(text))
        message.encode("utf-8")
        assert printable(message) == message

    def test_what_looks_like_a_space_and_is_none_is_shown(self) -> None:
        assert shown("left\xa0arm\u2003x\u3000") == r"'left\xa0arm\u2003x\u3000'"
        assert shown("left arm") == "'left arm'"
        assert shown("\u05fd\ue000") == r"'\u05fd\ue000'", "what is no character"
        assert printable("\U0001f469\u200d\U0001f680 क\u094d\u200dष") == "\U0001f469\u200d\U0001f680 क\u094d\u200dष"

    def test_what_was_found_is_cut(self) -> None:
        bomb = ["x" * 1000] * 1000
        for _ in range(30):
            bomb = [bomb] * 9
        for value in (bomb, "y" * 10**6, 10**6000):
            assert len(shown(value)) <= 205
        assert len(str(FlowlabError("z" * 10**6))) < 10_000
        assert [shown(x) for x in ("plain", 3, "\x1b[31m")] == ["'plain'", "3", r"'\x1b[31m'"]


class TestJSONAndYAML:
    @pytest.mark.parametrize(
        "text",
        ["[" * 200_000, "[" * 500 + "]" * 500, '{"a": ' + "9" * 5000 + "}", "", "{", b"\xff\xfe\x00", '["\\ud800"]'],
    )
    def test_json_that_is_none_is_one_sentence(self, tmp_path: Path, text: str | bytes) -> None:
        path = tmp_path / "flowlab.json"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(DataError, match=r"flowlab\.json: ") as error:
            read_json(path)
        assert len(str(error.value)) < 500

    def test_a_pipe_a_device_a_folder_and_a_circle_are_no_files(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe")
        (tmp_path / "circle").symlink_to("circle")
        (tmp_path / "endless").symlink_to("/dev/zero")
        (tmp_path / "folder").mkdir()
        for name in ("pipe", "circle", "endless", "folder", "nul\0name"):
            with pytest.raises(DataError):
                read_bytes(tmp_path / name)

    def test_a_file_larger_than_its_kind_is_not_read(self, tmp_path: Path) -> None:
        path = tmp_path / "large.json"
        with path.open("wb") as file:
            file.truncate(10**12)
        with pytest.raises(DataError, match="1,000,000,000,000 bytes, expected at most"):
            read_json(path)

    @pytest.mark.parametrize(
        "text",
        [
            "a0: &a0 [x]\n" + "".join(f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(9)),
            "[" * 500 + "]" * 500,
            "a: &a [*a]",
            "a: [",
            "!!python/object/apply:os.system [echo]",
            "? {a: 1}\n: 2",
            "9" * 5000,
            "2020-99-99",
            "a: !!int x",
        ],
    )  # fmt: skip
    def test_yaml_that_is_none_or_a_bomb_is_one_sentence(self, text: str) -> None:
        with pytest.raises(ValueError) as error:  # noqa: PT011
            parse_yaml(text)
        assert len(str(error.value)) < 300

    def test_aliases_as_people_write_them_are_read(self) -> None:
        assert parse_yaml("a: &x {k: 1}\nb: *x\nc:\n  <<: *x\n  m: 2") == {
            "a": {"k": 1},
            "b": {"k": 1},
            "c": {"k": 1, "m": 2},
        }
        assert parse_yaml("") is None

    @given(st.binary(max_size=60))
    @settings(max_examples=examples(200), deadline=None)
    def test_any_bytes_are_values_or_a_sentence(self, content: bytes) -> None:
        for parse in (lambda: parse_json(content, "x"), lambda: parse_yaml(content.decode("latin1"))):
            with suppress(DataError, ValueError):
                parse()


def _npy(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values, allow_pickle=True)
    return file.getvalue()


def _claiming(shape: str, dtype: str = "'<f4'") -> bytes:
    header = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + b"\0" * 64


class TestArrays:
    @given(st.sampled_from(["f4", "f8", "u2", "?", "i8"]), st.lists(st.integers(0, 4), max_size=3), st.booleans())
    @settings(max_examples=examples(60), deadline=None)
    def test_arrays_are_read_as_numpy_wrote_them(self, dtype: str, shape: list[int], fortran: bool) -> None:
        values = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(dtype, order="F" if fortran else "C")

        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            np.save(folder / "a.npy", values)
            np.savez_compressed(folder / "a.npz", a=values, b=values)
            for found in (
                load_array(folder / "a.npy"),
                map_array(folder / "a.npy"),
                load_arrays(folder / "a.npz")["b"],
            ):
                assert found.dtype == values.dtype
                np.testing.assert_array_equal(found, values)

    @pytest.mark.parametrize(
        "content",
        [
            _claiming("(100000000000000000000,)"), _claiming("(-1,)"), _claiming("('a',)"), _claiming("3"),
            _claiming("(1000000,)"), _claiming("(True,)"), _claiming("(0, 10**9)"), _claiming("(2,)", "'|O'"),
            _claiming("(2,)", "[('a', '<f4', (3,))]"), _claiming("(2,)", "'|V4'"), _claiming("(2,)", "'<f99'"),
            _npy(np.array([{"a": 1}], object)), _npy(np.zeros(9))[:-9], b"", b"\x93NUMPY",
            b"\x93NUMPY\x03\x00" + b"\0" * 99,
        ],
    )  # fmt: skip
    def test_a_header_that_lies_is_one_sentence(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "a.npy"
        path.write_bytes(content)
        for read in (load_array, map_array):
            with pytest.raises(DataError, match=r"a\.npy: not a readable NumPy file"):
                read(path)

    def test_an_archive_that_unpacks_to_too_much_is_not_unpacked(self, tmp_path: Path) -> None:
        path = tmp_path / "bomb.npz"
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open("a.npy", "w", force_zip64=True) as file,
        ):
            for _ in range(1100):
                file.write(bytes(1 << 20))
        with pytest.raises(DataError, match="unpacks to"):
            load_arrays(path)

    def test_a_member_that_is_no_array_is_named(self, tmp_path: Path) -> None:
        path = tmp_path / "a.npz"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("notes.txt", "hello")
        with pytest.raises(DataError, match=r"a.npz: notes.txt: not a readable NumPy file"):
            load_arrays(path)
