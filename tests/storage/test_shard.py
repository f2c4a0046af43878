"""A shard gives back what was put into it, bit for bit, or says which file is damaged."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from numcodecs import Zstd
from synthetic import CAMERA, assert_same, make_episode, unzipped, with_quality
from thoroughness import examples
from zarr.storage import ZipStore

from flowlab.errors import DataError
from flowlab.files import remove_leftovers
from flowlab.records import Entity, Episode, Role
from flowlab.storage.schema import QUALITY
from flowlab.storage.shard import STEPS_PER_CHUNK, Shard, episode_digest, write_shard

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])}
ARRAYS = {
    "data/time", "data/point_cloud", "data/point_count", "data/state", "data/action", "data/success", "data/tracks",
    "data/visible", "data/object_pose", "meta/seed", "meta/success", "meta/query_owner", "meta/query_role",
    "meta/query_count", "meta/query_xyz", "meta/association_distance", "meta/episode_ends",
}  # fmt: skip


def any_bits(rng: np.random.Generator, like: np.ndarray) -> np.ndarray:
    """An array of random bits: NaN, infinity and negative zero included."""
    return np.frombuffer(rng.bytes(like.nbytes), like.dtype).reshape(like.shape).copy()


def scrambled(episode: Episode, seed: int) -> Episode:
    rng = np.random.default_rng(seed)
    quality = episode.tracks.quality
    if quality is not None:
        measured = ("sigma", "source", "forward_backward", "disagreement", "residual")
        quality = replace(quality, **{name: any_bits(rng, getattr(quality, name)) for name in measured})
    return replace(
        episode,
        **{
            name: any_bits(rng, values)
            for name in ("point_cloud", "point_count", "state", "action", "object_pose", "depth", "rgb")
            if (values := getattr(episode, name)) is not None
        },
        success=rng.random(len(episode)) < 0.5,
        tracks=replace(episode.tracks, xyz_world=any_bits(rng, episode.tracks.xyz_world), quality=quality),
    )


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)  # fmt: skip


@settings(max_examples=examples(20), deadline=None)
@given(
    lengths=st.lists(st.integers(1, 40), min_size=1, max_size=4),
    points=st.integers(1, 30),
    queries=st.integers(1, 9),
    options=st.fixed_dictionaries({name: st.booleans() for name in ("object_pose", "depth", "rgb")}),
    estimated=st.booleans(),
    extras=st.dictionaries(st.text(), json_values, max_size=3),
    seed=st.integers(0, 2**31),
)
def test_episodes_come_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory,
    lengths: list[int],
    points: int,
    queries: int,
    options: dict[str, bool],
    estimated: bool,
    extras: dict[str, Any],
    seed: int,
) -> None:
    path = tmp_path_factory.mktemp("shard") / "unit.zarr.zip"
    made = [make_episode(seed + k, steps=n, points=points, queries=queries, **options) for k, n in enumerate(lengths)]
    made = [replace(scrambled(with_quality(e, e.seed) if estimated else e, e.seed), extras=extras) for e in made]
    write_shard(path, made, "digest")
    shard = Shard(path)
    assert len(shard) == len(made)
    for k, (put, got) in enumerate(zip(made, shard.episodes(), strict=True)):
        assert_same(put, got)
        assert_same(put, shard.episode(k))
        assert episode_digest(put) == episode_digest(got)


@pytest.fixture
def episodes() -> list[Episode]:
    return [make_episode(0, steps=10), make_episode(1, steps=20)]


@pytest.fixture
def zipped(tmp_path: Path, episodes: list[Episode]) -> Path:
    write_shard(tmp_path / "unit.zarr.zip", episodes, "digest")
    return tmp_path / "unit.zarr.zip"


@pytest.fixture
def path(zipped: Path) -> Path:
    """The shard as a folder, whose files can be looked at, and damaged."""
    return unzipped(zipped)


def put(folder: Path, episodes: list[Episode]) -> Path:
    """A shard that is a folder."""
    write_shard(folder.with_name(f"{folder.name}.zip"), episodes, "")
    return unzipped(folder.with_name(f"{folder.name}.zip"))


def test_what_lies_on_disk_is_documented_zarr_v3(path: Path) -> None:
    root = json.loads((path / "zarr.json").read_text())
    assert (root["zarr_format"], root["node_type"]) == (3, "group")
    assert root["attributes"]["settings_digest"] == "digest"
    assert root["attributes"]["camera"] == CAMERA.to_json()
    found = {str(f.parent.relative_to(path)): json.loads(f.read_text()) for f in path.rglob("zarr.json")}
    arrays = {name: meta for name, meta in found.items() if meta["node_type"] == "array"}
    assert arrays.keys() == ARRAYS
    for name, meta in arrays.items():
        assert meta["zarr_format"] == 3
        assert len(meta["dimension_names"]) == len(meta["shape"]), name
        assert all(meta["dimension_names"]), name
        assert meta["dimension_names"][0] == ("time" if name.startswith("data/") else "episode")
        assert meta["attributes"]["unit"], name
        assert len(meta["attributes"]["meaning"]) > 10, name
        assert [c["name"] for c in meta["codecs"]] == ["bytes", "zstd", "crc32c"], name
    assert arrays["data/tracks"]["shape"] == [30, 8, 3]
    assert arrays["data/tracks"]["attributes"]["unit"] == "m"


def crc32c(data: bytes) -> int:
    """Castagnoli's checksum, by its definition."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def test_chunks_decode_by_hand_and_carry_a_right_checksum(path: Path, episodes: list[Episode]) -> None:
    assert crc32c(b"123456789") == 0xE3069283  # the check value of the standard
    raw = (path / "data/action/c/0/0").read_bytes()
    body, checksum = raw[:-4], raw[-4:]
    assert int.from_bytes(checksum, "little") == crc32c(body)
    assert Zstd().decode(body) == np.concatenate([e.action for e in episodes]).astype("<f4").tobytes()


