"""A dataset folder: what counts, what identifies it, and what is said when something is wrong with it."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Cli
from synthetic import (
    assert_same,
    edit_json,
    files_below,
    make_dataset,
    make_episode,
    make_manifest,
    make_receipt,
    put_unit,
    with_quality,
)

from flowlab.checksums import sha256_of
from flowlab.errors import DataError, UsageError
from flowlab.storage.dataset import Dataset, begin, open_dataset, summarize
from flowlab.storage.manifest import MANIFEST
from flowlab.storage.receipts import Receipt, Reject, RowFormat, StageTally, keep_receipt, known_row_format, shard_path
from flowlab.storage.recorded import Recorded
from flowlab.storage.shard import Shard, write_shard
from flowlab.storage.validation import validate

EPISODES = [make_episode(k, task=task, steps=6 + k) for task in ("roll", "push") for k in range(3)]


def test_episodes_come_in_order_of_task_and_seed(tmp_path: Path) -> None:
    roll0, roll1, roll2, push0, push1, push2 = EPISODES
    dataset = make_dataset(tmp_path, [[roll0, roll2], [push0, push1, push2], [roll1]])
    assert [(r.task, r.seed, r.frames) for r in dataset.refs] == [
        ("push", 0, 6), ("push", 1, 7), ("push", 2, 8), ("roll", 0, 6), ("roll", 1, 7), ("roll", 2, 8),
    ]  # fmt: skip
    for k, expected in enumerate([push0, push1, push2, roll0, roll1, roll2]):
        assert_same(expected, dataset.episode(k))
    assert sorted((e.task, e.seed) for e in dataset.episodes()) == [(r.task, r.seed) for r in dataset.refs]


def test_a_position_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, [EPISODES[:2]])
    for index in (2, -1):
        with pytest.raises(DataError, match=f"no episode {index}; there are 2, counted from 0"):
            dataset.episode(index)


def test_a_dataset_is_a_sequence_of_its_episodes(tmp_path: Path) -> None:
    roll0, roll1, roll2, push0, push1, push2 = EPISODES
    ordered = [push0, push1, push2, roll0, roll1, roll2]
    make_dataset(tmp_path, [[roll0, roll2], [push0, push1, push2], [roll1]])
    dataset = open_dataset(tmp_path)
    assert len(dataset) == 6
    for k, expected in enumerate(ordered):
        assert_same(expected, dataset[k])
        assert_same(expected, dataset[k - 6])
    assert [(e.task, e.seed) for e in dataset] == [(e.task, e.seed) for e in ordered]
    for expected, found in zip(ordered, dataset, strict=True):
        assert_same(expected, found)
    for index in (6, -7):
        with pytest.raises(IndexError, match=rf"no episode {index}; there are 6, counted from 0"):
            dataset[index]


def test_an_episode_is_known_by_its_task_and_seed(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, [EPISODES[:3], EPISODES[3:]])
    roll = dataset.task("roll")
    assert EPISODES[1] in roll
    assert dataset[4] in dataset
    assert dataset[1] not in roll
    assert dataset.index(EPISODES[1]) == 4
    assert roll.index(EPISODES[1]) == 1
    assert roll.count(EPISODES[1]) == 1
    with pytest.raises(ValueError, match="no episode of push has the seed 0"):
        roll.index(EPISODES[3])
    with pytest.raises(ValueError, match="no episode of roll has the seed 1"):
        roll.index(EPISODES[1], 2)
    with pytest.raises(UsageError, match=r"holds episodes, and found a str; tasks are in \.tasks"):
        _ = "push" in dataset


def test_an_index_that_is_no_number_is_refused_in_a_sentence(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, [EPISODES])
    with pytest.raises(UsageError, match=r"found a str; episodes of one task are dataset\.task\('push'\)"):
        dataset["push"]  # type: ignore[call-overload]
    with pytest.raises(UsageError, match=r"episodes are numbered, and found a list; as in dataset\[2\]"):
        dataset[[0, 1]]  # type: ignore[call-overload]


def test_part_of_a_dataset_is_one_too(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, [EPISODES[:3], EPISODES[3:]])
    assert dataset.tasks == ("push", "roll")
    roll = dataset.task("roll")
    assert [(e.task, e.seed) for e in roll] == [("roll", 0), ("roll", 1), ("roll", 2)]
    assert_same(EPISODES[2], roll[-1])
    assert [(r.task, r.seed) for r in dataset[1:5:2].refs] == [("push", 1), ("roll", 0)]
    assert [e.seed for e in roll[1:]] == [1, 2]
    assert roll.tasks == ("roll",)
    with pytest.raises(UsageError, match=rf"no task in {tmp_path} is called 'rol'; did you mean roll"):
        dataset.task("rol")


def test_a_dataset_says_in_two_lines_what_it_holds(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "a", [EPISODES[:3], EPISODES[3:]])
    first, second = repr(dataset).split("\n")
    assert first == f"Dataset '{tmp_path / 'a'}': 6 episodes, 42 frames, 2 tasks (push 3, roll 3)"
    assert second == (
        "  arrays: time, point_cloud[64, 3], point_count, state[9], action[4], success, tracks[8, 3], visible[8], "
        "object_pose[9]"
    )
    assert repr(dataset.task("push")).startswith(f"DatasetView '{tmp_path / 'a'}': 3 episodes")
    seen = make_dataset(tmp_path / "b", [[with_quality(make_episode(depth=True, rgb=True))]])
    assert "depth[12, 16], rgb[12, 16, 3], sigma[8]" in repr(seen)
    shutil.rmtree(tmp_path / "b" / "shards")
    assert "arrays: unreadable (" in repr(Dataset(tmp_path / "b"))
    begin(tmp_path / "c", make_manifest({"roll": 1}))
    assert repr(Dataset(tmp_path / "c")).endswith("0 episodes, 0 frames, 0 tasks ()\n  arrays: none yet")


def test_a_folder_that_does_not_exist_is_a_missing_file_too(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no such folder") as error:
        open_dataset(tmp_path / "none")
    assert isinstance(error.value, DataError)


def test_the_fingerprint_is_of_the_content_not_of_its_making(tmp_path: Path) -> None:
    whole = make_dataset(tmp_path / "a", [EPISODES[:3], EPISODES[3:]])
    parts = make_dataset(tmp_path / "b", [[EPISODES[5]], EPISODES[0:3:2], EPISODES[3:5], [EPISODES[1]]])
    assert whole.fingerprint == parts.fingerprint
    slow = {"stages": {"expert": StageTally(calls=1, cpu_s=99.0)}, "peak_memory_mb": 1234.0}
    for receipt in parts.receipts:
        keep_receipt(tmp_path / "b", receipt.model_copy(update=slow))
    assert Dataset(tmp_path / "b").fingerprint == whole.fingerprint


def test_the_fingerprint_tells_settings_content_and_seeds_apart(tmp_path: Path) -> None:
    other = {"settings": {"observer": {"points": 64}, "queries": {"points": 8, "sampling": "object"}}}
    made = [
        make_dataset(tmp_path / "plain", [EPISODES[:2]]),
        make_dataset(tmp_path / "settings", [EPISODES[:2]], **other),
        make_dataset(tmp_path / "less", [EPISODES[:1]]),
        make_dataset(tmp_path / "content", [[EPISODES[0], make_episode(1, steps=8)]]),
        make_dataset(tmp_path / "task", [EPISODES[3:5]]),
    ]
    assert len({d.fingerprint for d in made}) == len(made)


def test_missing_episodes_are_counted_by_task(tmp_path: Path) -> None:
    make_dataset(tmp_path, [EPISODES[:3], EPISODES[3:5]])
    begin(tmp_path, make_manifest({"roll": 3, "push": 4, "slide": 1}))
    assert Dataset(tmp_path).missing == {"push": 2, "slide": 1}


def test_a_request_never_shrinks(tmp_path: Path) -> None:
    make_dataset(tmp_path, [EPISODES[:3]])
    assert begin(tmp_path, make_manifest({"roll": 2})).requested == {"roll": 3}
    assert Dataset(tmp_path).manifest.requested == {"roll": 3}


def change_manifest(folder: Path, **values: object) -> None:
    path = folder / MANIFEST
    edit_json(path, lambda m: m.update(values))


def break_receipt(folder: Path) -> None:
    (folder / "receipts" / "roll-000000-000001.json").write_text('{"unit": ')


def strip_receipt(folder: Path) -> None:
    path = folder / "receipts" / "roll-000000-000001.json"
    path.write_text(
        json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k not in ("digests", "sha256")})
    )


HARMS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (shutil.rmtree, "{0}: there is no such folder"),
    "no manifest": (lambda d: (d / MANIFEST).unlink(), "{0}: not a flowlab dataset (it has no flowlab.json)"),
    "broken manifest": (lambda d: (d / MANIFEST).write_text("{"), "{0}/flowlab.json: not valid JSON (*restore it*"),
    "binary manifest": (lambda d: (d / MANIFEST).write_bytes(b"\xff\xfe"), "{0}/flowlab.json: is no UTF-8 text (*"),
    "newer flowlab": (
        lambda d: change_manifest(d, schema_version=3),
        "{0}/flowlab.json: schema_version is 3, this flowlab reads 1 and 2; use the flowlab version that wrote it",
    ),
    "unknown field": (lambda d: change_manifest(d, color=1), "{0}/flowlab.json: color: no setting is called *"),
    "broken receipt": (break_receipt, "{0}/receipts/roll-000000-000001.json: not valid JSON (*"),
    "receipt without digests": (strip_receipt, "{0}/receipts/roll-000000-000001.json: digests: Field required*"),
    "file": (lambda d: (shutil.rmtree(d), d.touch()), "{0}: not a flowlab dataset *"),
}


@pytest.mark.parametrize("harm", HARMS)
def test_what_is_no_dataset_is_refused_in_one_sentence(tmp_path: Path, harm: str) -> None:
    folder = tmp_path / "d"
    make_dataset(folder, [EPISODES[:2]])
    do, sentence = HARMS[harm]
    do(folder)
    with pytest.raises(DataError) as error:
        Dataset(folder)
    start, _, end = sentence.format(folder).partition("*")
    assert str(error.value).startswith(start)
    assert end.strip("*") in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("field", ["frames", "digests"])
def test_a_receipt_whose_lists_do_not_match_is_refused(tmp_path: Path, field: str) -> None:
    make_dataset(tmp_path, [EPISODES[:2]])
    path = tmp_path / "receipts" / "roll-000000-000001.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, field: values[field][:1]}))
    with pytest.raises(DataError, match=str(path)):
        _ = Dataset(tmp_path).refs, Dataset(tmp_path).fingerprint


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(DataError, match=f"{out}: cannot make a dataset here .*; choose another --out"):
            begin(out, make_manifest({"roll": 1}))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_parent_that_must_not_be_written_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    with pytest.raises(DataError, match=r"cannot make a dataset here .*; choose another --out"):
        begin(tmp_path / "d", make_manifest({"roll": 1}))
    tmp_path.chmod(0o755)


def test_other_settings_are_refused_and_listed(tmp_path: Path) -> None:
    make_dataset(tmp_path, [EPISODES[:2]])
    before = files_below(tmp_path)
    settings = {"observer": {"points": 64, "padding": "zeros"}, "queries": {"points": 9}}
    with pytest.raises(DataError) as error:
        begin(tmp_path, make_manifest({"roll": 2}, settings=settings, first_seed=5))
    assert set(str(error.value).split("\n  ")[1:]) == {
        "settings.observer.padding: the dataset has null, this run has \"zeros\"",
        "settings.queries.points: the dataset has 8, this run has 9",
        "first_seed: the dataset has 0, this run has 5",
    }  # fmt: skip
    assert files_below(tmp_path) == before


def test_stages_in_another_order_are_other_settings(tmp_path: Path) -> None:
    make_dataset(tmp_path, [EPISODES[:2]], settings={"observer": {"points": 64}, "queries": {"points": 8}})
    with pytest.raises(DataError, match="other settings"):
        begin(tmp_path, make_manifest({"roll": 2}, settings={"queries": {"points": 8}, "observer": {"points": 64}}))


def test_the_manifest_keeps_the_order_of_the_stages(small_dataset: Path) -> None:
    order = ["expert", "observer", "queries", "rigid-flow", "accept", "write"]
    assert list(Dataset(small_dataset).manifest.settings) == order


def test_extract_sim_refuses_other_settings(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    data = shutil.copytree(small_dataset, tmp_path / "d")
    before = files_below(data)
    command = ("extract-sim", "drawer-open", "--episodes", 3, "--out", data, "--workers", 1)
    result = flowlab(*command, "--set", "observer.points=512")
    assert result.returncode == 3
    assert "settings.observer.points: the dataset has 1024, this run has 512" in result.stderr
    assert result.stderr.count("the dataset has") == 1
    assert result.stdout == ""
    assert files_below(data) == before


def test_extending_a_dataset_leaves_what_it_has(small_dataset: Path, tmp_path: Path, flowlab: Cli) -> None:
    data = shutil.copytree(small_dataset, tmp_path / "d")
    before = {n: f for n, f in files_below(data).items() if n.startswith(("shards", "receipts"))}
    result = flowlab("extract-sim", "drawer-open", "--episodes", 4, "--out", data, "--workers", 1)
    assert result.returncode == 0, result.stderr
    after = files_below(data)
    assert {n: after[n] for n in before} == before
    added = {Path(n).parts[1] for n in after if n.startswith("shards")} - {Path(n).parts[1] for n in before}
    assert added == {"drawer-open-000003.zarr.zip"}
    dataset = Dataset(data)
    assert dataset.manifest.requested == {"drawer-open": 4, "push-back": 3}
    assert [r.seed for r in dataset.refs if r.task == "drawer-open"] == [0, 1, 2, 3]
    assert json.loads((data / "stats.json").read_text())["episodes"] == 7
    assert [e.seed for e in Shard(data / "shards/drawer-open-000003.zarr.zip").episodes()] == [3]


def test_a_shard_without_receipt_does_not_count(tmp_path: Path) -> None:
    make_dataset(tmp_path, [EPISODES[:2], EPISODES[2:3]])
    (tmp_path / "receipts" / "roll-000002-000002.json").unlink()
    assert [r.seed for r in Dataset(tmp_path).refs] == [0, 1]


def test_receipts_half_written_by_another_job_are_passed_over(tmp_path: Path) -> None:
    make_dataset(tmp_path, [EPISODES[:2]])
    (tmp_path / "receipts" / ".tmp-7-roll-000002.json").write_text('{"unit"')
    assert len(Dataset(tmp_path)) == 2


def test_receipts_survive_their_json(small_dataset: Path) -> None:
    for receipt in Dataset(small_dataset).receipts:
        assert Receipt.model_validate_json(receipt.model_dump_json()) == receipt


def recorded(*names: str, task: str = "roll") -> tuple[Recorded, ...]:
    return tuple(Recorded(task=task, name=n, source=f"/rec/{n}") for n in names)


def test_recordings_are_missing_until_they_have_a_receipt(tmp_path: Path) -> None:
    """Whether it says accepted or rejected."""
    begin(tmp_path, make_manifest({}, recordings=recorded("a", "b", "c")))
    assert Dataset(tmp_path).manifest.requested == {"roll": 3}
    assert Dataset(tmp_path).missing == {"roll": 3}
    nothing = {"unit": "roll-000001", "accepted": (), "frames": (), "digests": (), "stats": {}}
    keep_receipt(tmp_path, make_receipt([make_episode(0)]))
    keep_receipt(tmp_path, make_receipt([make_episode(1)], **nothing))
    assert Dataset(tmp_path).missing == {"roll": 1}


def test_beginning_again_adds_recordings_and_keeps_the_others(tmp_path: Path) -> None:
    begin(tmp_path, make_manifest({}, recordings=recorded("b", "c")))
    manifest = begin(tmp_path, make_manifest({}, recordings=recorded("c", "a") + recorded("z", task="push")))
    assert [(r.task, r.name, r.seed) for r in manifest.recordings] == [
        ("roll", "b", 0), ("roll", "c", 1), ("push", "z", 2), ("roll", "a", 3),
    ]  # fmt: skip
    assert manifest.requested == {"roll": 3, "push": 1}
    assert Dataset(tmp_path).manifest == manifest


BEGINS = """
import sys, time
from pathlib import Path
from synthetic import make_manifest
import flowlab.storage.dataset as dataset
from flowlab.storage.recorded import Recorded

