"""The shipped checks of exporters: ours keeps every promise, and whoever breaks one is told which."""

import pickle
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic import make_dataset, make_episode

from flowlab.errors import DataError
from flowlab.files import new_folder
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.base import Exporter, select_episodes
from flowlab.storage.exporters.dp3 import DP3Exporter
from flowlab.storage.importers.dp3 import DP3Store
from flowlab.testing.exporters import CHECKS, MakeExporter, check_exporter, check_round_trip


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two tasks, whose episodes lie in shards in another order."""
    made = [make_episode(k, task=task, steps=len(task) + n) for n, task in ((16, "push"), (23, "roll")) for k in (0, 1)]
    return make_dataset(tmp_path_factory.mktemp("data") / "d", [[made[3], made[2]], [made[0], made[1]]])


@pytest.mark.parametrize("check", CHECKS)
def test_ours_keeps_every_promise(check: Callable[[MakeExporter, Dataset], None], dataset: Dataset) -> None:
    check(DP3Exporter, dataset)


def test_ours_is_read_back(dataset: Dataset) -> None:
    check_round_trip(DP3Exporter, dataset, lambda path: DP3Store(path).episodes())


class Lengths(Exporter):
    """Writes a file for every episode, as every exporter should; the others have got one thing wrong."""

    name = "lengths"
    writes = "text files with the length of every episode"

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        chosen = select_episodes(dataset, path, task)
        try:
            with new_folder(path) as folder:
                self.write(dataset, folder, task)
        except OSError as error:
            raise DataError(f"{path}: cannot be written ({error.strerror})") from error
        return len(chosen)

    def write(self, dataset: Dataset, folder: Path, task: str | None) -> None:
        for index, ref in enumerate(dataset.refs):
            if task in (None, ref.task):
                (folder / f"{ref.task}-{ref.seed}").write_text(f"{len(dataset.episode(index))}\n")


class Nameless(Lengths):
    name = ""


class Miscounted(Lengths):
    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        super().export(dataset, path, task)
        return len(list(path.iterdir())) + 1


class AllTasks(Lengths):
    def write(self, dataset: Dataset, folder: Path, task: str | None) -> None:
        super().write(dataset, folder, None)


class Dated(Lengths):
    def write(self, dataset: Dataset, folder: Path, task: str | None) -> None:
        super().write(dataset, folder, task)
        (folder / "date").write_text(f"{time.time_ns()}")


class Logged(Lengths):
    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        count = super().export(dataset, path, task)
        path.with_suffix(".log").write_text("done")
        return count


class Marked(Lengths):
    def write(self, dataset: Dataset, folder: Path, task: str | None) -> None:
        super().write(dataset, folder, task)
        (dataset.path / "exported").touch()


class Overwriting(Lengths):
    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        if path.is_dir() and any(path.iterdir()):
            shutil.rmtree(path)
        return super().export(dataset, path, task)


class OverEmpty(Lengths):
    """Takes an empty folder for nothing, as renaming a folder does."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        if path.is_dir() and not any(path.iterdir()):
            path.rmdir()
        return super().export(dataset, path, task)


class InPlace(Lengths):
    """Cleans up after an error, but not after a kill."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        chosen = select_episodes(dataset, path, task)
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise DataError(f"{path}: cannot be written ({error.strerror})") from error
        try:
            self.write(dataset, path, task)
        except BaseException:
            shutil.rmtree(path)
            raise
        return len(chosen)


class Unclean(Lengths):
    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        chosen = select_episodes(dataset, path, task)
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise DataError(f"{path}: cannot be written ({error.strerror})") from error
        self.write(dataset, path, task)
        return len(chosen)


class Littering(Lengths):
    """What it was making when it was killed, it makes anew under another name."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        chosen = select_episodes(dataset, path, task)
        temporary = path.with_name(f"{path.name}-{time.time_ns()}")
        try:
            temporary.mkdir(parents=True)
        except OSError as error:
            raise DataError(f"{path}: cannot be written ({error.strerror})") from error
        try:
            self.write(dataset, temporary, task)
            temporary.rename(path)
        except BaseException:
            shutil.rmtree(temporary)
            raise
        return len(chosen)


class Unguarded(Lengths):
    """Lets the system's errors through."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        chosen = select_episodes(dataset, path, task)
        path.mkdir(parents=True)
        self.write(dataset, path, task)
        return len(chosen)


class AnyTask(Lengths):
    """Writes nothing where there is nothing to write."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        if task is not None and not any(ref.task == task for ref in dataset.refs):
            return 0
        return super().export(dataset, path, task)


class Homeless(Lengths):
    """Leaves it to others to make the folder that it writes into."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        path.mkdir()
        return super().export(dataset, path, task)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (Nameless, "name must be some words, but is ''"),
        (Miscounted, r"export\(\) must return 4, how many it wrote, but returns 5"),
        (Homeless, r"must make the folders that lead to where it writes, but raises FileNotFoundError.*mkdir\(parents"),
        (AllTasks, "must write the episodes of the task that it is asked for"),
        (AnyTask, "a task that the dataset lacks must be refused, but is not"),
        (Dated, "must write the same bytes every time"),
        (Logged, r"and nothing beside; it leaves \['out', 'out.log'\]"),
        (Marked, "must not write into the dataset"),
        (Overwriting, "'folder', which is there already, must be refused, but is not"),
        (OverEmpty, "'empty folder', which is there already, must be refused, but is not"),
        (Unguarded, "a place below a file must be refused by a DataError, but raises"),
        (Unclean, r"nothing must be left, but there is \['out'\]"),
        (InPlace, "killed in the middle, .* must leave nothing under the name it was given"),
        (Littering, "must clear away what a killed one was making, but leaves"),
    ],
)
def test_a_broken_promise_is_named(broken: type[Exporter], message: str, dataset: Dataset, tmp_path: Path) -> None:
    copy = Dataset(shutil.copytree(dataset.path, tmp_path / "d"))
    with pytest.raises(AssertionError, match=message):
        check_exporter(broken, copy)


def test_what_breaks_nothing_passes(dataset: Dataset) -> None:
    check_exporter(Lengths, dataset)


def test_a_class_that_cannot_be_killed_in_a_process_of_its_own_is_told(dataset: Dataset) -> None:
    class Hidden(Lengths):
        pass

    with pytest.raises((AttributeError, pickle.PicklingError)):
        pickle.dumps(Hidden())
    with pytest.raises(AssertionError, match="its class must be importable by name"):
        check_exporter(Hidden, dataset)


def test_what_is_read_back_wrong_is_told(dataset: Dataset) -> None:
    def reversed_in_time(path: Path) -> list[object]:
        from dataclasses import replace

        return [replace(e, state=np.ascontiguousarray(e.state[::-1])) for e in DP3Store(path).episodes()]

    with pytest.raises(AssertionError, match="state of episode 0 must be read back as it is in the dataset"):
        check_exporter(DP3Exporter, dataset, reversed_in_time)  # type: ignore[arg-type]
    with pytest.raises(AssertionError, match="4 episodes must be read back, but these are 0"):
        check_round_trip(DP3Exporter, dataset, lambda path: [])