def test_long_shards_are_cut_into_chunks(tmp_path: Path) -> None:
    long = make_episode(0, steps=2 * STEPS_PER_CHUNK + 3, points=4, queries=2)
    put(tmp_path / "long.zarr", [long])
    assert sorted(p.name for p in (tmp_path / "long.zarr/data/tracks/c").iterdir()) == ["0", "1", "2"]
    meta = json.loads((tmp_path / "long.zarr/data/tracks/zarr.json").read_text())
    assert meta["chunk_grid"]["configuration"]["chunk_shape"] == [STEPS_PER_CHUNK, 2, 3]
    second = Zstd().decode((tmp_path / "long.zarr/data/tracks/c/1/0/0").read_bytes()[:-4])
    assert second == long.tracks.xyz_world[STEPS_PER_CHUNK : 2 * STEPS_PER_CHUNK].tobytes()
    assert_same(long, Shard(tmp_path / "long.zarr").episode(0))


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-7])


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def empty(file: Path) -> None:
    file.write_bytes(b"")


@pytest.mark.parametrize("harm", [truncate, flip, empty, Path.unlink])
@pytest.mark.parametrize("chunk", ["data/tracks/c/0/0/0", "data/success/c/0", "meta/query_owner/c/0/0"])
def test_a_damaged_chunk_is_an_error_that_names_the_array(path: Path, chunk: str, harm: Callable[[Path], None]) -> None:
    harm(path / chunk)
    array = chunk.partition("/c/")[0]
    with pytest.raises(DataError, match=rf"{path}/{array}: .*(damaged|missing).*.*with --repair"):
        list(Shard(path).episodes())
    with pytest.raises(DataError, match=f"{path}/{array}: "):
        Shard(path).episode(1)


@pytest.mark.parametrize("array", ["data/tracks", "meta/seed", "meta/episode_ends"])
def test_a_missing_array_is_an_error_that_names_it(path: Path, array: str) -> None:
    shutil.rmtree(path / array)
    with pytest.raises(DataError, match=f"{path}/{array}: the array is missing"):
        list(Shard(path).episodes())


def test_of_the_arrays_of_quality_none_may_be_missing(tmp_path: Path) -> None:
    put(tmp_path / "unit.zarr", [with_quality(make_episode())])
    shutil.rmtree(tmp_path / "unit.zarr/data/source")
    with pytest.raises(DataError, match="data/source: the array is missing"):
        Shard(tmp_path / "unit.zarr").episode(0)
    for name in QUALITY:
        shutil.rmtree(tmp_path / "unit.zarr" / name, ignore_errors=True)
    assert Shard(tmp_path / "unit.zarr").episode(0).tracks.quality is None