at_once = dataset.Manifest.write
dataset.Manifest.write = lambda *a: (time.sleep(0.3), at_once(*a))  # so that the others come in between
name = sys.argv[2]
print(flush=True)
sys.stdin.read()
dataset.begin(Path(sys.argv[1]), make_manifest({}, recordings=[Recorded(task="roll", name=name, source=name)]))
"""


def test_jobs_that_begin_together_number_their_recordings_apart(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "env": {**os.environ, "PYTHONPATH": path}}
    names = ["a", "b", "c"]
    jobs = [subprocess.Popen([sys.executable, "-c", BEGINS, tmp_path, name], **pipes) for name in names]  # type: ignore[call-overload]
    for job in jobs:
        job.stdout.readline()
    for job in jobs:
        job.stdin.close()
    assert [job.wait() for job in jobs] == [0] * 3
    table = Dataset(tmp_path).manifest.recordings
    assert sorted(r.name for r in table) == names
    assert sorted(r.seed for r in table) == [0, 1, 2]


def reject(seed: int, stage: str, **values: object) -> Reject:
    return Reject.model_validate({"task": "roll", "seed": seed, "stage": stage, "reason": f"because {seed}", **values})


def test_what_was_rejected_can_be_listed_and_looked_at(tmp_path: Path) -> None:
    poor = [with_quality(make_episode(k)) for k in (3, 1)]
    begin(tmp_path, make_manifest({"roll": 4}))
    rejects = (
        reject(3, "quality", position=0, source="/rec/c"),
        reject(2, "recording"),
        reject(1, "quality", position=1),
    )
    unit = "roll-000000-000003"
    write_shard(tmp_path / shard_path("rejects", unit), poor, "")
    known = {"seeds": (0, 3, 2, 1), "rejects": rejects}
    known["rejects_sha256"] = sha256_of(tmp_path / shard_path("rejects", unit))
    put_unit(tmp_path, [make_episode(0)], "", unit=unit, **known)
    dataset = summarize(tmp_path)
    found = [(x.task, x.seed, x.stage, x.reason, x.source, x.shard) for x in dataset.rejects]
    kept = "rejects/roll-000000-000003.zarr.zip"
    assert found == [
        ("roll", 1, "quality", "because 1", "", kept),
        ("roll", 2, "recording", "because 2", "", None),
        ("roll", 3, "quality", "because 3", "/rec/c", kept),
    ]
    assert_same(dataset.rejected(0), poor[1])
    assert_same(dataset.rejected(2), poor[0])
    with pytest.raises(DataError, match=r"roll seed 2 was rejected at recording \(because 2\), before there was"):
        dataset.rejected(1)
    with pytest.raises(DataError, match="no reject 3; there are 3, counted from 0"):
        dataset.rejected(3)
    assert [r.seed for r in dataset.refs] == [0], "a reject counts as an episode"
    lines = [json.loads(line) for line in (tmp_path / "rejects.jsonl").read_text().splitlines()]
    assert lines[0] == {
        "task": "roll", "seed": 3, "stage": "quality", "reason": "because 3", "source": "/rec/c", "position": 0,
    }  # fmt: skip
    assert lines[1] == {"task": "roll", "seed": 2, "stage": "recording", "reason": "because 2"}
    write_shard(tmp_path / kept, poor[::-1], "")
    with pytest.raises(DataError, match=r"rejects/roll-000000-000003\.zarr\.zip: damaged"):
        dataset.rejected(0)


def test_a_dataset_of_two_widths_is_told_in_a_sentence(tmp_path: Path) -> None:
    """As an earlier flowlab could make it."""
    wide = make_episode(0)
    narrow = make_episode(1)
    narrow = replace(narrow, action=narrow.action[:, :2])
    with pytest.raises(DataError, match="its action has 2 numbers a step, that of the dataset's other episodes 4"):
        make_dataset(tmp_path / "d", [[wide], [narrow]])
    (told,) = [f for f in validate(tmp_path / "d") if "numbers a step" in f.problem]
    assert "another --out" in told.problem


@pytest.mark.parametrize("recorded_ones", [True, False])
def test_what_the_numbers_are_called_is_told_by_the_first_of_many(recorded_ones: bool, tmp_path: Path) -> None:
    """Every unit asks: no more receipts are read than it takes, or many units would take their number squared."""
    names = tuple("abcdefghi")
    content: dict[str, Any] = {"contents": ("x",)} if recorded_ones else {}
    (tmp_path / "receipts").mkdir()
    keep_receipt(tmp_path, make_receipt([make_episode(0)], **content))
    keep_receipt(tmp_path, make_receipt([make_episode(1)], **content, state_names=names))
    (tmp_path / "receipts/roll-000002-000002.json").write_text("{")
    assert known_row_format(tmp_path) == RowFormat(9, 4, names if recorded_ones else ())
