"""What became of episodes survives any kill."""

import multiprocessing
import resource
from contextlib import suppress
from pathlib import Path

import pytest

from flowlab.errors import DataError
from flowlab.evaluation.episode_log import append_result, read_results
from flowlab.evaluation.results import EpisodeResult, RolloutFlowError
from flowlab.evaluation.trials import Trial

FLOW = RolloutFlowError(
    pairs=64, ade_mm=1.25, zero_ade_mm=8.5, ends=8, fde_mm=2.0, zero_fde_mm=11.0, apd=0.75, zero_apd=0.5,
    average_jaccard=0.6, zero_average_jaccard=0.3, still_pairs=40, still_mm=0.125,
)  # fmt: skip


def result_of(episode: int = 0, **changes: object) -> EpisodeResult:
    trial = Trial("hammer", 0, episode)
    values = {"task": trial.task, "seed": 0, "episode": episode, "scene_seed": trial.scene_seed, "success": True}
    return EpisodeResult.model_validate({**values, "success_dp3": False, "steps": 57, **changes})


def test_results_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    assert read_results(path) == {}
    written = [
        result_of(0),
        result_of(2, flow=FLOW, success_dp3=True),
        result_of(1, success=False, note="17 °\nand {}"),
    ]
    for one in written:
        append_result(path, one)
    assert list(read_results(path).values()) == written
    assert [*read_results(path)] == [Trial("hammer", 0, k) for k in (0, 2, 1)]
    assert path.read_bytes().count(b"\n") == 3
    again = result_of(2, steps=3)
    append_result(path, again)
    assert read_results(path)[Trial("hammer", 0, 2)] == again, "later lines count"


def test_a_line_cut_off_at_any_byte_is_forgotten_and_mended(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    first, second, third = result_of(0), result_of(1, flow=FLOW), result_of(2, note="50 mm ± 3")
    for one in (first, second):
        append_result(path, one)
    whole = path.read_bytes()
    append_result(path, third)
    line = path.read_bytes()[len(whole) :]
    assert len(line) > 100
    for cut in range(len(line)):
        path.write_bytes(whole + line[:cut])
        assert list(read_results(path).values()) == [first, second]
        append_result(path, third)
        assert path.read_bytes() == whole + line
        assert list(read_results(path).values()) == [first, second, third]
    for cut in range(1, whole.index(b"\n") + 1):  # nothing whole is left
        path.write_bytes(whole[:cut])
        assert read_results(path) == {}
        append_result(path, third)
        assert path.read_bytes() == line
    assert [p.name for p in tmp_path.iterdir()] == ["episodes.jsonl"]


def test_a_changed_byte_anywhere_is_found(tmp_path: Path) -> None:
    """In a line or its end; none passes for another result."""
    path = tmp_path / "episodes.jsonl"
    for one in (result_of(0, flow=FLOW), result_of(1)):
        append_result(path, one)
    whole, known = path.read_bytes(), read_results(path)
    for position in range(len(whole) - 1):
        for bit in (1, 4, 32):
            content = bytearray(whole)
            content[position] ^= bit
            path.write_bytes(content)
            with suppress(DataError):
                assert read_results(path) == known, "a changed byte has no meaning, or is found"


def test_a_disk_without_room_leaves_no_half_of_a_line(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    append_result(path, result_of(0))
    whole = path.read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + 30, before[1]))
    try:
        with pytest.raises(
            DataError, match=r"cannot be written \(.*\); what was kept before is whole; make room, then"
        ):
            append_result(path, result_of(1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == whole


GOOD = result_of().model_dump_json()


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("{", "'{'"),
        ("", "''"),
        ("[1]", "(found [1])"),
        (GOOD[:40] + GOOD, None),
        (GOOD.replace('"task"', '"tsak"'), "task: Field required"),
        (GOOD.replace('"steps":57', '"steps":"many"'), "steps: Input should be a valid integer, unable"),
        (GOOD.replace('"steps"', '"more":1,"steps"'), "no setting is called 'more'"),
        ("[" * 5000, None),
        ("1" * 5000, None),
    ],
)
def test_a_damaged_line_is_said_by_file_and_number(tmp_path: Path, line: str, shown: str | None) -> None:
    path = tmp_path / "episodes.jsonl"
    path.write_text(f"{GOOD}\n{GOOD}\n{line}\n{GOOD}\n")
    with pytest.raises(DataError) as raised:
        read_results(path)
    said = str(raised.value)
    assert said.startswith(f"{path}: line 3 is damaged (")
    assert said.endswith("; delete the line, and the episode is tried again")
    assert (shown or f"expected how an episode went, found '{line[:60]}'") in said


def test_bytes_that_are_no_text_are_said_too(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    path.write_bytes(GOOD.encode() + b"\n\xff\xfe\x00\n")
    with pytest.raises(DataError, match=r"episodes.jsonl: line 2 is damaged"):
        read_results(path)


def add_many(path: Path, first: int) -> None:
    for k in range(first, first + 50):
        append_result(path, result_of(k, flow=FLOW))


def test_processes_may_share_a_file(tmp_path: Path) -> None:
    path = tmp_path / "episodes.jsonl"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=add_many, args=(path, 50 * k)) for k in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(60)
        assert writer.exitcode == 0
    assert read_results(path) == {o.trial: o for k in range(200) for o in [result_of(k, flow=FLOW)]}