def test_a_recording_without_a_robot_is_stored_too(tmp_path: Path) -> None:
    """Neither state nor action: arrays with rows, and nothing in them."""
    nothing = np.zeros((12, 0), np.float32)
    watched = replace(make_episode(), state=nothing, action=nothing)
    write_shard(tmp_path / "unit.zarr.zip", [watched], "")
    assert_same(watched, Shard(tmp_path / "unit.zarr.zip").episode(0))


def test_describing_a_shard_that_lacks_an_array_says_so(path: Path) -> None:
    shutil.rmtree(path / "meta/episode_ends")
    with pytest.raises(DataError, match="meta/episode_ends"):
        Shard(path).describe()


@pytest.mark.parametrize("content", ["", "{", '{"zarr_format": 3, "node_type": "group", "attributes": {}}'])
def test_a_broken_group_is_an_error_that_names_the_shard(path: Path, content: str) -> None:
    (path / "zarr.json").write_text(content)
    with pytest.raises(DataError, match=str(path)):
        len(Shard(path))
    with pytest.raises(DataError, match=str(path)):
        list(Shard(path).episodes())


def test_values_that_are_all_zero_are_stored_all_the_same(tmp_path: Path) -> None:
    """Otherwise a lost chunk could pass for one that was never written."""
    failed = replace(make_episode(0), success=np.zeros(12, bool))
    put(tmp_path / "unit.zarr", [failed])
    assert (tmp_path / "unit.zarr/data/success/c/0").stat().st_size > 0
    assert not Shard(tmp_path / "unit.zarr").episode(0).success.any()
    (tmp_path / "unit.zarr/data/success/c/0").unlink()
    with pytest.raises(DataError, match="1 of 1 chunks missing"):
        Shard(tmp_path / "unit.zarr").episode(0)


def _with_name(archive: zipfile.ZipFile, name: str, link: bool = False) -> None:
    about = zipfile.ZipInfo(name)
    about.external_attr = (0o120777 if link else 0o644) << 16
    archive.writestr(about, "../../x")


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("name", "link", "told"),
    [
        ("../x", False, "called '../x'"),
        ("data/../../x", False, "called 'data/../../x'"),
        ("/abs", False, "called '/abs'"),
        ("zarr.json", False, "two of its files have one name"),
        ("data/elsewhere", True, "'data/elsewhere' in it is a link"),
    ],
)
def test_a_zip_that_others_made_odd_is_one_sentence(zipped: Path, name: str, link: bool, told: str) -> None:
    with zipfile.ZipFile(zipped, "a") as archive:
        _with_name(archive, name, link)
    with pytest.raises(DataError, match=re.escape(told)):
        Shard(zipped)
    assert [p.name for p in zipped.parent.iterdir()] == [zipped.name]


def test_a_zip_with_something_before_it_is_one_sentence(zipped: Path) -> None:
    zipped.write_bytes(b"#!/bin/sh\n" + zipped.read_bytes())
    with pytest.raises(DataError, match="something stands before its first file"):
        Shard(zipped)


def test_writing_onto_a_shard_replaces_it(zipped: Path) -> None:
    other = make_episode(5, steps=7, object_pose=False)
    write_shard(zipped, [other], "digest")
    assert [e.seed for e in Shard(zipped).episodes()] == [5]
    assert_same(other, Shard(zipped).episode(0))
    assert [p.name for p in zipped.parent.iterdir()] == [zipped.name]


def test_the_same_episodes_give_the_same_bytes(tmp_path: Path, zipped: Path, episodes: list[Episode]) -> None:
    write_shard(tmp_path / "again.zarr.zip", episodes, "digest")
    assert (tmp_path / "again.zarr.zip").read_bytes() == zipped.read_bytes()


MIXED = {
    "cameras": lambda e: replace(e, camera=replace(e.camera, K=e.camera.K * [[2], [2], [1]])),
    "things": lambda e: replace(e, queries=replace(e.queries, entities=(Entity("x", "x", Role.ROBOT),) * 2)),
    "arrays": lambda e: replace(e, object_pose=None),
    "kinds of tracks": with_quality,
}
"""Episodes that one shard cannot tell apart: it has one camera, one list of things, one set of arrays."""


