"""What evaluations look like in a table."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from flowlab.cli.console import print_table

if TYPE_CHECKING:
    from flowlab.benchmark.results import PolicyResult
    from flowlab.benchmark.statistics import Proportion


def print_results(results: Sequence["PolicyResult"]) -> None:
    """Success by policy and task, policies against each other, and how well motion was foreseen."""
    from flowlab.benchmark.summary import ALL, summarize

    summary = summarize(results)
    rows = [
        [s.task, s.label, *_share(s.success), _percent(s.success_dp3), s.mean_steps or "-"] for s in summary.successes
    ]
    if len(summary.tasks) > 1:
        rows += [
            [
                f"{g.group} ({len(g.tasks)} of {g.of})",
                g.label,
                *_share(g.success),
                _percent(g.success_dp3),
                g.mean_steps or "-",
            ]
            for g in summary.groups
        ]
    columns = ["task", "policy", "solved", "of", "%", "95 % interval", "DP3's reading %", "steps"]
    print_table(columns, rows, "solved at any step; DP3's runner misses what does not last")
    pairs = [
        [
            f"{c.first}, {c.second}",
            c.paired.n,
            c.paired.both,
            c.paired.first_only,
            c.paired.second_only,
            c.paired.neither,
            c.paired.p_value,
        ]
        for c in summary.comparisons
        if c.over == ALL
    ]
    if pairs:
        columns = ["policies", "episodes", "both", "first only", "second only", "neither", "p"]
        print_table(columns, pairs, "on the same episodes; p: McNemar, exact, two-sided")
    flow = [
        [f.label, e.ade_mm, e.zero_ade_mm, e.fde_mm, e.zero_fde_mm, e.apd, e.average_jaccard]
        for f in summary.flow
        if f.over == ALL and (e := f.error)
    ]
    if flow:
        columns = ["policy", "ADE mm", "(no motion)", "FDE mm", "(no motion)", "APD", "3D-AJ"]
        print_table(columns, flow, "predicted against true flow of moving points, while a plan is executed")


def _share(share: "Proportion") -> list[object]:
    interval = f"{100 * share.low:.0f} - {100 * share.high:.0f}"
    return [share.successes, share.n, _percent(share), interval]


def _percent(share: "Proportion") -> float:
    return round(100 * share.share, 1)
