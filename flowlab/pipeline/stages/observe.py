"""The stages that see: the clouds of every frame, and the query points on the first."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from flowlab.config import Settings
from flowlab.demonstrations import Demonstration, ObservedDemo, QueriedDemo
from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, queries_in
from flowlab.pipeline.stage import Rejected, Stage
from flowlab.provenance import Provenance
from flowlab.records import Frame


class ObserverStage(Stage, ObserverSettings):
    """The Observer looks at every frame."""

    stage: str = "observer"

    def process(self, record: Demonstration) -> ObservedDemo:
        """Unproject, crop and sample every frame. Pictures are read for the last time, so what they are read from must
        be as it was when it was opened."""
        with read_as_a_whole(record.changed):
            return self._observe(record)

    def _observe(self, record: Demonstration) -> ObservedDemo:
        observer = Observer(self, record.task)
        first = _frame(record, 0)
        steps, shape = len(record), first.depth.shape
        points = np.empty((steps, self.points, 3), np.float32)
        count = np.empty(steps, np.int32)
        depth = np.empty((steps, *shape), np.float32)
        owner = None if first.owner is None else np.empty((steps, *shape), np.int16)
        rgb = None if first.rgb is None else np.empty((steps, *shape, 3), np.uint8)
        for t in range(steps):
            frame = first if t == 0 else _frame(record, t)
            try:
                seen = observer.observe(frame)
            except DataError as error:
                raise Rejected(f"step {t}: {error}") from error
            points[t], count[t], depth[t] = seen.points_world, seen.count, frame.depth
            if owner is not None:
                owner[t] = frame.owner
            if rgb is not None:
                rgb[t] = frame.rgb
        return ObservedDemo(record, points, count, observer.cloud(first), depth, owner, rgb)

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """How the clouds were made, so that a policy's are made the same way."""
        return provenance.model_copy(update={"observer": _settings(self, ObserverSettings)})


@contextmanager
def read_as_a_whole(changed: Callable[[], str]) -> Iterator[None]:
    """What is read of files that change meanwhile is rejected, be it well or badly read, to be tried again.

    Args:
        changed: Tells what has changed of what is read, after its path; nothing where nothing has.

    Raises:
        Rejected: It has changed, or is not there any more.
    """
    fault = None
    try:
        yield
    except (DataError, Rejected) as error:  # of a file that is half there, perhaps
        fault = error
    try:
        found = changed()
    except DataError as error:
        raise Rejected(str(error), retry=True) from error
    if found:
        raise Rejected(
            f"{found} changed while it was read, so it is still being written; run the same command "
            "again when it is complete",
            retry=True,
        ) from fault
    if fault is not None:
        raise fault


def _frame(demo: Demonstration, t: int) -> Frame:
    try:
        return demo.frame(t)
    except DataError as error:
        raise Rejected(f"step {t}: {error}") from error


class QueriesStage(Stage, QuerySettings):
    """Query points are chosen on the first cloud."""

    stage: str = "queries"

    def process(self, record: ObservedDemo) -> QueriedDemo:
        """Choose the points to follow."""
        try:
            return QueriedDemo(record, queries_in(record.first_cloud, record.depth[0], self))
        except DataError as error:
            raise Rejected(str(error)) from error

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """How the query points were chosen."""
        return provenance.model_copy(update={"queries": _settings(self, QuerySettings)})


def _settings(stage: Stage, group: type[Settings]) -> dict[str, Any]:
    """Those settings of a stage that are of a group, as JSON values: neither its name nor what a subclass adds."""
    return stage.model_dump(mode="json", include=set(group.model_fields))
