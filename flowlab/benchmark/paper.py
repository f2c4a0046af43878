"""The numbers of "3D Flow Diffusion Policy" in simulation, and ours beside them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowlab.benchmark.summary import GroupSuccess, Summary, TaskSuccess
from flowlab.config import Settings
from flowlab.evaluation.trials import SCENES_PER_SEED


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
    return PaperRow(name, label, dict(zip(columns, percent, strict=True)) if percent else {})


_GROUPS = ("easy", "medium", "hard", "very-hard")
_HARD = ("assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push-back", "push", "hard")
_FIVE = ("basketball", "box-close", "hammer", "handle-press", "handle-pull")

MAIN = PaperTable(
    "Success by difficulty",
    "Table I, MetaWorld Results",
    600,
    _GROUPS,
    (
        _row("DP3", "dp3", _GROUPS, 85.8, 51.1, 52.4, 46.5),
        _row("MBA*", "mba", _GROUPS, 84.2, 49.7, 53.0, 46.9),
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


class PaperCell(Settings):
    """The paper's number and ours, from 0 to 1; None where there is none."""

    paper: float | None
    ours: float | None
    """Of a difficulty, the mean of its tasks, as in the paper."""
    low: float | None = None
    """95 % interval of the share of all our episodes."""
    high: float | None = None
    n: int = 0
    """Our episodes."""
    tasks: int = 0
    of: int = 0
    """Of a difficulty: on how many of its tasks ours rests, and how many it has."""


class ComparedRow(Settings):
    """A policy's."""

    name: str
    label: str
    cells: tuple[PaperCell, ...]


class ComparedTable(Settings):
    """A table of the paper with ours in every cell."""

    title: str
    source: str
    episodes: int
    """Of each task, in the paper."""
    columns: tuple[str, ...]
    rows: tuple[ComparedRow, ...]


def compare_with_paper(summary: Summary) -> list[ComparedTable]:
    """The paper's tables in which we have a number, with ours; rows of policies that neither has are left out."""
    tables = []
    for table in TABLES:
        rows = [
            ComparedRow(name=r.name, label=r.label, cells=tuple(_cell(summary, r, c) for c in table.columns))
            for r in table.rows
        ]
        shown = [r for r in rows if any(c.ours is not None or c.paper is not None for c in r.cells)]
        if any(c.ours is not None for r in rows for c in r.cells):
            tables.append(
                ComparedTable(
                    title=table.title,
                    source=table.source,
                    episodes=table.episodes,
                    columns=table.columns,
                    rows=tuple(shown),
                )
            )
    return tables


def paper_share(label: str, over: str) -> float | None:
    """What the paper reports of a policy on a task or a difficulty, from 0 to 1; of two numbers the one of more
    episodes."""
    for table in TABLES:
        for row in table.rows:
            if row.label == label and over in row.percent:
                return round(row.percent[over] / 100, 3)
    return None


def _cell(summary: Summary, row: PaperRow, over: str) -> PaperCell:
    paper = round(row.percent[over] / 100, 3) if over in row.percent else None
    ours = find_success(summary, row.label, over)
    if ours is None:
        return PaperCell(paper=paper, ours=None)
    s = ours.success
    if isinstance(ours, TaskSuccess):
        return PaperCell(paper=paper, ours=s.share, low=s.low, high=s.high, n=s.n)
    return PaperCell(
        paper=paper, ours=ours.task_mean, low=s.low, high=s.high, n=s.n, tasks=len(ours.tasks), of=ours.of
    )  # fmt: skip


def find_success(summary: Summary, label: str, over: str) -> TaskSuccess | GroupSuccess | None:
    """Our result of a policy on a task, on a difficulty, or on ``all``."""
    on_groups = (g for g in summary.groups if (g.label, g.group) == (label, over))
    return next((s for s in summary.successes if (s.label, s.task) == (label, over)), None) or next(on_groups, None)


