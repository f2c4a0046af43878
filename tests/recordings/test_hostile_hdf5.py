"""HDF5 files of strangers: nothing outside the file is opened, nothing of theirs runs, what is odd is one sentence."""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hdf5_files import STEPS, filmed, maniskill, robomimic, robotwin
from real_recordings import write_yaml
from synthetic import call_cli

from flowlab.errors import DataError
from flowlab.limits import MAX_READER_BYTES
from flowlab.recordings.base import BadImage, choose_reader, read_streams
from flowlab.recordings.readers import hdf5_process, helper_process
from flowlab.recordings.recording_yaml import Metadata

DEMO, DEPTH, COLOR = "data/demo_0", "data/demo_0/obs/agentview_depth", "data/demo_0/obs/agentview_image"
Change = Callable[[h5py.File, Path], None]
Capture = pytest.CaptureFixture[str]


def read_all(path: Path) -> None:
    """Everything that a reader gives of a recording."""
    streams = read_streams(choose_reader(path), path, Metadata(fps=20))
    for pictures in (streams.color, streams.depth):
        for k in range(len(pictures)):
            pictures.read(k)


def changed(path: Path, change: Change, secret: Path) -> Path:
    robomimic(path, demos=1)
    with h5py.File(path, "a") as f:
        change(f, secret)
    return path


def instead(name: str, make: Change) -> Change:
    def change(f: h5py.File, secret: Path) -> None:
        del f[name]
        make(f, secret)

    return change


def external_link(f: h5py.File, secret: Path) -> None:
    f[DEPTH] = h5py.ExternalLink(secret, "/secret")


def relative_link(f: h5py.File, secret: Path) -> None:
    f[DEPTH] = h5py.ExternalLink(f"../{secret.parent.name}/{secret.name}", "/secret")


def group_outside(f: h5py.File, secret: Path) -> None:
    f["data/demo_0"] = h5py.ExternalLink(secret, "/")


def soft_then_external(f: h5py.File, secret: Path) -> None:
    f["door"] = h5py.ExternalLink(secret, "/")
    f[DEPTH] = h5py.SoftLink("/door/secret")


def external_storage(f: h5py.File, secret: Path) -> None:
    f.create_dataset(DEPTH, (STEPS, 96, 128), "f4", external=[(secret, 0, STEPS * 96 * 128 * 4)])


def virtual(f: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((STEPS, 96, 128), "f4")
    layout[:] = h5py.VirtualSource(secret, "secret", (STEPS, 96, 128))
    f.create_virtual_dataset(DEPTH, layout)


def virtual_without_end(f: h5py.File, secret: Path) -> None:
    source = h5py.VirtualSource(secret, "secret", (STEPS, 96, 128), maxshape=(None, 96, 128))
    layout = h5py.VirtualLayout((STEPS, 96, 128), "f4", maxshape=(None, 96, 128))
    layout[0 : h5py.h5s.UNLIMITED] = source[0 : h5py.h5s.UNLIMITED]
    f.create_virtual_dataset(DEPTH, layout)


def soft_circle(f: h5py.File, _: Path) -> None:
    f[DEPTH] = h5py.SoftLink("/data/demo_0/obs/other")
    f["data/demo_0/obs/other"] = h5py.SoftLink("/data/demo_0/obs/agentview_depth")


def group_in_itself(f: h5py.File, _: Path) -> None:
    f["data/demo_0/obs/again"] = f["data/demo_0"]


def plug_in_filter(f: h5py.File, _: Path) -> None:
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_chunk((1, 96, 128))
    made.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, (3,))
    space = h5py.h5s.create_simple((STEPS, 96, 128))
    h5py.h5d.create(f.id, DEPTH.encode(), h5py.h5t.IEEE_F32LE, space, made)


def objects(f: h5py.File, _: Path) -> None:
    f.create_dataset(DEPTH, (STEPS,), h5py.ref_dtype)


