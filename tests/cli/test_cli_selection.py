"""Datasets made of others: what ``merge``, ``subset`` and ``split`` keep, and what they refuse."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import (
    as_folders,
    assert_same,
    call_cli,
    files_below,
    make_dataset,
    make_episode,
    make_manifest,
    make_provenance,
    put_unit,
)
from thoroughness import examples

import flowlab
from flowlab.checksums import sha256_of
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset, begin, summarize
from flowlab.storage.receipts import Reject
from flowlab.storage.recorded import Recorded
from flowlab.storage.shard import write_shard
from flowlab.storage.validation import validate

Capsys = pytest.CaptureFixture[str]


def _episode(task: str, seed: int) -> Episode:
    """An episode that differs from all others in its content, too."""
    made = make_episode(task=task, seed=seed)
    return replace(made, state=made.state + np.float32(seed + 10 * len(task)))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tasks of six and of four episodes, in shards of three, two and one."""
    units = [("push", (0, 1, 2)), ("push", (3, 4, 5)), ("sweep", (0, 7)), ("sweep", (8,)), ("sweep", (9,))]
    folder = tmp_path_factory.mktemp("selection") / "whole"
    make_dataset(folder, [[_episode(task, seed) for seed in seeds] for task, seeds in units])
    return folder


def _same(a: Path, b: Path) -> None:
    """Two datasets have the same episodes, bit for bit."""
    first, second = Dataset(a), Dataset(b)
    assert [(r.task, r.seed, r.digest) for r in first.refs] == [(r.task, r.seed, r.digest) for r in second.refs]
    for mine, theirs in zip(first, second, strict=True):
        assert_same(mine, theirs)


def _sound(capsys: Capsys, folder: Path) -> None:
    assert call_cli(capsys, "validate", folder)[:2] == (0, f"{folder}: sound\n")


def _refused(capsys: Capsys, *arguments: str | Path, code: int, says: str) -> None:
    """One sentence and an exit code."""
    found, out, error = call_cli(capsys, *arguments)
    assert (found, out) == (code, ""), error
    assert says in error
    assert error.count("\n") == 1 or code == 2


def test_a_subset_by_task_copies_shards_as_they_are(whole: Path, tmp_path: Path, capsys: Capsys) -> None:
    before = files_below(whole)
    code, out, error = call_cli(capsys, "subset", whole, "--tasks", "sweep", "--out", tmp_path / "d", "--json")
    assert (code, error) == (0, "")
    assert json.loads(out)["tasks"] == {"sweep": 4}
    _sound(capsys, tmp_path / "d")
    for shard in (tmp_path / "d" / "shards").iterdir():
        assert shard.read_bytes() == (whole / "shards" / shard.name).read_bytes()
    assert files_below(whole) == before
    about = Dataset(tmp_path / "d").manifest.settings["subset"]
    assert about == {"of": str(whole), "fingerprint": Dataset(whole).fingerprint, "tasks": ["sweep"]}


@pytest.mark.parametrize(
    ("tasks", "episodes", "expected"),
    [
        ("push", "1:4", [("push", 1), ("push", 2), ("push", 3)]),
        (None, "0,-1,5:7", [("push", 0), ("push", 5), ("sweep", 0), ("sweep", 9)]),
        ("sweep,push", "-3:", [("sweep", 7), ("sweep", 8), ("sweep", 9)]),
    ],
)
def test_a_subset_by_number_counts_as_viz_does(
    tasks: str | None, episodes: str, expected: list[tuple[str, int]], whole: Path, tmp_path: Path, capsys: Capsys
) -> None:
    chosen = [] if tasks is None else ["--tasks", tasks]
    command = ["subset", whole, *chosen, "--episodes", episodes, "--out", tmp_path / "d"]
    assert call_cli(capsys, *command)[0] == 0
    made, source = Dataset(tmp_path / "d"), Dataset(whole)
    assert [(r.task, r.seed) for r in made.refs] == expected
    for episode in made:
        assert_same(episode, source[source.index(episode)])
    _sound(capsys, tmp_path / "d")