def differences(summary: Summary) -> list[str]:
    """Sentences on what differs between the paper's experiments and these, from how these policies were trained."""
    return [
        "The tasks are those of MetaWorld v3, in MuJoCo 3; DP3's code, on which the paper builds, has a copy of v2 of "
        "its own: in an older MuJoCo, without the retaining wall behind the table, with another gain of the expert of "
        "push-back and goals on a grid in reach.",
        _budget(summary),
        _demonstrations(summary),
        *_network(summary),
        _episodes(summary),
        "An episode counts as solved if the task is after any step. DP3's runner looks only at the last two steps of "
        "each plan that it executes; the share that it would find stands beside ours.",
        *_policies(summary),
        "The paper, like these results, has one training run of each policy and task; the intervals are about the "
        "episodes of that run, not about other runs.",
    ]


def _budget(summary: Summary) -> str:
    trained = [f.training for f in summary.training]
    minutes = _span([t.cpu_s / 60 for t in trained], ".1f")
    steps = _span([t.steps for t in trained], ",d")
    where = " and ".join(sorted({f"{t.processor} ({t.device}, {t.precision})" for t in trained}))
    return (
        f"Ours were trained for {minutes} CPU minutes, {steps} steps, on {where}; the paper's for {EPOCHS} epochs, "
        "about 6 hours on an NVIDIA RTX 3090."
    )


def _demonstrations(summary: Summary) -> str:
    counts = [f.training.demonstrations / max(len(f.tasks), 1) for f in summary.training]
    if set(counts) == {DEMONSTRATIONS}:
        return f"Both learned from {DEMONSTRATIONS} demonstrations of each task, by scripted experts."
    return f"Ours learned from {_span(counts, 'g')} demonstrations of each task; the paper's from {DEMONSTRATIONS}."


def _episodes(summary: Summary) -> str:
    counts = [s.success.n for s in summary.successes]
    if not counts:
        return "No episodes were tried."
    seeds = ", ".join(map(str, summary.seeds))
    return (
        f"Ours are shares of {_span(counts, 'd')} episodes of each task, of the evaluation seeds {seeds}: layouts "
        f"from {SCENES_PER_SEED:,} on, none of which was demonstrated, the same for every policy. The paper's are "
        f"means of {MAIN.episodes} episodes of each task by difficulty, and of {QUERY_POINTS.episodes} elsewhere; "
        "hence its two numbers for 100 query points on the hard tasks."
    )


def _network(summary: Summary) -> Iterable[str]:
    """What of the networks and their training is not the paper's."""
    trained = [f.training for f in summary.training]
    flow = [t for t in trained if t.policy == "fdp"]
    if any(_setting(t.settings, "motion.flow_representation") == "per-query" for t in flow):
        yield (
            "Our flow network is one for all query points, which tell each other their mean and maximum; the paper's "
            "is a temporal U-Net, whose channels we take to be the coordinates of all points."
        )
    if any(_setting(t.settings, "action.kind") == "mlp" for t in trained):
        yield "Our actions come from residual layers over the whole horizon; the paper's from a temporal U-Net."
    if any(_setting(t.settings, "motion.condition") == "one-step" for t in flow):
        yield (
            "Our flow is predicted from pure noise in one step and so conditions the action, in training and in use; "
            "the paper denoises it in 10 steps."
        )
    moved = [t for t in trained if _setting(t.settings, "batch.shift_m") or _setting(t.settings, "batch.turn_deg")]
    if moved:
        yield "Our training shifts and turns scenes at random; the paper mentions no augmentation."
    n_action_steps = sorted({_setting(t.settings, "n_action_steps") for t in trained})
    yield (
        f"Ours execute {' or '.join(map(str, n_action_steps))} steps of a plan before the next; the paper speaks of 8 steps "
        "and of the first action, which can be read in two ways."
    )


def _policies(summary: Summary) -> Iterable[str]:
    policies = {f.training.policy for f in summary.training}
    labels = set(summary.labels)
    if "mba" in policies:
        yield "Our MBA is, like the paper's, 3D FDP with a head that predicts the object's pose in place of the flow."
    if only := [r.label for t in TABLES for r in t.rows if not r.percent and r.label in labels]:
        yield f"The paper has nothing to compare with: {', '.join(only)}."


def _setting(settings: Mapping[str, Any], path: str) -> Any:
    """A training setting by its path, None where there is no such setting."""
    value: Any = settings
    for part in path.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _span(values: Sequence[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"
