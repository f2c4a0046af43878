"""`flowlab validate` finds one harm as one line that names the file, and nothing in a sound dataset."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zarr
from conftest import Cli
from synthetic import (
    as_folders,
    call_cli,
    edit_json,
    make_dataset,
    make_episode,
    make_receipt,
    unzipped,
    with_quality,
    with_tracks,
)
from zarr.codecs import Crc32cCodec, ZstdCodec

from flowlab.errors import DataError
from flowlab.records import Episode, PositionSource
from flowlab.storage.dataset import Dataset
from flowlab.storage.receipts import Reject, keep_receipt, read_receipts
from flowlab.storage.shard import Shard, episode_digest, write_shard
from flowlab.storage.stats import summarize
from flowlab.storage.validation import validate

UNIT = "drawer-open-000000-000001"
"""Two episodes of 96 steps."""
SHARD = f"shards/{UNIT}.zarr"
RECEIPT = f"receipts/{UNIT}.json"
PER_EPISODE = ("accepted", "frames", "digests")
OFF_SURFACE = "visible points lie off the surface; the labels do not fit the cloud"


def put_shard(folder: Path, episodes: list[Episode], settings_digest: str) -> None:
    zipped = folder.with_name(f"{folder.name}.zip")
    write_shard(zipped, episodes, settings_digest)
    unzipped(zipped)


def relabel(change: Callable[[Episode], Episode], receipt_too: bool = True) -> Callable[[Path], None]:
    """A pipeline that stores the second episode wrong, and (``receipt_too``) believes in it."""

    def harm(dataset: Path) -> None:
        shard = Shard(dataset / SHARD)
        first, second = shard.episodes()
        second = change(second)
        shutil.rmtree(dataset / SHARD)
        put_shard(dataset / SHARD, [first, second], shard.attributes.settings_digest)
        if receipt_too:
            digests = [episode_digest(first), episode_digest(second)]
            edit_json(dataset / RECEIPT, lambda r: r.update(digests=digests, stats=summarize([first, second])))

    return harm


def rewrite(array: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Another program stores an array anew, with valid checksums."""

    def harm(dataset: Path) -> None:
        group = zarr.open_group(dataset / SHARD, mode="r+")
        values = change(np.asarray(group[array]))
        codecs = [ZstdCodec(level=3), Crc32cCodec()]
        group.create_array(array, data=values, chunks=values.shape, compressors=codecs, overwrite=True)

    return harm


