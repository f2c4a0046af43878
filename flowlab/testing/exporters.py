"""Does an exporter keep its promises? Checks for authors of plug-ins, against a small dataset.

In the tests of a plug-in::

    from flowlab.testing.exporters import CHECKS

    @pytest.mark.parametrize("check", CHECKS)
    def test_exporter(check, dataset):
        check(MyExporter, dataset)
"""

import multiprocessing
import os
import pickle
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from flowlab.errors import DataError, FlowlabError
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.base import Exporter
from flowlab.testing.promises import content, require, require_words
from flowlab.text import counted

MakeExporter = Callable[[], Exporter]
ReadBack = Callable[[Path], Iterable[Episode]]


def check_exporter(make: MakeExporter, dataset: Dataset, read_back: ReadBack | None = None) -> None:
    """Raise an AssertionError that says which promise an exporter breaks.

    Args:
        make: Makes the exporter, as its class does. Its class must be importable, so that it can be killed at work
            in a process of its own.
        dataset: A dataset of at least two tasks and three episodes; it stays as it is.
        read_back: Reads what was written as episodes, in the order of the dataset, where that can be done. Their
            state, action and point cloud are compared.
    """
    require(len(dataset) >= 3 and len(_tasks(dataset)) >= 2, "the checks need two tasks and three episodes")
    for check in CHECKS:
        check(make, dataset)
    if read_back is not None:
        check_round_trip(make, dataset, read_back)


def check_description(make: MakeExporter, dataset: Dataset) -> None:
    """It is a frozen group of settings, and says what it is called and what it writes."""
    exporter = make()
    require(isinstance(exporter, Exporter), f"it must be an Exporter, but is a {type(exporter).__name__}")
    require_words(exporter, "name", "writes")


def check_written(make: MakeExporter, dataset: Dataset) -> None:
    """It writes where it is told and nowhere else, and says how many episodes these are."""
    before = content(dataset.path)
    with _place() as folder:
        try:
            count = make().export(dataset, folder / "deeper" / "out")
        except OSError as error:
            raise AssertionError(
                f"export() must make the folders that lead to where it writes, but raises {error!r}; call "
                "path.parent.mkdir(parents=True, exist_ok=True), or write into flowlab.files.new_folder(path)"
            ) from error
        require(count == len(dataset), f"export() must return {len(dataset)}, how many it wrote, but returns {count!r}")
        found = sorted(p.name for p in (folder / "deeper").iterdir())
        require(found == ["out"], f"export() must leave 'out', as it was told, and nothing beside; it leaves {found}")
    require(content(dataset.path) == before, "export() must not write into the dataset")


def check_tasks(make: MakeExporter, dataset: Dataset) -> None:
    """One task may be asked for; one that the dataset lacks is refused."""
    with _place() as folder:
        for task in _tasks(dataset):
            wanted = sum(ref.task == task for ref in dataset.refs)
            count = make().export(dataset, folder / task, task)
            require(
                count == wanted,
                f"of the task '{task}' there are {counted(wanted, 'episode')}, but export() writes {count!r}",
            )
        alone = [content(folder / task) for task in _tasks(dataset)]
        require(alone[0] != alone[1], "export() must write the episodes of the task that it is asked for, not others")
    with _place() as folder:
        _refused(make, dataset, folder / "out", "a task that the dataset lacks", task="no such task")
        require(not any(folder.iterdir()), "a task that the dataset lacks must leave nothing behind")


def check_same_bytes(make: MakeExporter, dataset: Dataset) -> None:
    """The same dataset gives the same bytes, so that what was published can be checked."""
    with _place() as folder:
        for name in ("one", "other"):
            make().export(dataset, folder / name)
        require(content(folder / "one") == content(folder / "other"), "export() must write the same bytes every time")


def check_never_overwritten(make: MakeExporter, dataset: Dataset) -> None:
    """What is there already is refused, and stays."""
    with _place() as folder:
        (folder / "file").write_text("precious")
        (folder / "folder").mkdir()
        (folder / "folder" / "file").write_text("precious")
        (folder / "empty folder").mkdir()
        (folder / "link").symlink_to(folder / "nowhere")
        before = content(folder)
        for name in ("file", "folder", "empty folder", "link"):
            _refused(make, dataset, folder / name, f"'{name}', which is there already,")
        require(content(folder) == before, "export() must leave what exists as it is")


def check_unwritable(make: MakeExporter, dataset: Dataset) -> None:
    """Where nothing can be written is one sentence."""
    with _place() as folder:
        (folder / "file").write_text("precious")
        _refused(make, dataset, folder / "file" / "out", "a place below a file")
        require((folder / "file").read_text() == "precious", "export() must leave what exists as it is")


