"""Names of files and arrays that nothing uses: what they may be, and how many are told in a few words."""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase

from flowlab.recordings.recording_yaml import FILE_NAME
from flowlab.recordings.verdicts import Check, Verdict
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


def matches(name: str, pattern: str) -> bool:
    """Whether a pattern such as ``*.log`` means a file, or a folder that it is in; one with ``./`` none in folders."""
    if pattern.startswith("./"):
        return "/" not in name and fnmatchcase(name, pattern[2:])
    return name == pattern or fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern.rstrip('/')}/*")


def quoted(pattern: str) -> str:
    """A pattern as YAML has it in a list."""
    return cut(pattern if re.fullmatch(r"[\w./][\w./*-]*", pattern) else repr(pattern))


def is_ignored(name: str, patterns: Sequence[str]) -> bool:
    """Whether the user says that a file, an array or a key (``file:key``) is not to be used."""
    return any(matches(name, pattern) for pattern in patterns)


def unread_keys(file: str, keys: Iterable[str], advice: str, ignore: Sequence[str]) -> Iterator[Check]:
    """What is said of the keys of a file that is used which nothing reads.

    Args:
        file: The name of the file.
        keys: What it has and nothing reads.
        advice: What to do about them.
        ignore: What the user says is not to be used.
    """
    every = sorted(keys)
    asked = [key for key in every if not is_ignored(f"{file}:{key}", ignore)]
    if asked:
        quiet = cut(", ".join(f"'{file}:{key}'" for key in asked), 400)
        says = f"{file} has keys that are not read: {cut(', '.join(asked))}{advice}; else write 'ignore: [{quiet}]'"
        yield Check("calibration", Verdict.DOUBTFUL, f"{says} into {FILE_NAME}")
    elif every:
        yield Check("calibration", Verdict.OK, f"{cut(', '.join(every))} of {file} are not read, as 'ignore' says")