@pytest.mark.parametrize("what", MIXED)
def test_episodes_that_do_not_go_together_are_refused(tmp_path: Path, episodes: list[Episode], what: str) -> None:
    with pytest.raises(DataError, match="one shard"):
        write_shard(tmp_path / "unit.zarr.zip", [episodes[0], MIXED[what](episodes[1])], "")
    assert list(tmp_path.iterdir()) == []


def test_the_digest_of_an_episode_does_not_depend_on_its_shard(tmp_path: Path, episodes: list[Episode]) -> None:
    for k, group in enumerate([episodes, episodes[1:], episodes[::-1]]):
        write_shard(tmp_path / f"{k}.zarr.zip", group, str(k))
    digests = [{e.seed: episode_digest(e) for e in Shard(tmp_path / f"{k}.zarr.zip").episodes()} for k in range(3)]
    assert digests[0] == digests[2]
    assert digests[0][1] == digests[1][1] == episode_digest(episodes[1])
    assert digests[0][0] != digests[0][1]


def test_the_digest_changes_with_everything_that_is_stored() -> None:
    plain = with_quality(make_episode(0, depth=True, rgb=True))
    q, tr = plain.queries, plain.tracks

    def nudged(a: np.ndarray | None) -> np.ndarray:
        """The least change: one bit of one element."""
        assert a is not None
        b = a.copy()
        b.reshape(-1).view(np.uint8)[0] ^= 1
        return b

    columns = ("point_cloud", "point_count", "state", "action", "success", "object_pose", "depth", "rgb")
    changed = [replace(plain, **{name: nudged(getattr(plain, name))}) for name in columns]
    changed += [replace(plain, **{name: None}) for name in ("object_pose", "depth", "rgb")]
    changed += [replace(plain, tracks=replace(tr, **{n: nudged(getattr(tr, n))})) for n in
                ("xyz_world", "visible", "association_distance")]  # fmt: skip
    assert tr.quality is not None
    changed += [
        replace(plain, tracks=replace(tr, quality=replace(tr.quality, **{f.name: nudged(getattr(tr.quality, f.name))})))
        for f in fields(tr.quality)
    ]
    changed += [replace(plain, tracks=replace(tr, quality=None))]
    changed += [replace(plain, queries=replace(q, **{n: nudged(getattr(q, n))})) for n in ("xyz_world", "owner")]
    changed += [
        replace(plain, queries=replace(q, count=q.count - 1)),
        replace(plain, task="other"),
        replace(plain, seed=1),
        replace(plain, extras={"rand_vec": [0.0]}),
        replace(plain, camera=replace(plain.camera, K=plain.camera.K * [[2], [2], [1]])),
    ]
    digests = [episode_digest(e) for e in [plain, *changed]]
    assert len(set(digests)) == len(digests)


KILLED = """
import os, random, signal, sys, time
from pathlib import Path
from synthetic import make_episode
from flowlab.storage.shard import write_shard

folder, rounds, over = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "over"
rng = random.Random(0)

def die_at(number):
    # at the n-th time that a file is brought to the disk or to its name
    left = [number]
    def counted(function):
        def call(*a):
            left[0] -= 1
            if not left[0]:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*a)
        return call
    os.fsync, os.replace = counted(os.fsync), counted(os.replace)

old, new = (make_episode(k, steps=300) for k in (1, 2))
for name in ["../warm", *(range(rounds) if over else ())]:
    write_shard(folder / f"{name}.zarr.zip", [old], "")
for k in range(rounds):
    pid = os.fork()
    if not pid:
        if k % 4 == 0:  # so that some are hit as they write on the busiest machine
            die_at(1 + k // 4 % 3)
        write_shard(folder / f"{k}.zarr.zip", [new], "")
        os._exit(0)
    while not (begun := any(str(pid) in name for name in os.listdir(folder))):
        if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            break
    if begun and k % 4 and k < rounds - 1:  # the last may live
        time.sleep(rng.uniform(0, 0.003))
        os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
"""


