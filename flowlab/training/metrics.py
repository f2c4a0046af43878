"""What a run says of itself: ``metrics.jsonl``, and other places that are asked for."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from flowlab.files import write_atomically
from flowlab.training.loggers import MetricsLogger

METRICS = "metrics.jsonl"


class MetricsFile:
    """Appends a JSON object a line; a resumed run forgets what comes after the step it resumes from."""

    def __init__(self, folder: Path, step: int, logs: Sequence[MetricsLogger] = ()) -> None:
        self.path = folder / METRICS
        self._logs = logs
        before = [line for line in _whole_lines(self.path) if json.loads(line)["step"] <= step] if step else []
        write_atomically(self.path, "".join(line + "\n" for line in before))
        spent = json.loads(before[-1]) if before else {"cpu_s": 0.0, "wall_s": 0.0}
        self._began = time.process_time() - spent["cpu_s"], time.monotonic() - spent["wall_s"]

    def write(self, kind: str, step: int, values: Mapping[str, float]) -> None:
        """Add a line of a kind (``train`` or ``validation``), with the CPU and clock time spent so far [s]."""
        spent = {"cpu_s": time.process_time() - self._began[0], "wall_s": time.monotonic() - self._began[1]}
        with self.path.open("a") as file:
            file.write(json.dumps({"kind": kind, "step": step, **values, **spent}) + "\n")
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
        means = {name: total / max(self._count, 1) for name, total in self._sums.items()}
        self._sums, self._count = {}, 0
        return means


def last_metrics(path: Path, kind: str) -> dict[str, float]:
    """The newest line of a kind, without kind, step and time; empty where there is none."""
    lines = [values for line in _whole_lines(path) if (values := json.loads(line))["kind"] == kind]
    return {k: v for k, v in lines[-1].items() if k not in ("kind", "step", "cpu_s", "wall_s")} if lines else {}


def cpu_seconds_spent(path: Path) -> float:
    """CPU time up to the newest line [s]."""
    lines = _whole_lines(path)
    return float(json.loads(lines[-1])["cpu_s"]) if lines else 0.0


def _whole_lines(path: Path) -> list[str]:
    """Lines of the file; the last is left out where a kill cut it off."""
    lines = path.read_text().split("\n") if path.exists() else []
    return lines[:-1]
