"""What a dataset looks like in a table or in JSON."""

from pathlib import Path
from typing import Any

import click

from flowlab.cli.console import print_table
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import StageTally
from flowlab.storage.shard import Shard

_SHOWN = 10
"""So many bad frames and rejects are printed; the rest is in files."""


def folder_size(path: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file())


def task_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """Episodes, frames and rejected seeds of every task."""
    rows = []
    for task, wanted in dataset.manifest.requested.items():
        mine = [r for r in dataset.receipts if r.task == task]
        rows.append(
            {
                "task": task,
                "episodes": sum(len(r.accepted) for r in mine),
                "requested": wanted,
                "frames": sum(sum(r.frames) for r in mine),
                "rejected": sum(len(r.rejects) for r in mine),
            }
        )
    return rows


def stage_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """Calls, CPU time and rejects of every stage, over all runs."""
    total: dict[str, StageTally] = {}
    for receipt in dataset.receipts:
        for name, tally in receipt.stages.items():
            total[name] = total.get(name, StageTally()).plus(tally)
    frames = max(sum(sum(r.frames) for r in dataset.receipts), 1)
    order = [name for name in dataset.manifest.settings if name in total]
    return [
        {
            "stage": name,
            "calls": total[name].calls,
            "cpu_s": round(total[name].cpu_s, 3),
            "cpu_ms_per_frame": round(total[name].cpu_s / frames * 1e3, 3),
            "rejects": total[name].rejects,
        }
        for name in order
    ]


def bad_frames(dataset: Dataset) -> list[dict[str, Any]]:
    """The frames of recordings that were left out as bad, by name and reason."""
    if not dataset.manifest.recordings:
        return []
    source = {(r.task, r.seed): r.source for r in dataset.manifest.recordings}
    return [
        {"recording": source.get((ref.task, ref.seed), ""), "frame": name, "reason": reason}
        for ref in dataset.refs
        for name, reason in Shard(dataset.path / ref.shard).about(ref.position).get("bad_frames", ())
    ]


def extraction_report(dataset: Dataset, seconds: float) -> dict[str, Any]:
    """The result of an extraction as JSON values."""
    report = {
        "dataset": str(dataset.path),
        "fingerprint": dataset.fingerprint,
        "episodes": len(dataset),
        "frames": sum(ref.frames for ref in dataset.refs),
        "missing": dataset.missing,
        "wall_s": round(seconds, 2),
        "peak_worker_memory_mb": round(max((r.peak_memory_mb for r in dataset.receipts), default=0.0)),
        "tasks": task_rows(dataset),
        "stages": stage_rows(dataset),
        "rejects": [x.model_dump(exclude_defaults=True) for r in dataset.receipts for x in r.rejects],
    }
    if dataset.manifest.recordings:
        report |= {"quality": dataset.stats.get("quality"), "bad_frames": bad_frames(dataset)}
    return report


def print_quality(about: dict[str, Any]) -> None:
    """How good estimated tracks are, by what they state themselves; nothing for exact ones."""
    if not about.get("quality"):
        return
    quality, seen = about["quality"], about["quality"]["visible_sigma_m"]
    shares = ", ".join(f"{share:.0%} {source}" for source, share in quality["source_share"].items())
    click.echo(
        f"stated error of visible points: median {seen['p50'] * 1e3:.2g} mm, 90 % below {seen['p90'] * 1e3:.2g} mm; "
        f"{quality['visible_share']:.0%} of all positions visible; {shares}"
    )


def print_extraction(report: dict[str, Any]) -> None:
    """The result of an extraction as tables, and what to do next."""
    print_table(["task", "episodes", "asked for", "frames", "rejected"], [list(t.values()) for t in report["tasks"]])
    print_table(["stage", "calls", "CPU s", "ms/frame", "rejects"], [list(s.values()) for s in report["stages"]])
    print_quality(report)
    for bad in report.get("bad_frames", ())[:_SHOWN]:
        click.echo(f"left out of {bad['recording']}: {bad['frame']} {bad['reason']}")
    if len(report.get("bad_frames", ())) > _SHOWN:
        click.echo(f"... and {len(report['bad_frames']) - _SHOWN} bad frames more; --json lists all")
    for reject in report["rejects"][:_SHOWN]:
        who = reject.get("source") or f"{reject['task']} seed {reject['seed']}"
        click.echo(f"rejected {who} at {reject['stage']}: {reject['reason']}")
    if len(report["rejects"]) > _SHOWN:
        click.echo(f"... and {len(report['rejects']) - _SHOWN} more, all in {report['dataset']}/rejects.jsonl")
    click.echo(
        f"{report['episodes']} episodes, {report['frames']} frames in {report['dataset']} "
        f"({report['wall_s']:.1f} s). Next: flowlab validate {report['dataset']}"
    )
