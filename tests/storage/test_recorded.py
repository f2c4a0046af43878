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


def test_two_recordings_of_one_name_that_cannot_be_told_apart_are_refused(tmp_path: Path) -> None:
    one, other = recorded("a", source=str(tmp_path)), recorded("a", source="/elsewhere/a")
    sentence = "two recordings of the task 'pour' are called 'a', which cannot be told apart: .* leave one out, rename"
    with pytest.raises(UsageError, match=sentence):
        number_recordings((), [one, other])
    with pytest.raises(UsageError, match=sentence):
        number_recordings(number_recordings((), [one]), [other])
    with pytest.raises(UsageError, match="called 'a', with the same content"):
        number_recordings(number_recordings((), [known_by(one, "x/1")]), [known_by(other, "x/2")])


def known_by(one: Recorded, content: str) -> Recorded:
    return one.model_copy(update={"content": content})


def test_one_of_the_same_name_and_other_content_is_a_new_recording(tmp_path: Path) -> None:
    monday = number_recordings((), [known_by(recorded("0", source="/mon/pour/0"), "m/")])
    tuesday = known_by(recorded("0", source=str(tmp_path)), "t/")
    both = number_recordings(monday, [tuesday])
    assert [(r.name, r.seed, r.source) for r in both] == [("0", 0, "/mon/pour/0"), ("0-2", 1, str(tmp_path))]
    assert number_recordings(both, [tuesday]) == both
    third = number_recordings(both, [known_by(recorded("0", source="/wed/pour/0"), "w/")])
    assert [r.name for r in third] == ["0", "0-2", "0-3"]
    # All that were archived are known again by their content, wherever they lie.
    back = [known_by(recorded("x", source=f"/back/{k}"), k) for k in ("w/", "m/")]
    assert {r.content: r.seed for r in number_recordings(third, back)} == {"m/": 0, "t/": 1, "w/": 2}


def test_one_that_changed_where_it_lies_is_the_same_and_one_that_took_its_place_is_not() -> None:
    known = number_recordings((), [known_by(recorded("0"), "a/1"), known_by(recorded("1"), "b/1")])
    changed = number_recordings(known, [known_by(recorded("0"), "c/1"), known_by(recorded("1"), "b/2")])
    assert [(r.name, r.seed, r.content) for r in changed] == [("0", 0, "c/1"), ("1", 1, "b/2")]
    moved = number_recordings(known, [known_by(recorded("2"), "a/1"), known_by(recorded("0"), "new/1")])
    assert [(r.source, r.seed, r.content) for r in moved] == [
        ("/rec/pour/2", 0, "a/1"), ("/rec/pour/1", 1, "b/1"), ("/rec/pour/0", 2, "new/1"),
    ]  # fmt: skip
    assert [r.name for r in moved] == ["0", "1", "0-2"]


def test_names_may_be_alike_in_different_tasks_and_repeated_paths_count_once() -> None:
    found = [recorded("a"), recorded("a", "fold"), recorded("a")]
    assert numbers(number_recordings((), found)) == {"fold/a": 0, "pour/a": 1}


def test_a_recording_cannot_change_its_task() -> None:
    known = number_recordings((), [recorded("a")])
    with pytest.raises(DataError, match=r"/rec/pour/a: .* under the task 'pour', now .* 'wipe'; give --task pour"):
        number_recordings(known, [recorded("a", "wipe", "/rec/pour/a")])
