"""What a training run's ``metrics.jsonl`` tells, line by line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from flowlab.errors import DataError
from flowlab.json_lines import read_lines
from flowlab.text import shown

METRICS = "metrics.jsonl"
_EXPECTED, _ADVICE = "a JSON object of numbers with kind and step", "delete the line"
Series = tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]
"""Steps, and the value at each."""


@dataclass(frozen=True, slots=True)
class MetricsLine:
    """A line of ``metrics.jsonl``."""

    kind: str
    step: int
    values: Mapping[str, float]


def read_metrics(path: Path) -> list[MetricsLine]:
    """The lines of a run's metrics, at least one. A last line that a kill cut off is left out."""
    if not path.exists():
        raise DataError(f"{path}: there is no such file; a training run writes it")
    lines = metrics_lines(path)
    if not lines:
        raise DataError(f"{path}: holds no whole line yet; a training run adds the first after some steps")
    return lines


def metrics_lines(path: Path) -> list[MetricsLine]:
    """The lines of a run's metrics; none where there is no file. Raises :class:`DataError` where one is damaged."""
    return [_parse(path, number, values) for number, values in read_lines(path, _EXPECTED, _ADVICE)]


def _parse(path: Path, number: int, values: Any) -> MetricsLine:
    """One line. Raises :class:`DataError` where it is damaged."""
    try:
        plain = dict(values)
        kind, step = str(plain.pop("kind")), int(plain.pop("step"))
        return MetricsLine(kind, step, {name: float(value) for name, value in plain.items()})
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise DataError(
            f"{path}: line {number} is damaged (expected {_EXPECTED}, found {shown(values)}); {_ADVICE}"
        ) from error


def lines_of_kind(lines: Sequence[MetricsLine], kind: str) -> list[MetricsLine]:
    """The lines of training, or of validation."""
    return [line for line in lines if line.kind == kind]


def series(lines: Sequence[MetricsLine], name: str) -> Series:
    """Steps and values of the lines that tell the value."""
    pairs = [(line.step, line.values[name]) for line in lines if name in line.values]
    steps, values = np.array(pairs, float).reshape(-1, 2).T
    return steps, values
