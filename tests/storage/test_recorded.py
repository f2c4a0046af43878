"""Recordings keep their numbers, whatever is added, moved or named alike."""

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.errors import DataError, UsageError
from flowlab.storage.recorded import Recorded, number_recordings


def recorded(name: str, task: str = "pour", source: str | None = None) -> Recorded:
    return Recorded(task=task, name=name, source=source or f"/rec/{task}/{name}")


def numbers(table: tuple[Recorded, ...]) -> dict[str, int]:
    return {f"{r.task}/{r.name}": r.seed for r in table}


def test_new_recordings_are_numbered_in_natural_order() -> None:
    found = [recorded(n) for n in ("take-10", "take-2", "b", "take-2b")] + [recorded("z", "fold")]
    assert numbers(number_recordings((), found)) == {
        "fold/z": 0, "pour/b": 1, "pour/take-2": 2, "pour/take-2b": 3, "pour/take-10": 4,
    }  # fmt: skip


def test_known_recordings_keep_their_numbers_and_new_ones_follow() -> None:
    first = number_recordings((), [recorded("5"), recorded("7")])
    second = number_recordings(first, [recorded("6"), recorded("7"), recorded("1")])
    assert numbers(second) == {"pour/5": 0, "pour/7": 1, "pour/1": 2, "pour/6": 3}
    assert number_recordings(second, [recorded("7")]) == second


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(st.lists(st.integers(0, 30), max_size=8), max_size=6), st.randoms())
def test_any_order_of_additions_gives_every_recording_one_number_for_good(
    batches: list[list[int]], dice: random.Random
) -> None:
    table: tuple[Recorded, ...] = ()
    for batch in batches:
        dice.shuffle(batch)
        extended = number_recordings(table, [recorded(f"take {k}") for k in batch])
        assert extended[: len(table)] == table
        assert sorted(r.seed for r in extended) == list(range(len(extended)))
        fresh = [int(r.name.split()[1]) for r in extended[len(table) :]]
        assert fresh == sorted(set(batch) - {int(r.name.split()[1]) for r in table})
        table = extended


def test_a_moved_recording_is_still_the_same(tmp_path: Path) -> None:
    known = number_recordings((), [recorded("a", source=str(tmp_path / "old/a")), recorded("b")])
    moved = number_recordings(known, [recorded("a", source=str(tmp_path / "new/a"))])
    assert numbers(moved) == numbers(known)
    assert {r.name: r.source for r in moved} == {"a": str(tmp_path / "new/a"), "b": "/rec/pour/b"}


def test_two_recordings_of_one_name_are_refused(tmp_path: Path) -> None:
    one, other = recorded("a", source=str(tmp_path)), recorded("a", source="/elsewhere/a")
    sentence = f"two recordings of the task 'pour' are called 'a': {tmp_path} and /elsewhere/a; rename one"
    with pytest.raises(UsageError, match=sentence):
        number_recordings((), [one, other])
    with pytest.raises(UsageError, match=sentence):
        number_recordings(number_recordings((), [one]), [other])


def test_names_may_be_alike_in_different_tasks_and_repeated_paths_count_once() -> None:
    found = [recorded("a"), recorded("a", "fold"), recorded("a")]
    assert numbers(number_recordings((), found)) == {"fold/a": 0, "pour/a": 1}


def test_a_recording_cannot_change_its_task() -> None:
    known = number_recordings((), [recorded("a")])
    with pytest.raises(DataError, match=r"/rec/pour/a: .* under the task 'pour', now .* 'wipe'; give --task pour"):
        number_recordings(known, [recorded("a", "wipe", "/rec/pour/a")])
