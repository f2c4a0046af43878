"""What a dataset looks like in a table or in JSON."""

from pathlib import Path
from typing import Any

import click

from flowlab.cli.console import print_table
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import StageTally


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


def extraction_report(dataset: Dataset, seconds: float) -> dict[str, Any]:
    """The result of an extraction as JSON values."""
    return {
        "dataset": str(dataset.path),
        "fingerprint": dataset.fingerprint,
        "episodes": len(dataset),
        "frames": sum(ref.frames for ref in dataset.refs),
        "missing": dataset.missing,
        "wall_s": round(seconds, 2),
        "peak_worker_memory_mb": round(max((r.peak_memory_mb for r in dataset.receipts), default=0.0)),
        "tasks": task_rows(dataset),
        "stages": stage_rows(dataset),
        "rejects": [x.model_dump() for r in dataset.receipts for x in r.rejects],
    }


def print_extraction(report: dict[str, Any]) -> None:
    """The result of an extraction as tables, and what to do next."""
    print_table(["task", "episodes", "asked for", "frames", "rejected"], [list(t.values()) for t in report["tasks"]])
    print_table(["stage", "calls", "CPU s", "ms/frame", "rejects"], [list(s.values()) for s in report["stages"]])
    for reject in report["rejects"][:10]:
        click.echo(f"rejected {reject['task']} seed {reject['seed']} at {reject['stage']}: {reject['reason']}")
    if len(report["rejects"]) > 10:
        click.echo(f"... and {len(report['rejects']) - 10} more, all in {report['dataset']}/rejects.jsonl")
    click.echo(
        f"{report['episodes']} episodes, {report['frames']} frames in {report['dataset']} "
        f"({report['wall_s']:.1f} s). Next: flowlab validate {report['dataset']}"
    )