def pickled(f: h5py.File, _: Path) -> None:
    f[DEPTH] = np.zeros(STEPS, h5py.opaque_dtype(np.dtype("M8[s]")))


def records(f: h5py.File, _: Path) -> None:
    f[DEPTH] = np.zeros(STEPS, [("a", "f4"), ("b", "i8")])


def huge_of_nothing(f: h5py.File, _: Path) -> None:
    f.create_dataset(DEPTH, (10**9, 96, 128), "f4", chunks=(1, 96, 128))


def endless_rows(f: h5py.File, _: Path) -> None:
    for name in (DEPTH, COLOR):
        f.pop(name, None)
    f.create_dataset(DEPTH, (2**21, 4, 4), "u2", chunks=(2**16, 4, 4))
    f.create_dataset(COLOR, (2**21, 4, 4, 3), "u1", chunks=(2**16, 4, 4, 3))


def tiny_chunks(f: h5py.File, _: Path) -> None:
    f.create_dataset(DEPTH, (STEPS, 960, 1280), "u2", chunks=(1, 1, 2))


def large_chunks(f: h5py.File, _: Path) -> None:
    f.create_dataset(DEPTH, (STEPS, 6000, 6000), "f4", chunks=(STEPS, 6000, 6000))


def large_picture(f: h5py.File, _: Path) -> None:
    f.create_dataset(DEPTH, (STEPS, 10_000, 20_000), "u1", chunks=(1, 1000, 20_000))


HOSTILE: dict[str, tuple[Change, str]] = {
    "an external link": (
        instead(DEPTH, external_link),
        "link to .*secret.h5.*, which is not followed",
    ),
    "an external link with ..": (instead(DEPTH, relative_link), "out of the file, which is not followed"),
    "an episode in another file": (instead("data/demo_0", group_outside), "out of the file, which is not followed"),
    "a soft link behind which is another file": (instead(DEPTH, soft_then_external), "out of the file"),
    "external storage": (instead(DEPTH, external_storage), "external storage.*h5repack"),
    "a virtual dataset": (instead(DEPTH, virtual), "virtual dataset.*h5repack"),
    "a virtual dataset without an end": (instead(DEPTH, virtual_without_end), "virtual dataset"),
    "a circle of soft links": (instead(DEPTH, soft_circle), "links to links"),
    "a group in itself": (group_in_itself, "lies in itself"),
    "a filter of a plug-in": (instead(DEPTH, plug_in_filter), "filter 32015 .*needs a plug-in.*h5repack"),
    "references": (instead(DEPTH, objects), "neither numbers nor bytes"),
    "opaque objects": (instead(DEPTH, pickled), "neither numbers nor bytes"),
    "records": (instead(DEPTH, records), "neither numbers nor bytes"),
    "a huge array that holds nothing": (instead(DEPTH, huge_of_nothing), "bytes in a file of .*, expected at most"),
    "two million rows": (endless_rows, "at most 1,000,000 rows"),
    "three million chunks": (instead(DEPTH, tiny_chunks), "3,072,000 chunks of 4 bytes"),
    "a chunk of 720 MB": (instead(DEPTH, large_chunks), "chunks of 720,000,000 bytes"),
    "a picture of 200 million pixels": (instead(DEPTH, large_picture), "shape|type|channel"),
}


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "away" / "secret.h5"
    path.parent.mkdir()
    with h5py.File(path, "w") as f:
        f["secret"] = filmed().depth.astype("f4")
    return path


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_hostile_is_refused_in_a_sentence(name: str, tmp_path: Path, secret: Path) -> None:
    change, words = HOSTILE[name]
    (tmp_path / "here").mkdir()
    path = changed(tmp_path / "here" / "demos.hdf5", change, secret)
    with pytest.raises((DataError, BadImage), match=words) as told:
        read_all(path)
    assert "\n" not in str(told.value)


