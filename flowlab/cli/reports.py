"""What a dataset looks like in a table or in JSON."""

from dataclasses import asdict
from typing import Any

from flowlab.cli.console import echo, print_json, print_table, warn
from flowlab.errors import DataError
from flowlab.pipeline.kept_checks import CheckTotals
from flowlab.pipeline.units import JobShard
from flowlab.storage.dataset import Dataset
from flowlab.storage.overview import frame_count, left_out_frames, stage_totals, task_totals
from flowlab.text import counted, cut

_SHOWN = 10
"""So many bad frames and rejects are printed; the rest is in files."""


def extraction_report(dataset: Dataset, seconds: float) -> dict[str, Any]:
    """The result of an extraction as JSON values."""
    report = {
        "dataset": str(dataset.path),
        "fingerprint": dataset.fingerprint,
        "episodes": len(dataset),
        "frames": frame_count(dataset),
        "missing": dataset.missing,
        "wall_s": round(seconds, 2),
        "peak_worker_memory_mb": round(max((r.peak_memory_mb for r in dataset.receipts), default=0.0)),
        "tasks": [asdict(t) for t in task_totals(dataset)],
        "stages": [asdict(s) for s in stage_totals(dataset)],
        "rejects": [x.model_dump(exclude_defaults=True) for r in dataset.receipts for x in r.rejects],
    }
    if dataset.manifest.recordings:
        left_out = [asdict(frame) for frame in left_out_frames(dataset)]
        report |= {"quality": dataset.stats.get("quality"), "bad_frames": left_out}
    return report


def finish_extraction(dataset: Dataset, seconds: float, share: JobShard, as_json: bool) -> None:
    """Print what a command that fills a dataset has come to. Raises :class:`DataError` where no episode came of it."""
    report = extraction_report(dataset, seconds)
    if as_json:
        print_json(report)
    else:
        print_extraction(report)
    if dataset.missing and share.count > 1:
        warn("the rest belongs to the other shards")
    elif not len(dataset):
        raise DataError(
            f"{dataset.path}: holds no episode, for all {len(dataset.rejects)} that were tried are rejected; mend what "
            "the reasons name, or change the settings, and run it again"
        )


def print_quality(about: dict[str, Any]) -> None:
    """How good estimated tracks are, by what they state themselves; nothing for exact ones."""
    if not about.get("quality"):
        return
    quality, seen = about["quality"], about["quality"]["visible_sigma_m"]
    shares = ", ".join(f"{share:.0%} {source}" for source, share in quality["source_share"].items())
    echo(
        f"stated error of visible points: median {seen['p50'] * 1e3:.2g} mm, 90 % below {seen['p90'] * 1e3:.2g} mm; "
        f"{quality['visible_share']:.0%} of all positions visible; {shares}"
    )


def facts_of_checks(totals: CheckTotals) -> dict[str, Any]:
    """What was found when recordings were checked, as JSON values; of single checks, the doubtful ones."""
    doubtful = [
        {"task": e.task, "seed": e.seed, "recording": e.recording, "checks": [c.to_json() for c in e.doubtful]}
        for e in totals.doubtful
    ]
    return {"verdicts": totals.verdicts, "episodes_not_checked": totals.not_checked, "doubtful": doubtful}


def print_checks(totals: CheckTotals) -> None:
    """What was found when recordings were checked: how many of each verdict, and the doubts."""
    counts = ", ".join(f"{n} {verdict}" for verdict, n in totals.verdicts.items() if n)
    missing = f"{counted(totals.not_checked, 'episode')} not checked" if totals.not_checked else ""
    echo(f"checks of recordings: {'; '.join(filter(None, (counts, missing)))}")
    doubts = [(episode, check) for episode in totals.doubtful for check in episode.doubtful]
    for episode, check in doubts[:_SHOWN]:
        echo(f"  {check.verdict}: {episode}: {check.about}: {cut(check.says, 160)}")
    if len(doubts) > _SHOWN:
        echo(f"  ... and {len(doubts) - _SHOWN} more; --json has all")


def print_extraction(report: dict[str, Any]) -> None:
    """The result of an extraction as tables, and what to do next."""
    print_table(["task", "episodes", "asked for", "frames", "rejected"], [list(t.values()) for t in report["tasks"]])
    print_table(["stage", "calls", "CPU s", "ms/frame", "rejects"], [list(s.values()) for s in report["stages"]])
    print_quality(report)
    for bad in report.get("bad_frames", ())[:_SHOWN]:
        echo(f"left out of {bad['recording']}: {bad['frame']} {bad['reason']}")
    if len(report.get("bad_frames", ())) > _SHOWN:
        echo(f"... and {counted(len(report['bad_frames']) - _SHOWN, 'bad frame')} more; --json lists all")
    for reject in report["rejects"][:_SHOWN]:
        who = reject.get("source") or f"{reject['task']} seed {reject['seed']}"
        echo(f"rejected {who} at {reject['stage']}: {reject['reason']}")
    if len(report["rejects"]) > _SHOWN:
        echo(f"... and {len(report['rejects']) - _SHOWN} more, all in {report['dataset']}/rejects.jsonl")
    next_step = f" Next: flowlab validate {report['dataset']}" if report["episodes"] else ""
    echo(
        f"{counted(report['episodes'], 'episode')}, {counted(report['frames'], 'frame')} in {report['dataset']} "
        f"({report['wall_s']:.1f} s).{next_step}"
    )