@pytest.mark.parametrize(
    "over", [pytest.param(False, marks=pytest.mark.slow), True], ids=["fresh", "over an old shard"]
)
def test_a_writer_that_is_killed_leaves_a_whole_shard_or_none(tmp_path: Path, over: bool) -> None:
    """Killed at random moments of the write, in many rounds."""
    rounds = 40
    script, folder = tmp_path / "killed.py", tmp_path / "shards"
    script.write_text(KILLED)
    folder.mkdir()
    command = [sys.executable, script, folder, str(rounds), "over" if over else "fresh"]
    subprocess.run(command, env=ENVIRONMENT, check=True, timeout=120)
    old, new = (episode_digest(make_episode(k, steps=300)) for k in (1, 2))
    shards = [p for k in range(rounds) if (p := folder / f"{k}.zarr.zip").exists()]
    assert {episode_digest(Shard(p).episode(0)) for p in shards} <= {old, new}
    assert any(folder.glob(".tmp-*")), "no writer was killed as it wrote: nothing was tested"
    remove_leftovers(folder)
    assert set(folder.iterdir()) == set(shards)


WRITES_HALF = """
import socket, sys
from pathlib import Path
machine = sys.argv[2] or socket.gethostname()
socket.gethostname = lambda: machine
import flowlab.files as files
from flowlab.storage.shard import write_shard
from synthetic import make_episode

def stop(*_):
    print(flush=True)
    sys.stdin.read()
    files.os._exit(0)

files.os.replace = stop
write_shard(Path(sys.argv[1]) / "unit.zarr.zip", [make_episode()], "")
"""