_OPENED = re.compile(r'open(?:at)?\([^"]*"([^"]+)"')


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace tells which files are opened")
@pytest.mark.slow
@pytest.mark.parametrize("name", [*HOSTILE][:7])
def test_no_other_file_is_opened(name: str, tmp_path: Path, secret: Path) -> None:
    path = changed(tmp_path / "demos.hdf5", HOSTILE[name][0], secret)
    code = f"import sys; sys.path[:0] = {sys.path!r}; from flowlab.cli import main; main(*sys.argv[1:])"
    strace = ["strace", "-f", "-e", "trace=open,openat", sys.executable, "-c", code]
    run = [*strace, "track-real", str(path), "--dry-run"]
    done = subprocess.run(run, capture_output=True, text=True, env={**os.environ, "HDF5_PLUGIN_PATH": str(tmp_path)})
    assert str(path) in done.stderr
    assert not [x for x in _OPENED.findall(done.stderr) if x.endswith(secret.name)]


def bomb(path: Path, unpacked: int) -> Path:
    """A chunk that unpacks to far more than its place holds."""
    robomimic(path, demos=1)
    pack = zlib.compressobj(9)
    head = pack.compress(b"\0" * (1 << 24)) + pack.flush(zlib.Z_FULL_FLUSH)
    packed = head + (pack.compress(b"\0" * (1 << 24)) + pack.flush(zlib.Z_FULL_FLUSH)) * (unpacked >> 24)
    with h5py.File(path, "a") as f:
        del f[DEPTH]
        made = f.create_dataset(DEPTH, (STEPS, 96, 128), "f4", chunks=(1, 96, 128), compression="gzip")
        made[...] = filmed().depth
        made.id.write_direct_chunk((2, 0, 0), packed)
    return path


