"""Stages, and how they are joined."""

import time
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

from pydantic import ValidationError

from flowlab.config import Settings, explain
from flowlab.demonstrations import Demonstration
from flowlab.errors import FlowlabError, UsageError, first_line
from flowlab.provenance import Provenance
from flowlab.records import Episode
from flowlab.storage.receipts import StageTally
from flowlab.text import shown


class Rejected(FlowlabError):
    """Raised by a stage that will not let a record pass; the reason is kept in the dataset.

    Args:
        reason: What was found, what was expected, and what to do about it.
        episode: The episode, where there is one that people may look at; it is kept beside the dataset's own.
        retry: Whether the cause lies outside the dataset, as that of a recording that cannot be opened: the same
            command tries again.
        stage: Name of the stage; the pipeline fills it in.
    """

    def __init__(self, reason: str, *, episode: Episode | None = None, retry: bool = False, stage: str = "") -> None:
        super().__init__(reason)
        self.reason, self.episode, self.retry, self.stage = reason, episode, retry, stage


class Stage(Settings):
    """One step of a pipeline: settings, and a ``process`` from one record to the next.

    A stage of your own is a subclass with an annotated ``process``, put into a recipe by import path
    (``stage: my_package.my_module:MyStage``). The annotations are what the pipeline checks joins by.
    """

    stage: str
    """The stage's name in recipes."""
    of: ClassVar[type] = object
    """The kind of demonstration the stage can work on, where not every kind will do."""

    def process(self, record: Any) -> Any:
        """Turn a record into the next. A subclass says by its annotations which records these are.

        Args:
            record: What the stage before this one made; the first gets an :class:`EpisodeRequest`.

        Returns:
            The next record, a new one.

        Raises:
            Rejected: The record is kept out of the dataset, for the reason given.
        """
        raise NotImplementedError

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """What is known of a dataset's episodes after this stage, given what was known before it.

        Args:
            provenance: What the stages before this one have said.
            task: One of the dataset's tasks, the same for all stages.

        Returns:
            The same with what this stage knows: ``provenance.model_copy(update={...})``.
        """
        return provenance

    @classmethod
    def takes(cls) -> type:
        """The type of record the stage works on.

        Returns:
            What ``process`` is annotated to take.
        """
        return cls._types()[0]

    @classmethod
    def gives(cls) -> type:
        """The type of record the stage makes.

        Returns:
            What ``process`` is annotated to return.
        """
        return cls._types()[1]

    @classmethod
    def _types(cls) -> tuple[type, type]:
        hints = get_type_hints(cls.process)
        result = hints.pop("return", None)
        if len(hints) != 1 or result is None or Any in (result, *hints.values()):
            raise UsageError(f"stage {cls.__name__}: process must say what it takes and gives: (self, record: A) -> B")
        return next(iter(hints.values())), result


class EpisodeRequest(Settings):
    """The record every pipeline starts from: make the episode of this task and seed."""

    task: str
    seed: int
    source: str = ""
    """Path of the recording that the seed stands for; empty for simulation."""


class Writer(Stage):
    """The last stage: takes the episodes of a work unit one by one, then stores them together."""

    def process(self, record: Episode) -> Episode:
        """What is to be stored of an episode; the rest of it need not stay in memory."""
        raise NotImplementedError

    def store(self, path: Path, episodes: Sequence[Episode], settings_digest: str) -> None:
        """Write the episodes of a unit to ``path``, which must be either absent or whole at any moment."""
        raise NotImplementedError


class Pipeline:
    """Stages joined from an :class:`EpisodeRequest` to an :class:`~flowlab.records.Episode`, and a last one
    that stores episodes."""

    def __init__(self, stages: Sequence[Stage]) -> None:
        self.stages = tuple(stages)
        self.tallies = {s.stage: StageTally() for s in stages}
        _check_joins(self.stages)
        last = self.stages[-1]
        assert isinstance(last, Writer)
        self.writer = last

    def provenance(self, task: str) -> Provenance:
        """Where the episodes that this pipeline makes come from, and what their numbers mean, as its stages say."""
        return reduce(lambda known, stage: _described(stage, known, task), self.stages, Provenance())

    def run(self, request: EpisodeRequest) -> Episode:
        """Make one episode. Raises :class:`Rejected`, which names the stage that did not let it pass."""
        record: Any = request
        for stage in self.stages:
            record = self._process(stage, record)
        assert isinstance(record, Episode)
        record.check_numbers()
        return record

    def store(self, path: Path, episodes: Sequence[Episode], settings_digest: str) -> None:
        """Store the episodes of a unit."""
        start = time.process_time()
        self.writer.store(path, episodes, settings_digest)
        self._count(self.writer, StageTally(cpu_s=time.process_time() - start))

    def _process(self, stage: Stage, record: Any) -> Any:
        start, rejects = time.process_time(), 0
        try:
            return stage.process(record)
        except Rejected as rejected:
            rejects = 1
            rejected.stage = stage.stage
            raise
        finally:
            self._count(stage, StageTally(calls=1, cpu_s=time.process_time() - start, rejects=rejects))

    def _count(self, stage: Stage, done: StageTally) -> None:
        self.tallies[stage.stage] = self.tallies[stage.stage].plus(done)


def _described(stage: Stage, known: Provenance, task: str) -> Provenance:
    """What a stage adds to what is known; what it says wrong is told before anything is written."""
    try:
        found = stage.describe(known, task)
    except FlowlabError:
        raise
    except Exception as error:  # whatever somebody's stage does
        raise UsageError(
            f"stage '{stage.stage}': its describe fails ({type(error).__name__}: {first_line(error)})"
        ) from error
    if not isinstance(found, Provenance):
        raise UsageError(
            f"stage '{stage.stage}': its describe returns {shown(found)}, expected a Provenance, as in "
            "'return provenance.model_copy(update={...})'"
        )
    try:
        return Provenance.model_validate(dict(found))  # which model_copy does not do
    except ValidationError as error:
        raise UsageError(f"stage '{stage.stage}': its describe says {explain(error, Provenance)}") from error


def _check_joins(stages: Sequence[Stage]) -> None:
    """Refuse stages that do not fit together."""
    given: type = EpisodeRequest
    giver, source = "the pipeline's start", None
    for stage in stages:
        if not issubclass(given, stage.takes()):
            raise UsageError(
                f"stage '{stage.stage}' takes {stage.takes().__name__}, but {giver} gives {given.__name__}"
            )
        if source is not None and not issubclass(source, stage.of):
            raise UsageError(
                f"stage '{stage.stage}' works on demonstrations of type {stage.of.__name__} only, "
                f"and these are of type {source.__name__}"
            )
        given, giver = stage.gives(), f"stage '{stage.stage}'"
        if issubclass(given, Demonstration):
            source = given
    if not (stages and isinstance(stages[-1], Writer)):
        raise UsageError(f"the last stage must store the episodes, as 'write' does, but the last is {giver}")
