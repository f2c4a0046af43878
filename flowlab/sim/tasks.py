"""The 50 tasks of MetaWorld v3, by difficulty."""

from collections.abc import Iterable
from dataclasses import dataclass

from flowlab.errors import unknown_name

_BY_DIFFICULTY = {
    "easy": """button-press button-press-topdown button-press-topdown-wall button-press-wall coffee-button
        dial-turn door-close door-lock door-open door-unlock drawer-close drawer-open faucet-close faucet-open
        handle-press handle-press-side handle-pull handle-pull-side lever-pull peg-unplug-side plate-slide
        plate-slide-back plate-slide-back-side plate-slide-side reach reach-wall window-close window-open""",
    "medium": """basketball bin-picking box-close coffee-pull coffee-push hammer peg-insert-side push-wall
        soccer sweep sweep-into""",
    "hard": "assembly hand-insert pick-out-of-hole pick-place push push-back",
    "very-hard": "disassemble pick-place-wall shelf-place stick-pull stick-push",
}
"""Source: the split of the DP3 and 3D FDP tables, as LeRobot's MetaWorld configuration lists it."""

_MANIPULATED = {
    "coffee-button": "cmbutton",
    "coffee-pull": "mug",
    "coffee-push": "mug",
    "hammer": "hammer",
    "stick-pull": "stick",
    "stick-push": "stick",
}
"""The manipulated body where several can move; elsewhere it is the only one."""


@dataclass(frozen=True, slots=True)
class Task:
    """One MetaWorld task."""

    name: str
    difficulty: str
    manipulated: str | None
    """Name of the body (or its root) whose pose counts as the object's, if several bodies can move."""

    @property
    def environment(self) -> str:
        """MetaWorld's name of the environment."""
        return f"{self.name}-v3"

    @property
    def expert(self) -> str:
        """Class name of MetaWorld's scripted expert."""
        stem = {"peg-insert-side": "peg-insertion-side"}.get(self.name, self.name)
        return "Sawyer" + "".join(part.capitalize() for part in stem.split("-")) + "V3Policy"


TASKS = {
    name: Task(name, difficulty, _MANIPULATED.get(name))
    for difficulty, names in _BY_DIFFICULTY.items()
    for name in sorted(names.split())
}
GROUPS = {**{g: tuple(n for n, t in TASKS.items() if t.difficulty == g) for g in _BY_DIFFICULTY}, "all": tuple(TASKS)}


def find_task(name: str) -> Task:
    """The task of that name; MetaWorld's ``-v3`` ending may be left on."""
    task = TASKS.get(name.removesuffix("-v3"))
    if task is None:
        raise unknown_name("task", name, TASKS)
    return task


def tasks_named(names: Iterable[str]) -> tuple[str, ...]:
    """Names of tasks for names of tasks and of groups: the tasks first, then those of the groups, each once."""
    names = list(names)
    return select_tasks([n for n in names if n not in GROUPS], [n for n in names if n in GROUPS])


def select_tasks(names: Iterable[str], groups: Iterable[str]) -> tuple[str, ...]:
    """Names of the given tasks and groups, each once, in the order given."""
    chosen = [find_task(name).name for name in names]
    for group in groups:
        if group not in GROUPS:
            raise unknown_name("group of tasks", group, GROUPS)
        chosen += GROUPS[group]
    return tuple(dict.fromkeys(chosen))
