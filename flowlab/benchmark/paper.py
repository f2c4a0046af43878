"""The numbers of "3D Flow Diffusion Policy" in simulation, as it reports them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PaperRow:
    """A row of a table: one policy."""

    name: str
    label: str
    """What the policy is called in our results."""
    percent: Mapping[str, float]
    """Mean success [%] by task, or by difficulty; empty for policies that only we have."""


@dataclass(frozen=True, slots=True)
class PaperTable:
    """A table of the paper."""

    title: str
    source: str
    episodes: int
    """Of each task."""
    columns: tuple[str, ...]
    """Tasks and difficulties."""
    rows: tuple[PaperRow, ...]


def _row(name: str, label: str, columns: Sequence[str], *percent: float) -> PaperRow:
    """A policy's row, of its numbers in the order of the columns; without numbers, it is ours alone."""
    return PaperRow(name, label, dict(zip(columns, percent, strict=True)) if percent else {})


_GROUPS = ("easy", "medium", "hard", "very-hard")
_HARD = ("assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push-back", "push", "hard")
_FIVE = ("basketball", "box-close", "hammer", "handle-press", "handle-pull")

MBA = "mba"
"""What its row of Motion Before Action is called in our results."""
MAIN = PaperTable(
    "Success by difficulty",
    "Table I, MetaWorld Results",
    600,
    _GROUPS,
    (
        _row("DP3", "dp3", _GROUPS, 85.8, 51.1, 52.4, 46.5),
        _row("MBA*", MBA, _GROUPS, 84.2, 49.7, 53.0, 46.9),
        _row("3D FDP", "fdp", _GROUPS, 86.5, 55.3, 55.6, 47.9),
        _row("3D FDP, flow as an additional loss only", "fdp-auxiliary", _GROUPS),
    ),
)
QUERY_POINTS = PaperTable(
    "Number of query points",
    "Table II, Effect of Query Points",
    60,
    _HARD,
    (
        _row("50", "fdp-m50", _HARD, 83.3, 3.3, 26.7, 46.7, 96.7, 56.7, 52.2),
        _row("100", "fdp", _HARD, 93.3, 5.0, 31.7, 58.3, 98.3, 61.7, 58.1),
        _row("200", "fdp-m200", _HARD, 88.3, 8.3, 43.3, 60.0, 98.3, 66.7, 60.8),
    ),
)
QUERY_PLACES = PaperTable(
    "Where query points are",
    "Table III, Ablation on Query Point Sampling Strategy",
    60,
    _FIVE,
    (
        _row("object", "fdp-object", _FIVE, 93.3, 51.7, 48.3, 86.7, 38.3),
        _row("scene", "fdp", _FIVE, 98.3, 53.3, 68.3, 93.3, 41.7),
        _row("stratified", "fdp-stratified", _FIVE),
    ),
)
TABLES = (MAIN, QUERY_POINTS, QUERY_PLACES)
CURVE_TASKS = ("basketball", "coffee-pull", "faucet-close", "push")
"""Of its figure on learning efficiency, which compares 3D FDP with DP3 and of which it states no numbers."""
DEMONSTRATIONS, EPOCHS = 10, 1000


def paper_share(label: str, over: str) -> float | None:
    """What the paper reports of a policy on a task or a difficulty, from 0 to 1; of two numbers the one of more
    episodes."""
    for table in TABLES:
        for row in table.rows:
            if row.label == label and over in row.percent:
                return round(row.percent[over] / 100, 3)
    return None
