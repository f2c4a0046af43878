"""What a run says of itself: ``metrics.jsonl``, and other places that are asked for."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowlab.files import write_atomically
from flowlab.json_lines import append_line, line_of
from flowlab.policies.trained import resume_advice
from flowlab.training.loggers import MetricsLogger
from flowlab.viz.training_metrics import METRICS, metrics_lines


class MetricsFile:
    """Appends a JSON object a line; a resumed run forgets what comes after the step it resumes from."""

    def __init__(self, folder: Path, step: int, logs: Sequence[MetricsLogger] = ()) -> None:
        self.path = folder / METRICS
        self._logs = logs
        before = [line for line in metrics_lines(self.path) if line.step <= step] if step else []
        self.lines = len(before)
        write_atomically(self.path, b"".join(line_of(_values(x.kind, x.step, x.values)) for x in before))
        spent = before[-1].values if before else {}
        self._began = time.process_time() - spent.get("cpu_s", 0.0), time.monotonic() - spent.get("wall_s", 0.0)

    def write(self, kind: str, step: int, values: Mapping[str, float]) -> None:
        """Add a line of a kind (``train`` or ``validation``), with the CPU and clock time spent so far [s]."""
        spent = {"cpu_s": time.process_time() - self._began[0], "wall_s": time.monotonic() - self._began[1]}
        append_line(self.path, _values(kind, step, {**values, **spent}), resume_advice(self.path.parent))
        for log in self._logs:
            log.write(step, {f"{kind}/{name}": value for name, value in values.items()})

    def close(self) -> None:
        """Close the other places."""
        for log in self._logs:
            log.close()


class RunningMeans:
    """Running means of named numbers."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._count = 0

    def add(self, values: Mapping[str, float]) -> None:
        """Take in one of each."""
        self._count += 1
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value

    def state(self) -> dict[str, float]:
        """What :meth:`load_state` goes on from; empty where nothing was added."""
        return {"count": float(self._count), **self._sums} if self._count else {}

    def load_state(self, state: Mapping[str, float]) -> None:
        """Go on from what :meth:`state` gave."""
        self._sums = {name: value for name, value in state.items() if name != "count"}
        self._count = int(state.get("count", 0))

    def pop_means(self) -> dict[str, float]:
        """The means since the last call."""
        means = {name: self._sums[name] / max(self._count, 1) for name in sorted(self._sums)}  # a file knows no order
        self._sums, self._count = {}, 0
        return means


def last_metrics(path: Path, kind: str) -> dict[str, float]:
    """The newest line of a kind, without kind, step and time; empty where there is none."""
    lines = [line.values for line in metrics_lines(path) if line.kind == kind]
    return {k: v for k, v in lines[-1].items() if k not in ("cpu_s", "wall_s")} if lines else {}


def cpu_seconds_spent(path: Path) -> float:
    """CPU time up to the newest line [s]."""
    lines = metrics_lines(path)
    return lines[-1].values.get("cpu_s", 0.0) if lines else 0.0


def _values(kind: str, step: int, values: Mapping[str, float]) -> dict[str, Any]:
    return {"kind": kind, "step": step, **values}