def test_every_command_takes_the_result(whole: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert call_cli(capsys, "split", whole, "--val", "0.5", "--out", tmp_path / "c")[0] == 0
    code, out, _ = call_cli(capsys, "info", tmp_path / "c-val", "--json")
    assert (code, json.loads(out)["episodes"]) == (0, 5)
    assert call_cli(capsys, "viz", tmp_path / "c-val", "--png", tmp_path / "look.png")[0] == 0
    _refused(capsys, "split", whole, "--out", tmp_path / "c", code=3, says="is there already")


@given(
    sizes=st.lists(st.integers(1, 5), min_size=1, max_size=3).filter(lambda n: max(n) > 1),
    share=st.floats(0.01, 0.99),
    seed=st.integers(0, 9),
)
@settings(max_examples=examples(8))
def test_a_split_is_a_partition_and_merged_again_the_whole(
    sizes: list[int], share: float, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("split")
    units = [[_episode(f"task-{t}", s) for s in range(n)] for t, n in enumerate(sizes)]
    whole = make_dataset(folder / "whole", units)
    train, val = flowlab.split(whole, val=share, seed=seed)
    parts = [{(r.task, r.seed) for r in part.refs} for part in (train, val)]
    assert not parts[0] & parts[1]
    for t, n in enumerate(sizes):
        held = sum(task == f"task-{t}" for task, _ in parts[1])
        assert held == 0 if n == 1 else 1 <= held <= n - 1
        assert n == 1 or abs(held - share * n) <= 1
    again = flowlab.merge([val, train], folder / "again")
    _same(whole.path, again.path)
    assert again.fingerprint == whole.fingerprint
    assert again.stats["episodes"] == whole.stats["episodes"]
    assert not [*validate(again.path)]
    twice = flowlab.split(whole, folder / "twice", val=share, seed=seed)
    assert [p.fingerprint for p in twice] == [train.fingerprint, val.fingerprint]


def _recorded(folder: Path, numbers: range, *, recordings: str, reject: bool = True) -> Path:
    """A dataset of recordings, the last of which was kept out where that is asked for."""
    known = tuple(
        Recorded(
            task="pour", name=f"take-{k}", seed=k, source=f"/films/{recordings}/take-{k}", content=f"{recordings}{k}/"
        )
        for k in numbers
    )
    manifest = begin(folder, make_manifest({"pour": len(known)}, recordings=known))
    episodes = [replace(_episode("pour", k), extras={"filmed": recordings}) for k in numbers]
    good, poor = (episodes[:-1], episodes[-1:]) if reject else (episodes, [])
    more: dict[str, object] = {}
    if poor:
        why = {"stage": "quality", "reason": "too dark", "source": known[-1].source, "position": 0}
        place = folder / "rejects" / "pour-all.zarr.zip"
        write_shard(place, poor, manifest.settings_digest)
        more = {"rejects": (Reject(task="pour", seed=poor[0].seed, **why),), "rejects_sha256": sha256_of(place)}
    about = {"unit": "pour-all", "seeds": tuple(numbers), "contents": tuple(r.content for r in known)}
    put_unit(folder, good, manifest.settings_digest, **about, **more)
    return summarize(folder).path


def test_merged_recordings_keep_their_sources_rejects_and_checks(tmp_path: Path, capsys: Capsys) -> None:
    a, b = _recorded(tmp_path / "a", range(3), recordings="a"), _recorded(tmp_path / "b", range(4), recordings="b")
    code, _, error = call_cli(capsys, "merge", a, b, "--out", tmp_path / "c")
    assert code == 0, error
    _sound(capsys, tmp_path / "c")
    made, second = Dataset(tmp_path / "c"), Dataset(b)
    assert [r.seed for r in made.refs] == [0, 1, 3, 4, 5]
    assert [(r.seed, r.source, r.name) for r in made.manifest.recordings] == [
        *((k, f"/films/a/take-{k}", f"take-{k}") for k in range(3)),
        *((k + 3, f"/films/b/take-{k}", f"take-{k}" + "-2" * (k < 3)) for k in range(4)),
    ]
    for k, episode in enumerate(made[2:]):
        assert_same(replace(episode, seed=k), second[k])
    assert [(x.seed, x.reason, x.source) for x in made.rejects] == [
        (2, "too dark", "/films/a/take-2"), (6, "too dark", "/films/b/take-3"),
    ]  # fmt: skip
    assert_same(made.rejected(0), Dataset(a).rejected(0))
    assert_same(replace(made.rejected(1), seed=3), second.rejected(0))
    assert made.manifest.settings["merge"]["of"][1]["added_to_numbers"] == 3


def test_what_is_in_both_is_kept_once(
    whole: Path, tmp_path: Path, capsys: Capsys, caplog: pytest.LogCaptureFixture
) -> None:
    for name, episodes in (("a", "0:4"), ("b", "2:10")):
        assert call_cli(capsys, "subset", whole, "--episodes", episodes, "--out", tmp_path / name)[0] == 0
    assert call_cli(capsys, "merge", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "c")[0] == 0
    assert "2 of its 8 episodes are in the datasets before it, too; they are kept once" in caplog.text
    _same(whole, tmp_path / "c")
    _sound(capsys, tmp_path / "c")
    assert call_cli(capsys, "merge", whole, tmp_path / "a", "--out", tmp_path / "e")[0] == 0
    assert "4 of its 4 episodes are in the datasets before it, too" in caplog.text
    _same(whole, tmp_path / "e")


def test_the_same_recording_labeled_twice_is_kept_once(
    tmp_path: Path, capsys: Capsys, caplog: pytest.LogCaptureFixture
) -> None:
    a = _recorded(tmp_path / "a", range(3), recordings="same", reject=False)
    b = _recorded(tmp_path / "b", range(5), recordings="same", reject=False)
    assert call_cli(capsys, "merge", a, b, "--out", tmp_path / "c")[0] == 0
    assert "3 of its 5 episodes are in the datasets before it, too" in caplog.text
    assert [r.seed for r in Dataset(tmp_path / "c").refs] == [*range(5)]
    assert call_cli(capsys, "subset", a, "--tasks", "pour", "--out", tmp_path / "d")[0] == 0
    _sound(capsys, tmp_path / "c")
    _sound(capsys, tmp_path / "d")


def test_other_settings_are_kept_and_said(
    whole: Path, tmp_path: Path, capsys: Capsys, caplog: pytest.LogCaptureFixture
) -> None:
    changed = {**Dataset(whole).manifest.settings, "more": {"noise": 0.1}}
    other = make_dataset(tmp_path / "other", [[_episode("lift", 0)]], settings=changed)
    assert call_cli(capsys, "merge", whole, other.path, "--out", tmp_path / "c")[0] == 0
    assert "made with other settings" in caplog.text
    assert Dataset(tmp_path / "c").manifest.settings["merge"]["of"][1]["settings"]["more"] == {"noise": 0.1}
    _sound(capsys, tmp_path / "c")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"world_frame": "y up"}, ('"z up"', '"y up"')),
        ({"camera": {}}, ("camera.K",)),
        ({"tracks": "none"}, ('"exact"', '"none"')),
    ],
)
def test_datasets_that_do_not_fit_are_refused(
    changes: dict[str, object], says: tuple[str, ...], whole: Path, tmp_path: Path, capsys: Capsys
) -> None:
    other = make_dataset(tmp_path / "other", [[_episode("lift", 0)]], provenance=make_provenance(**changes)).path
    for text in (*says, str(whole), str(other)):
        _refused(capsys, "merge", whole, other, "--out", tmp_path / "c", code=3, says=text)
    assert not (tmp_path / "c").exists()