def leave_half(folder: Path, machine: str = "") -> tuple[Path, subprocess.Popen[str]]:
    """What a writer has left so far, and the writer, which waits for its input to end."""
    before = set(folder.iterdir())
    command = [sys.executable, "-c", WRITES_HALF, folder, machine]
    writer = subprocess.Popen(command, env=ENVIRONMENT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert writer.stdout
    writer.stdout.readline()
    (left,) = set(folder.iterdir()) - before
    return left, writer


def test_leftovers_of_the_dead_go_and_those_of_the_living_stay(tmp_path: Path) -> None:
    write_shard(tmp_path / "other.zarr.zip", [make_episode()], "")
    left, writer = leave_half(tmp_path)
    remove_leftovers(tmp_path)
    assert set(tmp_path.iterdir()) == {left, tmp_path / "other.zarr.zip"}
    writer.communicate()
    remove_leftovers(tmp_path)
    assert set(tmp_path.iterdir()) == {tmp_path / "other.zarr.zip"}


@pytest.mark.parametrize("suffix", ["-b", "-99999999", "b"])
def test_leftovers_of_other_machines_stay(tmp_path: Path, suffix: str) -> None:
    """Machines of a cluster are called node-1 and node-1-2; the latter's work is not for the former to remove."""
    left, writer = leave_half(tmp_path, socket.gethostname() + suffix)
    writer.communicate()
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [left]


WRITES_OFTEN = """
import sys
from pathlib import Path
from synthetic import make_episode
from flowlab.storage.shard import write_shard
for _ in range(12):
    write_shard(Path(sys.argv[1]) / "unit.zarr.zip", [make_episode()], "")
"""


def test_two_jobs_may_write_the_same_shard(tmp_path: Path) -> None:
    """As happens where both make good the same failed seed."""
    jobs = [
        subprocess.Popen([sys.executable, "-c", WRITES_OFTEN, tmp_path], env=ENVIRONMENT, stderr=subprocess.PIPE)
        for _ in range(3)
    ]
    assert [job.communicate()[1].decode()[-500:] for job in jobs] == [""] * 3
    assert_same(make_episode(), Shard(tmp_path / "unit.zarr.zip").episode(0))
    assert [p.name for p in tmp_path.iterdir()] == ["unit.zarr.zip"]


@pytest.mark.parametrize("form", ["zip", "folder"])
def test_other_zarr_readers_see_plain_arrays(zipped: Path, form: str, episodes: list[Episode]) -> None:
    group = zarr.open_group(unzipped(zipped) if form == "folder" else ZipStore(zipped, mode="r"), mode="r")
    tracks, ends = group["data/tracks"], group["meta/episode_ends"]
    assert isinstance(tracks, zarr.Array)
    assert isinstance(ends, zarr.Array)
    assert np.array_equal(ends[...], [10, 30])
    assert np.array_equal(tracks[10:30], episodes[1].tracks.xyz_world)


def test_every_array_is_what_zarr_reads(zipped: Path) -> None:
    group, shard = zarr.open_group(ZipStore(zipped, mode="r"), mode="r"), Shard(zipped)
    for spec in shard.specs():
        array = group[spec.path]
        assert isinstance(array, zarr.Array)
        for rows in (slice(None), slice(1, 2), slice(0, 1)):
            assert_same(np.asarray(array[rows]), shard.array(spec.path, rows), spec.path)


@settings(max_examples=examples(200), deadline=None)
@given(data=st.data())
def test_a_flipped_bit_is_an_error_or_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder, made = tmp_path_factory.mktemp("flip"), [make_episode(k, steps=5, points=6, queries=3) for k in range(2)]
    path = folder / "unit.zarr.zip"
    write_shard(path, made, "digest")
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    try:
        found = list(Shard(path).episodes())
    except DataError:
        return
    for a, b in zip(made, found, strict=True):
        assert_same(a, b)


def rezipped(path: Path, change: Callable[[dict[str, bytes]], object], **how: int) -> None:
    """The shard as a stranger could make it."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    change(files)
    with zipfile.ZipFile(path, "w", **how) as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def claim(array: str, **values: object) -> Callable[[dict[str, bytes]], object]:
    name = f"{array}/zarr.json"
    return lambda files: files.update({name: json.dumps(json.loads(files[name]) | values).encode()})


def grid(*shape: int) -> dict[str, object]:
    return {"name": "regular", "configuration": {"chunk_shape": list(shape)}}


BOMBS: dict[str, Callable[[dict[str, bytes]], object]] = {
    "more rows than there are": claim("data/tracks", shape=[10**12, 8, 3]),
    "a chunk of a terabyte": claim("data/tracks", shape=[10**12, 8, 3], chunk_grid=grid(10**12, 8, 3)),
    "rows as wide as the world": claim("data/tracks", shape=[30, 10**9, 3], chunk_grid=grid(30, 10**9, 3)),
    "no shape": claim("data/tracks", shape=[]),
    "a negative shape": claim("data/tracks", shape=[-1, 8, 3]),
    "text for a shape": claim("data/tracks", shape="many"),
    "another codec": claim("data/tracks", codecs=[{"name": "numcodecs.pickle"}]),
    "codecs that are none": claim("data/tracks", codecs=3),
    "objects": claim("data/tracks", data_type="object"),
    "a type that is none": claim("data/tracks", data_type={"name": "x"}),
    "a list for an array": lambda files: files.update({"data/tracks/zarr.json": b"[]"}),
    "metadata nested deep": lambda files: files.update({"zarr.json": b"[" * 10_000}),
    "episodes that are none": lambda files: files.update({"zarr.json": b'{"attributes": {"episodes": 3}}'}),
    "a camera that is none": lambda files: files.update(
        {"zarr.json": json.dumps(_with_attributes(files, camera={"width": "x"})).encode()}
    ),
    "entities that are none": lambda files: files.update(
        {"zarr.json": json.dumps(_with_attributes(files, entities=[["a", "b", "nobody"]])).encode()}
    ),
}


def _with_attributes(files: dict[str, bytes], **values: object) -> dict[str, object]:
    group = json.loads(files["zarr.json"])
    return group | {"attributes": group["attributes"] | values}


@pytest.mark.parametrize("what", BOMBS)
def test_a_shard_that_claims_what_it_is_not_is_one_sentence(zipped: Path, what: str) -> None:
    rezipped(zipped, BOMBS[what])
    with pytest.raises(DataError, match=str(zipped)) as error:
        list(Shard(zipped).episodes())
    assert len(str(error.value)) < 800


def test_a_zip_that_would_unpack_is_refused(zipped: Path) -> None:
    rezipped(zipped, lambda files: None, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(DataError, match="expected a zip that only stores"):
        Shard(zipped)


@pytest.mark.parametrize("content", [b"", b"PK", b"no zip at all" * 100])
def test_what_is_no_zip_is_one_sentence(zipped: Path, content: bytes) -> None:
    zipped.write_bytes(content)
    with pytest.raises(DataError, match=r"not a readable shard .*with --repair"):
        Shard(zipped)
