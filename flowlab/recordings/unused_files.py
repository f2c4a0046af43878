"""Names of files and arrays that nothing uses: what they may be, and how many are told in a few words."""

from collections import defaultdict
from collections.abc import Iterable, Sequence

from flowlab.text import cut

_SHOWN = 5
_TOLD_ALONE = 3
"""More files than so many of one folder are told as the folder."""
_OF_ROBOTS = {
    "state": ("state", "joint", "qpos", "agent_pos", "proprio", "tcp", "ee_pose", "eef", "gripper", "robot"),
    "action": ("action", "command"),
}  # fmt: skip
"""What a robot's numbers are called."""


def robot_numbers(name: str, what: str) -> bool:
    """Whether something is called as the numbers of a robot may be.

    Args:
        name: Of a file without its ending, or of an array.
        what: ``state`` or ``action``.
    """
    return name.lower().startswith(_OF_ROBOTS[what]) and "time" not in name.lower()


def some_of(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return cut(", ".join(names[:_SHOWN])) + more


def by_folder(names: Iterable[str]) -> list[str]:
    """Names of files, those of a folder with many as one."""
    folders: dict[str, list[str]] = defaultdict(list)
    for name in names:
        folders[name.rpartition("/")[0]].append(name)
    told = []
    for folder, files in folders.items():
        told += [f"{folder}/ ({len(files)} files)"] if folder and len(files) > _TOLD_ALONE else files
    return told
