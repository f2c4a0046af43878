"""How well policies predict the flow of points, over tasks and groups of them."""

from collections.abc import Iterator, Mapping, Sequence

from flowlab.benchmark.statistics import DIGITS
from flowlab.benchmark.success import Tried, on_tasks
from flowlab.config import Settings
from flowlab.evaluation.results import RolloutFlowError


class FlowAccuracy(Settings):
    """Predicted flow of one policy."""

    label: str
    over: str
    """A task, a difficulty, or ``all``."""
    episodes: int
    """In which something moved."""
    error: RolloutFlowError
    """Over all of their moving points, and all that are still."""


def flow_accuracies(tried: Mapping[str, Tried], scopes: Mapping[str, Sequence[str]]) -> Iterator[FlowAccuracy]:
    """Every policy that predicts flow, over every scope in which something moved."""
    for over, tasks in scopes.items():
        for label, of_label in tried.items():
            errors = [o.flow for o in on_tasks(of_label, tasks) if o.flow is not None]
            if errors:
                yield FlowAccuracy(label=label, over=over, episodes=len(errors), error=pool_flow_errors(errors))


def pool_flow_errors(errors: Sequence[RolloutFlowError]) -> RolloutFlowError:
    """The error over the points of several episodes, each point and step as heavy as any other."""

    def mean(name: str, weight: str) -> float:
        total = sum(getattr(e, weight) for e in errors)
        return round(sum(getattr(e, name) * getattr(e, weight) for e in errors) / total, DIGITS) if total else 0.0

    of_pairs = ("ade_mm", "zero_ade_mm", "apd", "zero_apd", "average_jaccard", "zero_average_jaccard")
    return RolloutFlowError(
        pairs=sum(e.pairs for e in errors),
        ends=sum(e.ends for e in errors),
        still_pairs=sum(e.still_pairs for e in errors),
        **{name: mean(name, "pairs") for name in of_pairs},
        **{name: mean(name, "ends") for name in ("fde_mm", "zero_fde_mm")},
        still_mm=mean("still_mm", "still_pairs"),
    )