@pytest.mark.slow
def test_a_chunk_that_unpacks_to_gigabytes_takes_no_such_memory(tmp_path: Path) -> None:
    path = bomb(tmp_path / "d.hdf5", 3 << 30)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadImage, match="not readable as HDF5"):
        read_all(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1.2 * MAX_READER_BYTES / 1024


def test_a_file_that_makes_the_library_loop_is_refused_once_and_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One size in the heap of texts is such that the next object is the same one again."""
    path = robomimic(tmp_path / "d.hdf5", demos=1)
    content = bytearray(path.read_bytes())
    size = content.index(b"GCOL") + 24
    content[size : size + 8] = (2**64 - 16).to_bytes(8, "little")
    path.write_bytes(content)
    monkeypatch.setattr(helper_process, "PATIENCE_S", 1.0)
    for _ in range(2):
        start = time.monotonic()
        with pytest.raises(DataError, match=r"does not come to an end in 1 s on it, so it is damaged.*h5repack"):
            read_all(path)
    assert time.monotonic() - start < 0.9, "what hung once is not waited for again"
    read_all(robomimic(tmp_path / "other.hdf5", demos=1))


def test_a_crash_of_the_library_is_told(tmp_path: Path) -> None:
    path = robomimic(tmp_path / "d.hdf5", demos=1)
    streams = read_streams(choose_reader(path), path, Metadata(fps=20))
    pid = helper_process.HELPERS[hdf5_process._SERVE]._process.pid
    os.kill(pid, signal.SIGSTOP)
    threading.Timer(0.2, lambda: [os.kill(pid, s) for s in (signal.SIGSEGV, signal.SIGCONT)]).start()
    with pytest.raises(BadImage, match="crashes on it"):
        streams.depth.read(0)
    read_all(robomimic(tmp_path / "other.hdf5", demos=1))


def test_names_of_episodes_lead_nowhere(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as f:
        f.create_group("data/demo_ \x1b[31m")
    code, out, err = call_cli(capsys, "track-real", path, "--dry-run")
    assert code != 0
    assert "which is no plain name; rename it" in out + err
    assert "\x1b" not in out + err


def test_names_that_are_no_text_are_not_passed_over(tmp_path: Path, capsys: Capture) -> None:
    path = robomimic(tmp_path / "demos.hdf5", demos=1)
    with h5py.File(path, "a") as f:
        space = h5py.h5s.create_simple((STEPS, 3))
        h5py.h5d.create(f["data/demo_0/obs"].id, b"robot\xff_eef_pos", h5py.h5t.NATIVE_FLOAT, space)
    code, out, _ = call_cli(capsys, "track-real", path, "--dry-run")
    assert (code, "not used: " in out, "obs/robot\\xff_eef_pos" in out) == (0, True, True)
    with h5py.File(path, "a") as f:
        h5py.h5g.create(f["data"].id, b"demo_\xff")
    code, out, err = call_cli(capsys, "track-real", path, "--dry-run")
    assert (code, "which is no plain name; rename it" in out + err) == (3, True)


def test_a_path_into_a_file_that_is_no_name_is_one_sentence(tmp_path: Path, capsys: Capture) -> None:
    path = robomimic(tmp_path / "demos.hdf5", demos=1)
    code, _, err = call_cli(capsys, "track-real", path / "\x1b[31m", "--dry-run")
    assert code != 0
    assert "'\\x1b[31m' cannot be the name of a recording; rename it" in err


def test_json_of_a_stranger_is_no_camera(tmp_path: Path) -> None:
    for text, words in (("{", "not valid JSON"), ('{"agentview": {"intrinsics": "none"}}', "no numbers"),
                        ('{"agentview": {"intrinsics": [[1, 2], [3]]}}', "no numbers"),
                        ('{"agentview": {"intrinsics": [[1e400,0,1],[0,1,1],[0,0,1]]}}', "finite")):  # fmt: skip
        path = robomimic(tmp_path / "d.hdf5", demos=1)
        with h5py.File(path, "a") as f:
            f[DEMO].attrs["camera_info"] = text
        with pytest.raises(DataError, match=words):
            read_all(path)


def test_what_is_called_hdf5_and_is_none(tmp_path: Path, capsys: Capture) -> None:
    for content in (b"", b"x", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(200)):
        path = tmp_path / "d.hdf5"
        path.write_bytes(content)
        code, out, err = call_cli(capsys, "track-real", path, "--dry-run")
        assert code != 0
        assert "its content is none" in err or "not readable as HDF5" in out + err


def test_a_soft_link_that_stays_in_the_file_is_followed(tmp_path: Path) -> None:
    path = robomimic(tmp_path / "d.hdf5", demos=1)
    with h5py.File(path, "a") as f:
        f.move(DEPTH, "elsewhere/depth")
        f[DEPTH] = h5py.SoftLink("/elsewhere/depth")
    read_all(path)


def test_damage_anywhere_is_told(tmp_path: Path) -> None:
    """Bytes are flipped all over small files; there are streams or a sentence, never another error."""
    rng = np.random.default_rng(0)
    for write in (robomimic, maniskill, robotwin):
        whole = write(tmp_path / "d.hdf5").read_bytes()
        for _ in range(20):
            content = bytearray(whole)
            for at in rng.integers(0, len(content), 40):
                content[at] ^= int(rng.integers(1, 256))
            for at in rng.integers(0, 4000, 3):
                content[at] ^= int(rng.integers(1, 256))
            path = tmp_path / "damaged.hdf5"
            path.write_bytes(content)
            with suppress(DataError, BadImage):
                read_all(path)


def test_without_the_library_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    path: Any = robomimic(tmp_path / "d.hdf5")
    monkeypatch.setitem(sys.modules, "h5py", None)
    write_yaml(tmp_path / "d.yaml", fps=20)
    code, _, err = call_cli(capsys, "track-real", path, "--dry-run")
    assert code == 1
    assert "'pip install flowlab[hdf5]'" in err
