"""Episodes have numbers that no demonstration has, and what became of them survives any kill."""

import multiprocessing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowlab.errors import DataError, UsageError
from flowlab.evaluation import trials as log
from flowlab.evaluation.trials import (
    MOST_SEEDS,
    SCENES_PER_SEED,
    EpisodeResult,
    RolloutFlowError,
    Trial,
    check_unseen,
    trials,
)

TRIALS = st.builds(
    Trial, st.just("hammer"), st.integers(0, MOST_SEEDS - 1), st.integers(0, SCENES_PER_SEED - 1)
)  # fmt: skip
FLOW = RolloutFlowError(
    pairs=64, ade_mm=1.25, zero_ade_mm=8.5, ends=8, fde_mm=2.0, zero_fde_mm=11.0, apd=0.75, zero_apd=0.5,
    average_jaccard=0.6, zero_average_jaccard=0.3, still_pairs=40, still_mm=0.125,
)  # fmt: skip


def outcome(episode: int = 0, **changes: object) -> EpisodeResult:
    trial = Trial("hammer", 0, episode)
    values = {"task": trial.task, "seed": 0, "episode": episode, "scene_seed": trial.scene_seed, "success": True}
    return EpisodeResult.model_validate({**values, "success_dp3": False, "steps": 57, **changes})


@given(TRIALS, TRIALS)
def test_layouts_never_collide(a: Trial, b: Trial) -> None:
    """Not with each other, nor with demonstrations, which are numbered from 0; MetaWorld takes 32 bits."""
    assert (a.scene_seed == b.scene_seed) == (a == b)
    assert 1_000_000 <= a.scene_seed < 2**32


def test_numbers_that_are_promised() -> None:
    """Results that are published name them."""
    assert [Trial("push", s, e).scene_seed for s, e in ((0, 0), (0, 7), (2, 19))] == [1_000_000, 1_000_007, 3_000_019]


def test_every_policy_gets_the_same_trials_in_the_same_order() -> None:
    found = trials(["push", "hammer"], [2, 0, 2], 2)
    assert found == [Trial(task, seed, k) for task in ("push", "hammer") for seed in (2, 0) for k in (0, 1)]
    assert trials(["push"], [0], 5)[:3] == trials(["push"], [0], 3)


@pytest.mark.parametrize(
    ("seeds", "episodes", "sentence"),
    [
        ([0, -1], 1, "seed -1: evaluation seeds are from 0 to 3999"),
        ([4000], 1, "seed 4000: evaluation seeds are from 0 to 3999"),
        ([0], 0, "0 episodes: a seed has from 1 to 1,000,000"),
        ([0], 1_000_001, "1000001 episodes: a seed has from 1 to 1,000,000"),
    ],
)
def test_numbers_that_do_not_exist(seeds: list[int], episodes: int, sentence: str) -> None:
    with pytest.raises(UsageError) as raised:
        trials(["push"], seeds, episodes)
    assert str(raised.value) == sentence


def test_layouts_that_were_demonstrated_are_refused() -> None:
    wanted = trials(["hammer", "push"], [0, 1], 3)
    seen = {"hammer": (0, 1, 2, 1_000_003, 2_000_003), "push": (2_000_001,), "roll": (1_000_000,)}
    with pytest.raises(UsageError) as raised:
        check_unseen(wanted, seen, Path("runs/a"))
    assert str(raised.value) == (
        "runs/a: its dataset holds the layout 2000001 of push, which evaluation seed 1 would try; demonstrations "
        "belong below 1,000,000: make them with another first_seed, or evaluate other --seeds"
    )
    check_unseen([t for t in wanted if t.scene_seed != 2_000_001], seen, Path("runs/a"))
    check_unseen(wanted, {}, Path("runs/a"))


def test_outcomes_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    assert log.read(path) == {}
    written = [outcome(0), outcome(2, flow=FLOW, success_dp3=True), outcome(1, success=False, note="17 °\nand {}")]
    for one in written:
        log.append(path, one)
    assert list(log.read(path).values()) == written
    assert [*log.read(path)] == [Trial("hammer", 0, k) for k in (0, 2, 1)]
    assert path.read_bytes().count(b"\n") == 3
    again = outcome(2, steps=3)
    log.append(path, again)
    assert log.read(path)[Trial("hammer", 0, 2)] == again, "later lines count"


def test_a_line_cut_off_at_any_byte_is_forgotten_and_mended(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    first, second, third = outcome(0), outcome(1, flow=FLOW), outcome(2, note="50 mm ± 3")
    for one in (first, second):
        log.append(path, one)
    whole = path.read_bytes()
    log.append(path, third)
    line = path.read_bytes()[len(whole) :]
    assert len(line) > 100
    for cut in range(len(line)):
        path.write_bytes(whole + line[:cut])
        assert list(log.read(path).values()) == [first, second]
        log.repair_tail(path)
        assert path.read_bytes() == whole
        log.append(path, third)
        assert path.read_bytes() == whole + line
        assert list(log.read(path).values()) == [first, second, third]
    for cut in range(1, whole.index(b"\n") + 1):  # nothing whole is left
        path.write_bytes(whole[:cut])
        assert log.read(path) == {}
        log.repair_tail(path)
        assert path.read_bytes() == b""
    assert [p.name for p in tmp_path.iterdir()] == ["episodes.jsonl"]


def test_what_is_whole_is_not_touched(tmp_path: Path) -> None:
    log.repair_tail(tmp_path / "none.jsonl")
    assert list(tmp_path.iterdir()) == []
    path = tmp_path / "episodes.jsonl"
    log.append(path, outcome())
    before = path.stat()
    log.repair_tail(path)
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (before.st_mtime_ns, before.st_ino)


GOOD = outcome().model_dump_json()


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("{", "'{'"),
        ("", "''"),
        ("[1]", "'[1]'"),
        (GOOD[:40] + GOOD, None),
        (GOOD.replace('"task"', '"tsak"'), None),
        (GOOD.replace('"steps":57', '"steps":"many"'), None),
        (GOOD.replace('"steps"', '"more":1,"steps"'), None),
    ],
)
def test_a_damaged_line_is_said_by_file_and_number(tmp_path: Path, line: str, shown: str | None) -> None:
    path = tmp_path / "episodes.jsonl"
    path.write_text(f"{GOOD}\n{GOOD}\n{line}\n{GOOD}\n")
    with pytest.raises(DataError) as raised:
        log.read(path)
    assert str(raised.value) == (
        f"{path}: line 3 is damaged (expected how an episode went, found {shown or repr(line[:60])}); delete the line, "
        "and the episode is tried again"
    )


def test_bytes_that_are_no_text_are_said_too(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    path.write_bytes(GOOD.encode() + b"\n\xff\xfe\x00\n")
    with pytest.raises(DataError, match=r"episodes.jsonl: line 2 is damaged"):
        log.read(path)


def add_many(path: Path, first: int) -> None:
    for k in range(first, first + 50):
        log.append(path, outcome(k, flow=FLOW))


def test_processes_may_share_a_file(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=add_many, args=(path, 50 * k)) for k in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(60)
        assert writer.exitcode == 0
    assert log.read(path) == {o.trial: o for k in range(200) for o in [outcome(k, flow=FLOW)]}
