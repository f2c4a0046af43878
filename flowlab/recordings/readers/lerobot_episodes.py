"""The episodes of a LeRobot dataset: how long each is, what is done in it, and which files hold it."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.limits import MAX_FILES
from flowlab.recordings.folder_files import files_below
from flowlab.recordings.parts import FOLDER_INDEX
from flowlab.recordings.readers.lerobot_info import LeRobotInfo, read_info
from flowlab.recordings.readers.lerobot_process import ask
from flowlab.text import counted, shown
from flowlab.untrusted import parse_json, read_text

_TASKS = ("meta/tasks.parquet", "meta/tasks.jsonl")
_EPISODES = ("meta/episodes", "meta/episodes.jsonl")
_TEXT_OF_TASK = ("task", "__index_level_0__")
_CALLED = "episode_"
_CLOCK_ERROR = 0.01
"""Share of its length by which a video may last longer or shorter than its steps: the rate may be rounded."""


@dataclass(frozen=True, slots=True)
class LeRobotEpisode:
    """An episode, as the dataset tells of it."""

    info: LeRobotInfo
    index: int
    length: int
    tasks: tuple[str, ...]
    """What is done in it, in the words of its entry; see :mod:`.lerobot_tasks`, too."""
    task_words: Mapping[int, str]
    """Of every task of the dataset, by its number."""
    said: Mapping[str, Any]
    """Everything that is said of it."""

    @property
    def only_task(self) -> tuple[str, ...]:
        """The dataset's task, where it has a single one."""
        return tuple(self.task_words.values()) if len(self.task_words) == 1 else ()

    @property
    def where(self) -> Path:
        """What errors call it."""
        return self.info.folder / f"{_CALLED}{self.index:06d}"

    @property
    def data(self) -> Path:
        """The file with its numbers."""
        return self._file(self.info.data_path, "data/")

    def video(self, feature: str) -> tuple[Path, float]:
        """The file with the pictures of a feature, and when they begin in it [s]."""
        path = self._file(self.info.video_path, f"videos/{feature}/", video_key=feature)
        if not self.info.is_v3:
            return path, 0.0
        start, stop = self._second(feature, "from_timestamp"), self._second(feature, "to_timestamp")
        if start is None:
            raise DataError(f"{self.where}: videos/{shown(feature)[1:-1]}/from_timestamp is missing")
        lasts, step = self.length / self.info.fps, 1 / self.info.fps
        if stop is not None and abs(stop - start - lasts) > max(step, _CLOCK_ERROR * lasts):
            raise DataError(
                f"{self.where}: videos/{shown(feature)[1:-1]} is from {start:g} to {stop:g} s in its file, and "
                f"{self.length} steps at {self.info.fps:g} a second last {lasts:g} s; copy meta/episodes again"
            )
        return path, start

    def _second(self, feature: str, key: str) -> float | None:
        value = self.said.get(f"videos/{feature}/{key}")
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e8:
            raise DataError(f"{self.where}: videos/{shown(feature)[1:-1]}/{key} is {shown(value)}, expected seconds")
        return float(value)

    def _file(self, template: str, of: str, **values: str) -> Path:
        if not self.info.is_v3:
            numbers = {"episode_chunk": self.index // self.info.episodes_to_chunk, "episode_index": self.index}
        else:
            numbers = {n: _whole(self.where, self.said, f"{of}{n}") for n in ("chunk_index", "file_index")}
        return self.info.file(template, **numbers, **values)


def read_episodes(folder: Path) -> Mapping[str, LeRobotEpisode]:
    """The episodes of a dataset, by name.

    Args:
        folder: Of the dataset.

    Raises:
        DataError: It is not as it should be.
    """
    files = meta_files(folder)
    state = tuple((file, (about := file.stat()).st_mtime_ns, about.st_size) for file in files)
    return _read(folder, state)


def meta_files(folder: Path) -> list[Path]:
    """The files that say something of episodes and tasks."""
    wanted = [folder / name for name in (FOLDER_INDEX, *_TASKS, *_EPISODES)]
    return [
        found.path
        for place in wanted
        for found in files_below(place)
        if found.path.suffix in (".json", ".jsonl", ".parquet")
    ]


@lru_cache(maxsize=4)
def _read(folder: Path, state: tuple[Any, ...]) -> Mapping[str, LeRobotEpisode]:
    """What :func:`read_episodes` gives, of files as they are now."""
    info = read_info(folder)
    files = [file for file, *_ in state]
    texts = dict(_tasks(folder, files))
    found: dict[int, LeRobotEpisode] = {}
    for place, row in _rows(info, files):
        index = _whole(place, row, "episode_index")
        if index in found:
            raise DataError(f"{place}: has the episode {index} twice")
        length = _whole(place, row, "length", 1 << 62)
        if not 0 < length <= MAX_FILES:
            raise DataError(f"{place}: says the episode {index} has {length:,} steps, expected 1 to {MAX_FILES:,}")
        found[index] = LeRobotEpisode(info, index, length, _words(row.get("tasks"), texts), texts, row)
    if info.total_episodes is not None and info.total_episodes != len(found):
        told = _EPISODES[0 if info.is_v3 else 1]
        raise DataError(
            f"{info.place}: says there are {counted(info.total_episodes, 'episode')}, and {told} has {len(found):,}; "
            "copy it again"
        )
    return {f"{_CALLED}{k:06d}": found[k] for k in sorted(found)}


def _rows(info: LeRobotInfo, files: Sequence[Path]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """What is said of each episode, and where."""
    told = [f for f in files if (f.suffix == ".parquet" and f.name != "tasks.parquet" if info.is_v3
                                 else f.name == "episodes.jsonl")]  # fmt: skip
    if not told:
        name = f"{_EPISODES[0]}/*/*.parquet" if info.is_v3 else _EPISODES[1]
        raise DataError(
            f"{info.folder}: has no {name}, where a dataset of {info.version} tells of its episodes; copy it again"
        )
    for file in told:
        for row in _parquet_rows(file) if info.is_v3 else _json_lines(file):
            yield file, row


def _tasks(folder: Path, files: Sequence[Path]) -> Iterator[tuple[int, str]]:
    """The words of every task, by its index."""
    for file in files:
        if file.name not in ("tasks.parquet", "tasks.jsonl"):
            continue
        for row in _parquet_rows(file) if file.suffix == ".parquet" else _json_lines(file):
            words = next((row[k] for k in _TEXT_OF_TASK if isinstance(row.get(k), str)), None)
            if words is not None:
                yield _whole(file, row, "task_index"), words


def _words(tasks: Any, texts: Mapping[int, str]) -> tuple[str, ...]:
    """What the entry of an episode says is done in it."""
    said = tasks if isinstance(tasks, list) else [tasks]
    words = [texts.get(x, "") if isinstance(x, int) else x for x in said]
    return tuple(dict.fromkeys(x for x in words if isinstance(x, str) and x.strip()))


def _parquet_rows(file: Path) -> Iterator[dict[str, Any]]:
    columns = ask(file, "rows", "stats/")
    for values in zip(*columns.values(), strict=True):
        yield dict(zip(columns, values, strict=True))


def _json_lines(file: Path) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(read_text(file).split("\n"), 1):
        if line.strip():
            row = parse_json(line, f"{file}, line {number}")
            if not isinstance(row, dict):
                raise DataError(f"{file}, line {number}: is {shown(row)}, expected a mapping")
            yield row


def _whole(place: Path, said: Mapping[str, Any], key: str, most: int = 10**9) -> int:
    value = said.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < most:
        raise DataError(f"{place}: {key} is {shown(value)}, expected a whole number from 0 on")
    return value


def one_episode(path: Path, folder: Path, part: str) -> LeRobotEpisode:
    """The episode that a path means.

    Args:
        path: The recording.
        folder: Of the dataset.
        part: What of the path leads on into it.

    Raises:
        DataError: It is none of them, or there are several and it names none.
    """
    episodes = read_episodes(folder)
    number = re.fullmatch(rf"(?:{_CALLED})?0*(\d{{1,9}})", part)
    name = f"{_CALLED}{int(number[1]):06d}" if number else part
    if not part and len(episodes) == 1:
        return next(iter(episodes.values()))
    if name not in episodes:
        found = f"has no episode {shown(part)}" if part else f"has {counted(len(episodes), 'episode')}"
        first = next(iter(episodes), "none")
        raise DataError(f"{path}: {folder.name} {found}; name one of them, as in {folder / first}" if episodes
                        else f"{path}: {folder.name} has no episodes")  # fmt: skip
    return episodes[name]


def is_dataset(folder: Path) -> bool:
    """Whether a folder is a dataset, by the content of its ``meta/info.json``."""
    try:
        return "codebase_version" in parse_json(read_text(folder / FOLDER_INDEX, 1 << 24), "")
    except (DataError, TypeError, OSError, ValueError):
        return False