def check_failure(make: MakeExporter, dataset: Dataset) -> None:
    """An episode that cannot be read leaves nothing: what exists is whole."""
    for whole in range(len(dataset)):
        with _place() as folder:
            _refused(make, _Damaged(dataset.path, whole), folder / "out", "a damaged dataset")
            left = sorted(p.name for p in folder.iterdir())
            require(not left, f"after an episode that could not be read nothing must be left, but there is {left}")


def check_killed(make: MakeExporter, dataset: Dataset) -> None:
    """Killed in the middle, it leaves nothing under the name; afterwards the same export does it."""
    exporter = make()
    try:
        pickle.dumps(exporter)
    except Exception as error:
        raise AssertionError(
            f"its class must be importable by name, so that it can be killed at work in a process of its own ({error})"
        ) from error
    with _place() as folder:
        exporter.export(dataset, folder / "whole")
        process = multiprocessing.get_context("spawn").Process(
            target=exporter.export, args=(_Killing(dataset.path, len(dataset) - 1), folder / "out"), daemon=True
        )
        process.start()
        process.join()
        there = (folder / "out").exists()
        require(
            not there or content(folder / "out") == content(folder / "whole"),
            "killed in the middle, export() must leave nothing under the name it was given; write beside it and rename",
        )
        if not there:
            exporter.export(dataset, folder / "out")
        require(content(folder / "out") == content(folder / "whole"), "after a kill the same export must write it all")
        left = sorted(p.name for p in folder.iterdir() if p.name not in ("out", "whole"))
        require(not left, f"the next export must clear away what a killed one was making, but leaves {left}")


def check_round_trip(make: MakeExporter, dataset: Dataset, read_back: ReadBack) -> None:
    """What was written is what the dataset holds."""
    with _place() as folder:
        make().export(dataset, folder / "out")
        found = list(read_back(folder / "out"))
        require(
            len(found) == len(dataset),
            f"{counted(len(dataset), 'episode')} must be read back, but these are {len(found)}",
        )
        for k, episode in enumerate(found):
            truth = dataset.episode(k)
            for name in ("state", "action", "point_cloud"):
                same = np.array_equal(getattr(episode, name), getattr(truth, name))
                require(same, f"{name} of episode {k} must be read back as it is in the dataset")


CHECKS: tuple[Callable[[MakeExporter, Dataset], None], ...] = (
    check_description,
    check_written,
    check_tasks,
    check_same_bytes,
    check_never_overwritten,
    check_unwritable,
    check_failure,
    check_killed,
)
"""Every promise of :class:`~flowlab.storage.exporters.base.Exporter` that holds for any format, one at a time."""


class _Failing(Dataset):
    """A dataset that gives out some episodes, and then something happens."""

    def __init__(self, path: Path, whole: int) -> None:
        super().__init__(path)
        self._whole = whole

    def episode(self, index: int) -> Episode:
        """One episode less to go."""
        self._count_down()
        return super().episode(index)

    def episodes(self) -> Iterator[Episode]:
        """Episodes as far as it goes."""
        for episode in super().episodes():
            self._count_down()
            yield episode

    def _count_down(self) -> None:
        """One episode less; something happens when none is left."""
        if self._whole == 0:
            self._happen()
        self._whole -= 1

    def _happen(self) -> None:
        """What happens."""
        raise NotImplementedError


class _Damaged(_Failing):
    def _happen(self) -> None:
        """What happens."""
        raise DataError(f"{self.path}: damaged for a check")


class _Killing(_Failing):
    def _happen(self) -> None:
        """What happens."""
        os.kill(os.getpid(), signal.SIGKILL)


def _tasks(dataset: Dataset) -> list[str]:
    """The tasks of a dataset."""
    return sorted({ref.task for ref in dataset.refs})


def _refused(make: MakeExporter, dataset: Dataset, path: Path, what: str, task: str | None = None) -> None:
    """Require that an export is refused in one sentence."""
    try:
        make().export(dataset, path, task)
    except FlowlabError as error:
        require(str(error).strip() and "\n" not in str(error), f"{what} must be refused in one sentence, not {error!s}")
        return
    except Exception as error:
        raise AssertionError(f"{what} must be refused by a DataError, but raises {error!r}") from error
    raise AssertionError(f"{what} must be refused, but is not")


@contextmanager
def _place() -> Iterator[Path]:
    """A temporary folder."""
    with tempfile.TemporaryDirectory(prefix="flowlab-check-") as folder:
        yield Path(folder).resolve()