def test_other_widths_and_taken_simulated_seeds_are_refused(whole: Path, tmp_path: Path, capsys: Capsys) -> None:
    wide = _episode("lift", 0)
    wide = replace(wide, state=np.hstack([wide.state, wide.state]))
    other = make_dataset(tmp_path / "wide", [[wide]]).path
    says = f"its state has {wide.state.shape[1]} numbers a step"
    _refused(capsys, "merge", whole, other, "--out", tmp_path / "c", code=3, says=says)
    pair = []
    for name, shift in (("a", 0), ("b", 1)):
        episode = _episode("lift", 0)
        episode = replace(episode, state=episode.state + np.float32(shift))
        pair.append(make_dataset(tmp_path / name, [[episode]], provenance=make_provenance(kind="simulated")).path)
    _refused(capsys, "merge", *pair, "--out", tmp_path / "c", code=3, says="lift seed 0 is another episode than in")


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["subset", "W", "--tasks", "pusch", "--out", "d"], 2, "did you mean push?"),
        (["subset", "W", "--tasks", "", "--out", "d"], 2, "names nothing"),
        (["subset", "W", "--episodes", "10", "--out", "d"], 2, "there is no episode 10; there are 10"),
        (["subset", "W", "--tasks", "push", "--episodes", "0:50", "--out", "d"], 2, "ends beyond the 6 that there are"),
        (["subset", "W", "--episodes", "4:4", "--out", "d"], 2, "is empty"),
        (["subset", "W", "--episodes", "all", "--out", "d"], 2, "expected numbers or ranges"),
        (["subset", "W", "--out", "d"], 2, "nothing is chosen"),
        (["subset", "W", "--tasks", "push", "--out", "W"], 2, "choose another --out"),
        (["subset", "W", "--tasks", "push", "--out", "W/shards/d"], 2, "choose another --out"),
        (["subset", "W", "--tasks", "push", "--out", "."], 3, "is there already"),
        (["merge", "W", "W", "--out", "d"], 3, "is given twice"),
        (["merge", "W", "--out", "d"], 2, "merging takes at least two"),
        (["merge", "W", "nowhere", "--out", "d"], 3, "there is no such folder"),
        (["split", "W", "--val", "1.5", "--out", "d"], 2, "must be a share between 0 and 1"),
        (["split", "W", "--val", "nan", "--out", "d"], 2, "must be a share between 0 and 1"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    arguments: list[str],
    code: int,
    says: str,
    whole: Path,
    tmp_path: Path,
    capsys: Capsys,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    _refused(capsys, *(a.replace("W", str(whole)) for a in arguments), code=code, says=says)
    assert not any(tmp_path.iterdir())


def _flip(shard: Path) -> None:
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)


