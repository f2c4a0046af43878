"""What a training run's ``metrics.jsonl`` tells, line by line."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from flowlab.errors import DataError

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
    try:
        *whole, _ = path.read_bytes().split(b"\n")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); a training run writes it") from error
    lines = [_parse(path, number, text) for number, text in enumerate(whole, 1)]
    if not lines:
        raise DataError(f"{path}: holds no whole line yet; a training run adds the first after some steps")
    return lines


def _parse(path: Path, number: int, text: bytes) -> MetricsLine:
    """One line. Raises :class:`DataError` where it is damaged."""
    try:
        values = json.loads(text)
        kind, step = str(values.pop("kind")), int(values.pop("step"))
        return MetricsLine(kind, step, {name: float(value) for name, value in values.items()})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"{path}: line {number} is damaged (expected a JSON object of numbers with kind and step, found "
            f"{text[:60].decode(errors='replace')!r}); delete the line"
        ) from error


def lines_of_kind(lines: Sequence[MetricsLine], kind: str) -> list[MetricsLine]:
    """The lines of training, or of validation."""
    return [line for line in lines if line.kind == kind]


def series(lines: Sequence[MetricsLine], name: str) -> Series:
    """Steps and values of the lines that tell the value."""
    pairs = [(line.step, line.values[name]) for line in lines if name in line.values]
    steps, values = np.array(pairs, float).reshape(-1, 2).T
    return steps, values