def on_file(name: str, do: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda dataset: do(dataset / name)


def flip_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0x10
    path.write_bytes(content)


def copy_unit(dataset: Path) -> None:
    """The second episode again, in a unit of its own."""
    source, name = Shard(dataset / SHARD), "drawer-open-000007"
    put_shard(dataset / f"shards/{name}.zarr", [source.episode(1)], source.attributes.settings_digest)
    copy, stats = shutil.copy(dataset / RECEIPT, dataset / f"receipts/{name}.json"), summarize([source.episode(1)])
    edit_json(Path(copy), lambda r: r.update(unit=name, seeds=[1], stats=stats, **{k: r[k][1:] for k in PER_EPISODE}))


def moved(meters: tuple[float, float, float]) -> Callable[[Episode], Episode]:
    return lambda e: with_tracks(e, e.tracks.xyz_world + np.array(meters, np.float32))


def frozen(e: Episode) -> Episode:
    return with_tracks(e, np.repeat(e.tracks.xyz_world[:1], len(e), 0))


def teleport(e: Episode) -> Episode:
    xyz = e.tracks.xyz_world.copy()
    xyz[40:, 17, 0] += 0.2
    return with_tracks(e, xyz)


def not_a_number(e: Episode) -> Episode:
    state = e.state.copy()
    state[33, 2] = np.nan
    return replace(e, state=state)


def too_far(e: Episode) -> Episode:
    action = e.action.copy()
    action[5, 0] = -1.5
    return replace(e, action=action)


def impossible_count(e: Episode) -> Episode:
    return replace(e, point_count=np.full_like(e.point_count, 1025))


def loose_anchor(e: Episode) -> Episode:
    return replace(e, queries=replace(e.queries, xyz_world=e.queries.xyz_world + np.float32(0.001)))


class Harm(NamedTuple):
    do: Callable[[Path], object]
    file: str
    says: str


TRACKS, ENDS = f"{SHARD}/data/tracks", f"{SHARD}/meta/episode_ends"
HARMS = {
    "chunk missing": Harm(on_file(f"{TRACKS}/c/0/0/0", Path.unlink), TRACKS, "1 of 1 chunks missing"),
    "chunk truncated": Harm(
        on_file(f"{SHARD}/data/point_cloud/c/0/0/0", lambda f: f.write_bytes(f.read_bytes()[:5000])),
        f"{SHARD}/data/point_cloud",
        "damaged",
    ),
    "byte flipped": Harm(on_file(f"{SHARD}/data/action/c/0/0", flip_byte), f"{SHARD}/data/action", "damaged"),
    "array missing": Harm(on_file(f"{SHARD}/meta/query_role", shutil.rmtree), f"{SHARD}/meta/query_role", "is missing"),
    "ends missing": Harm(on_file(ENDS, shutil.rmtree), ENDS, "is missing"),
    "metadata broken": Harm(on_file(f"{TRACKS}/zarr.json", lambda f: f.write_text("{")), TRACKS, "not valid JSON"),
    "optional metadata broken": Harm(
        on_file(f"{SHARD}/data/object_pose/zarr.json", lambda f: f.write_text("{")),
        SHARD,
        "object_pose/zarr.json: not valid JSON",
    ),
    "group broken": Harm(on_file(f"{SHARD}/zarr.json", lambda f: f.write_text("{")), SHARD, "not valid JSON"),
    "group of something else": Harm(
        on_file(f"{SHARD}/zarr.json", lambda f: edit_json(f, lambda g: g.update(attributes={}))), SHARD, ""
    ),
    "ends that fall": Harm(
        rewrite("meta/episode_ends", lambda a: a[::-1].copy()), ENDS, "must rise from above 0"
    ),
    "wrong shape": Harm(
        rewrite("data/tracks", lambda a: a[:, :99]), TRACKS, "(192, 99, 3), expected (192, 100, 3)"
    ),
    "wrong type": Harm(
        rewrite("data/state", lambda a: a.astype("float64")), f"{SHARD}/data/state", "float64, expected float32"
    ),
    "not a number": Harm(relabel(not_a_number), f"{SHARD}/data/state", "seed 1: not finite at step 33"),
    "time stands still": Harm(
        relabel(lambda e: replace(e, time_s=e.time_s.clip(max=0.5))),
        f"{SHARD}/data/time",
        "does not rise after step 40",
    ),
    "teleport": Harm(relabel(teleport), TRACKS, "seed 1: point 17 jumps 0.2"),
    "tracks 6 cm up": Harm(relabel(moved((0, 0, 0.06))), TRACKS, OFF_SURFACE),
    "tracks 6 cm aside": Harm(relabel(moved((0, 0.06, 0))), TRACKS, OFF_SURFACE),
    "tracks frozen": Harm(relabel(frozen), TRACKS, OFF_SURFACE),
    "loose anchor": Harm(relabel(loose_anchor), TRACKS, "1.73 mm from where it was anchored"),
    "impossible count": Harm(relabel(impossible_count), f"{SHARD}/data/point_count", "from 1025 to 1025, not"),
    "action beyond 1": Harm(relabel(too_far), f"{SHARD}/data/action", "seed 1: reaches -1.5"),
    "plausible, but changed": Harm(
        relabel(moved((0, 0, 1e-6)), receipt_too=False), SHARD, "seed 1: content differs from what its receipt says"
    ),
    "same seed twice": Harm(copy_unit, "shards/drawer-open-000007.zarr", "drawer-open seed 1 is also in"),
    "other settings": Harm(
        on_file(f"{SHARD}/zarr.json", lambda f: edit_json(f, lambda g: g["attributes"].update(settings_digest="0"))),
        SHARD,
        "made with other settings than flowlab.json states",
    ),
    "receipt without shard": Harm(on_file(SHARD, shutil.rmtree), SHARD, "missing, but"),
    "shard without receipt": Harm(
        lambda d: shutil.copytree(d / SHARD, d / "shards/drawer-open-000009.zarr"),
        "shards/drawer-open-000009.zarr",
        "has no receipt, so it does not count",
    ),
    "receipt broken": Harm(on_file(RECEIPT, lambda f: f.write_text("{")), RECEIPT, "not valid JSON"),
    "receipt of other seeds": Harm(
        on_file(RECEIPT, lambda f: edit_json(f, lambda r: r.update(accepted=[0, 5]))), SHARD, "seed"
    ),
    "receipt of other lengths": Harm(
        on_file(RECEIPT, lambda f: edit_json(f, lambda r: r.update(frames=[90, 102]))), SHARD, "frames"
    ),
    "manifest missing": Harm(on_file("flowlab.json", Path.unlink), "", "not a flowlab dataset"),
}  # fmt: skip


@pytest.fixture(scope="module")
def one_unit(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dataset, as if only its first unit had been asked for: quick to check."""
    data = tmp_path_factory.mktemp("unit") / "d"
    (data / "receipts").mkdir(parents=True)
    (data / "shards").mkdir()
    shutil.copy(small_dataset / f"{SHARD}.zip", data / f"{SHARD}.zip")
    shutil.copy(small_dataset / RECEIPT, data / RECEIPT)
    shutil.copy(small_dataset / "flowlab.json", data)
    edit_json(data / "flowlab.json", lambda m: m.update(requested={"drawer-open": 2}))
    return as_folders(data)


@pytest.mark.parametrize("name", HARMS)
def test_one_harm_is_one_finding_that_names_the_file(
    name: str, one_unit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(one_unit, tmp_path / "d")
    harm = HARMS[name]
    harm.do(data)
    code, output, errors = call_cli(capsys, "validate", data)
    lines = output.splitlines()
    assert code == 3
    assert len(lines) == 1, lines
    assert lines[0].startswith(f"{data / harm.file}"), lines
    assert harm.says in lines[0]
    assert errors == f"flowlab: {data}: 1 finding\n"


def test_a_shard_that_no_disk_can_read_is_damaged(
    small_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(small_dataset, tmp_path / "d")
    (data / f"{SHARD}.zip").unlink()
    (data / f"{SHARD}.zip").symlink_to("/proc/self/mem")
    code, output, _ = call_cli(capsys, "validate", data)
    assert code == 3
    assert output.splitlines()[0].startswith(f"{data / SHARD}.zip: damaged")


def test_half_a_dataset_is_not_sound(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    data = shutil.copytree(small_dataset, tmp_path / "d")
    for receipt in (data / "receipts").glob("push-back-*"):
        receipt.unlink()
    result = flowlab("validate", data)
    assert result.returncode == 3
    findings = [line.partition(": ")[::2] for line in result.stdout.splitlines()]
    again = "run the same extract command again"
    assert (str(data / "flowlab.json"), f"push-back: 0 of 3 episodes; {again} for the rest") in findings
    orphans = {str(p) for p in (data / "shards").glob("push-back-*")}
    assert {place for place, problem in findings if "has no receipt" in problem} == orphans
    other = {place for place, problem in findings if "does not say what the receipts say" in problem}
    assert other == {str(data / name) for name in ("stats.json", "rejects.jsonl", "README.md")}
    assert len(findings) == 1 + len(orphans) + len(other)


def test_ends_beyond_the_data_are_found(one_unit: Path, tmp_path: Path) -> None:
    data = shutil.copytree(one_unit, tmp_path / "d")
    rewrite("meta/episode_ends", lambda ends: ends + np.array([0, 5]))(data)
    findings = [str(f) for f in validate(data)]
    assert f"{data / TRACKS}: shape is (192, 100, 3), expected (197, 100, 3) for time, query, xyz" in findings


def test_a_real_dataset_is_sound(small_dataset: Path, flowlab: Cli) -> None:
    result = flowlab("validate", small_dataset)
    assert (result.returncode, result.stdout, result.stderr) == (0, f"{small_dataset}: sound\n", "")


def test_a_dataset_made_by_hand_is_sound(tmp_path: Path) -> None:
    make_dataset(tmp_path, [[make_episode(k, steps=10 + k) for k in range(3)], [make_episode(3, depth=True, rgb=True)]])
    assert list(validate(tmp_path)) == []


def test_findings_come_as_one_json_document(one_unit: Path, tmp_path: Path, flowlab: Cli) -> None:
    sound = flowlab("validate", one_unit, "--json")
    assert (sound.returncode, json.loads(sound.stdout)) == (0, [])
    data = shutil.copytree(one_unit, tmp_path / "d")
    (data / TRACKS / "c/0/0/0").unlink()
    shutil.rmtree(data / SHARD / "meta/seed")
    result = flowlab("validate", data, "--json")
    assert result.returncode == 3
    findings = json.loads(result.stdout)
    assert {f["file"] for f in findings} == {f"{data / TRACKS}", f"{data / SHARD}/meta/seed"}
    assert all(f["problem"] for f in findings)
    assert result.stderr == f"flowlab: {data}: 2 findings\n"


def test_what_it_says_to_do_mends_the_dataset(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    """The extract command again, with --repair: the same dataset as before."""
    data = shutil.copytree(small_dataset, tmp_path / "d")
    flip_byte(data / f"{SHARD}.zip")
    again = ("extract-sim", "drawer-open", "push-back", "--episodes", 3, "--out", data, "--workers", 1)
    (finding,) = validate(data)
    assert finding.place == str(data / f"{SHARD}.zip")
    assert "with --repair" in finding.problem
    result = flowlab(*again, "--repair")
    assert result.returncode == 0, result.stderr
    assert f"{SHARD}.zip: damaged (its content does not match" in result.stderr
    assert list(validate(data)) == []
    assert Dataset(data).fingerprint == Dataset(small_dataset).fingerprint


def estimated(seed: int = 0) -> Episode:
    """Every point is seen all the time, and known to 5 mm."""
    episode = make_episode(seed, steps=40, points=256, queries=100)
    seen = replace(episode, tracks=replace(episode.tracks, visible=np.ones_like(episode.tracks.visible)))
    return changed_quality(with_quality(seen), sigma=np.float32(0.005))


def changed_quality(e: Episode, **values: Any) -> Episode:
    """The episode with parts of its quality replaced; numbers stand for whole arrays."""
    quality = e.tracks.quality
    assert quality is not None
    full = {
        name: np.broadcast_to(v, e.tracks.visible.shape).astype(getattr(quality, name).dtype)
        for name, v in values.items()
    }
    return replace(e, tracks=replace(e.tracks, quality=replace(quality, **full)))


def jumping(e: Episode, points: int, meters: float = 0.5) -> Episode:
    """Some points are suddenly elsewhere, for good."""
    xyz = e.tracks.xyz_world.copy()
    xyz[20:, :points, 2] += meters
    return with_tracks(e, xyz)


def hidden(e: Episode, points: int, source: PositionSource) -> Episode:
    visible = e.tracks.visible.copy()
    visible[20:, :points] = False
    unseen = replace(e, tracks=replace(e.tracks, visible=visible))
    return changed_quality(unseen, source=np.where(visible, 1, source), sight=np.where(visible, 0, 1))


def at(t: int, m: int, value: object, elsewhere: object) -> np.ndarray:
    values = np.full((40, 100), elsewhere)
    values[t, m] = value
    return values


ESTIMATED_HARMS: dict[str, tuple[Callable[[Episode], Episode], str]] = {
    "no error stated": (
        lambda e: changed_quality(e, sigma=at(3, 7, 0.0, 0.005)),
        "sigma: point 7 at step 3 states an error",
    ),
    "error without end": (lambda e: changed_quality(e, sigma=at(3, 7, np.inf, 1.0)), "sigma: not finite at step 3"),
    "source of simulation": (lambda e: changed_quality(e, source=0), "source: point 0 at step 0 has a source"),
    "source of nothing": (lambda e: changed_quality(e, source=at(9, 2, 4, 1)), "source: point 2 at step 9 has a"),
    "hidden, yet measured": (
        lambda e: hidden(e, 5, PositionSource.MEASURED),
        "visible: point 0 at step 20 is measured, yet not visible, and so are 99",
    ),
    "measured without depth": (
        lambda e: changed_quality(e, depth_valid=at(1, 1, False, True)),
        "depth_valid: point 1 at step 1 is measured",
    ),
    "sight of nothing": (
        lambda e: changed_quality(e, sight=at(4, 3, 5, 0)),
        "sight: point 3 at step 4 has a sight that",
    ),
    "visible, yet covered": (
        lambda e: changed_quality(e, sight=at(4, 3, 1, 0)),
        "sight: point 3 at step 4 has a sight",
    ),
    "negative distance": (
        lambda e: changed_quality(e, disagreement=at(2, 2, -0.5, 0.1)),
        "disagreement: point 2 at step 2 is below 0",
    ),
    "jumps": (lambda e: jumping(e, 60), "tracks: 60 of 3900 steps of visible points are jumps"),
    "off the surface": (lambda e: with_tracks(e, e.tracks.xyz_world + np.float32(0.06)), OFF_SURFACE),
    "no quality at all": (
        lambda e: replace(e, tracks=replace(e.tracks, quality=None)),
        "sigma: missing; estimated tracks must state",
    ),
}


@pytest.mark.parametrize("name", ESTIMATED_HARMS)
def test_harm_to_estimated_tracks_is_found(name: str, tmp_path: Path) -> None:
    harm, says = ESTIMATED_HARMS[name]
    points = {"observer": {"points": 256}, "queries": {"points": 100}, "track": {}}
    make_dataset(tmp_path, [[harm(estimated())]], settings=points)
    findings = [str(f) for f in validate(tmp_path)]
    assert any(says in f.replace("seed 0: ", "") for f in findings), findings
    assert len(findings) == 1 or name == "jumps", findings


ESTIMATED_SOUND: dict[str, Callable[[Episode], Episode]] = {
    "as it is": lambda e: e,
    "few jumps": lambda e: jumping(e, 3),
    "jumps as far as their stated errors": lambda e: changed_quality(jumping(e, 60), sigma=0.4),
    "jumps in hiding": lambda e: hidden(jumping(e, 60), 60, PositionSource.MODEL),
    "jumps that are filled in": lambda e: changed_quality(
        jumping(e, 60), source=np.where(np.arange(100) < 60, PositionSource.FILLED, PositionSource.MEASURED)
    ),
    "a hand, filmed slowly": lambda e: changed_quality(
        replace(jumping(e, 60, 0.5), time_s=np.arange(40) * 0.2), source=PositionSource.MODEL
    ),
    "unknown to the tracker": lambda e: changed_quality(e, forward_backward=-1, disagreement=-1, residual=-1),
}


@pytest.mark.parametrize("name", ESTIMATED_SOUND)
def test_estimated_tracks_may_be_wrong_if_they_say_so(name: str, tmp_path: Path) -> None:
    points = {"observer": {"points": 256}, "queries": {"points": 100}, "track": {}}
    make_dataset(tmp_path, [[ESTIMATED_SOUND[name](estimated())]], settings=points)
    assert [str(f) for f in validate(tmp_path)] == []


def test_a_kept_reject_must_be_there_and_no_other(tmp_path: Path) -> None:
    data = make_dataset(tmp_path, [[make_episode(0)]])
    (tmp_path / "README.md").unlink()  # which would say less than the receipts do now
    edit_json(tmp_path / "flowlab.json", lambda m: m.update(schema_version=1))
    reject = Reject(task="roll", seed=1, stage="quality", reason="poor", position=0)
    nothing = {"accepted": (), "frames": (), "digests": (), "stats": {}}
    keep_receipt(tmp_path, make_receipt([make_episode(1)], unit="roll-000001", rejects=(reject,), **nothing))
    (finding,) = validate(tmp_path)
    assert finding.place == f"{tmp_path}/rejects/roll-000001.zarr"
    assert "receipts/roll-000001.json counts it" in finding.problem
    put_shard(tmp_path / "rejects/roll-000001.zarr", [make_episode(1)], data.manifest.settings_digest)
    assert list(validate(tmp_path)) == []
    put_shard(tmp_path / "rejects/roll-000002.zarr", [make_episode(2)], data.manifest.settings_digest)
    (finding,) = validate(tmp_path)
    assert finding.place == f"{tmp_path}/rejects/roll-000002.zarr"


@pytest.mark.parametrize("name", ["../../victim", "/abs", ".hidden", ""])
def test_a_receipt_with_a_name_that_leads_elsewhere_is_refused(name: str, tmp_path: Path) -> None:
    make_dataset(tmp_path / "data", [[make_episode(0)]])
    (file,) = (tmp_path / "data" / "receipts").glob("*.json")
    values = json.loads(file.read_text())
    del values["sha256"]
    file.write_text(json.dumps({**values, "unit": name}))
    with pytest.raises(DataError, match="is no plain name"):
        read_receipts(tmp_path / "data")
    file.write_text(json.dumps({**values, "unit": "push-000009"}))
    with pytest.raises(DataError, match="as the file is called"):
        read_receipts(tmp_path / "data")