def _to_device(shard: Path) -> None:
    shard.unlink()
    shard.symlink_to("/dev/zero")


@pytest.mark.parametrize(
    ("harm", "says"), [(_flip, "damaged"), (_to_device, "is a device or a pipe"), (Path.unlink, "no such file")]
)
@pytest.mark.parametrize("episodes", [None, "0"])
def test_a_damaged_shard_is_told_and_nothing_is_made(
    harm: Callable[[Path], None], says: str, episodes: str | None, whole: Path, tmp_path: Path, capsys: Capsys
) -> None:
    shutil.copytree(whole, tmp_path / "w")
    harm(tmp_path / "w" / "shards" / "push-000000-000002.zarr.zip")
    chosen = ["--tasks", "push"] if episodes is None else ["--episodes", episodes]
    _refused(capsys, "subset", tmp_path / "w", *chosen, "--out", tmp_path / "d", code=3, says=says)
    assert os.listdir(tmp_path) == ["w"]


def test_an_older_dataset_of_folders_goes_over(whole: Path, tmp_path: Path, capsys: Capsys) -> None:
    shutil.copytree(whole, tmp_path / "w")
    as_folders(tmp_path / "w")
    assert call_cli(capsys, "subset", tmp_path / "w", "--tasks", "push", "--out", tmp_path / "d")[0] == 0
    _sound(capsys, tmp_path / "d")
    assert [r.digest for r in Dataset(tmp_path / "d").refs] == [r.digest for r in Dataset(whole).task("push").refs]
