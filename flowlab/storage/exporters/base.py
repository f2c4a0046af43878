"""What an exporter is: settings, and a way to write a dataset in another tool's layout."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import ValidationError

from flowlab.config import Settings, explain, override
from flowlab.errors import DataError, UsageError
from flowlab.registry import EXPORTERS
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import EpisodeRef


class Exporter(Settings, ABC):
    """Writes datasets in one layout. The fields of a subclass are its options."""

    name: ClassVar[str]
    writes: ClassVar[str]
    """What it writes, in a few words: the format, and which tool reads it."""

    @abstractmethod
    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        """Write episodes of a dataset.

        Args:
            dataset: Where they are from; nothing in it is changed.
            path: The file or folder to make. It is there whole or not at all, whatever happens in between.
            task: Write only the episodes of this task.

        Returns:
            How many episodes were written.

        Raises:
            DataError: The path exists or cannot be written, or the dataset has no such episodes or is damaged.
        """


def make_exporter(name: str, settings: Sequence[str] = ()) -> Exporter:
    """An exporter with options.

    Args:
        name: An installed exporter, or an import path ``module:Class``.
        settings: ``key=value`` of the exporter's own fields.

    Raises:
        UsageError: There is no such exporter, or no such option, or an option has a value that does not fit.
    """
    cls = EXPORTERS.load(name)
    options: dict[str, Any] = {}
    for text in settings:
        override(options, text, cls.model_fields, "KEY=VALUE")
    try:
        exporter: Exporter = cls.model_validate(options)
    except ValidationError as error:
        raise UsageError(f"exporter '{name}': {explain(error, cls)}") from error
    return exporter


def select_episodes(dataset: Dataset, path: Path, task: str | None) -> list[EpisodeRef]:
    """What an exporter is to write: the episodes of a task, or all, in the dataset's order.

    Raises:
        DataError: The path is in use, or there are no such episodes.
    """
    if path.exists() or path.is_symlink():
        raise DataError(f"{path}: exists already; remove it or choose another --out")
    chosen = [ref for ref in dataset.refs if task in (None, ref.task)]
    if not chosen:
        asked = "no episodes" if task is None else f"no episodes of '{task}'"
        raise DataError(f"{dataset.path}: {asked}; it has {', '.join(dataset.manifest.requested)}")
    return chosen
