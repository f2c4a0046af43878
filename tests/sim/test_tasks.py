"""The list of tasks against MetaWorld itself."""

import metaworld
import pytest
from metaworld import policies

from flowlab.errors import UsageError
from flowlab.sim.tasks import GROUPS, TASKS, find_task, select_tasks

HARD = {"assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push", "push-back"}
VERY_HARD = {"disassemble", "pick-place-wall", "shelf-place", "stick-pull", "stick-push"}


def test_the_tasks_are_metaworlds() -> None:
    assert {task.environment for task in TASKS.values()} == set(metaworld.ALL_V3_ENVIRONMENTS)
    assert len(TASKS) == 50


def test_the_split_is_that_of_the_published_tables() -> None:
    assert {g: len(names) for g, names in GROUPS.items()} == {
        "easy": 28,
        "medium": 11,
        "hard": 6,
        "very-hard": 5,
        "all": 50,
    }
    assert set(GROUPS["hard"]) == HARD
    assert set(GROUPS["very-hard"]) == VERY_HARD
    assert sorted(n for g in ("easy", "medium", "hard", "very-hard") for n in GROUPS[g]) == sorted(GROUPS["all"])


@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_expert_of_the_task_exists_and_is_its_own(name: str) -> None:
    assert hasattr(policies, TASKS[name].expert)
    assert sum(task.expert == TASKS[name].expert for task in TASKS.values()) == 1


@pytest.mark.parametrize(
    ("typo", "meant"), [("hamer", "hammer"), ("peg-insert", "peg-insert-side"), ("dor-open", "door-open")]
)
def test_a_near_miss_is_told_the_right_name(typo: str, meant: str) -> None:
    with pytest.raises(UsageError, match=rf"no task is called '{typo}'; did you mean.*\b{meant}\b") as caught:
        find_task(typo)
    assert caught.value.exit_code == 2


def test_a_name_like_no_other_is_told_all_names() -> None:
    with pytest.raises(UsageError, match=r"there are: assembly, .*window-open"):
        find_task("zzz")


def test_metaworlds_ending_may_be_left_on() -> None:
    assert find_task("reach-v3") is find_task("reach")


def test_selection_keeps_order_and_names_each_task_once() -> None:
    assert select_tasks(["push", "reach-v3"], ["hard"])[:2] == ("push", "reach")
    assert sorted(select_tasks(["push"], ["hard"])) == sorted(HARD)
    assert len(select_tasks([], ["all", "easy"])) == 50


def test_an_unknown_group_is_told_the_groups() -> None:
    with pytest.raises(UsageError, match=r"did you mean.*very-hard"):
        select_tasks([], ["veryhard"])
