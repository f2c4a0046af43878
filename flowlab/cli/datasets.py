"""``flowlab info``, ``flowlab validate`` and ``flowlab export``."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from flowlab.cli.console import echo, json_option, print_json, print_table, quiet_option, warn
from flowlab.cli.paths import PATH
from flowlab.cli.values import PluginName
from flowlab.errors import DataError, FlowlabError
from flowlab.registry import EXPORTERS
from flowlab.text import counted

if TYPE_CHECKING:
    from flowlab.storage.validation import Finding

_LISTED = 20
"""So many episodes are listed, unless all are asked for."""


@click.command()
@click.argument("dataset", type=PATH)
@click.option("--all", "every", is_flag=True, help="List all episodes, not the first ones.")
@json_option
def info(dataset: Path, every: bool, as_json: bool) -> None:
    """Say what a dataset holds and how it was made; of a training run, what its policy is and learned from."""
    if (dataset / "policy.json").is_file():
        from flowlab.cli.run_info import print_run

        print_run(dataset, as_json)
        return
    from flowlab.cli.label_actions import print_inferred
    from flowlab.cli.reports import facts_of_checks, print_checks, print_quality
    from flowlab.pipeline.kept_checks import total_checks
    from flowlab.storage.dataset import open_dataset
    from flowlab.storage.overview import dataset_overview, list_episodes

    data = open_dataset(dataset)
    overview = dataset_overview(data)
    episodes = [asdict(e) for e in list_episodes(data)]
    tasks, stages = [asdict(t) for t in overview.tasks], [asdict(s) for s in overview.stages]
    arrays = [
        {"array": a.path, "dimensions": ", ".join(a.dims), "shape": " x ".join(map(str, a.shape)), "type": a.dtype,
         "unit": a.unit}
        for a in overview.arrays
    ]  # fmt: skip
    about = {
        "dataset": str(dataset),
        "recipe": data.manifest.recipe,
        "flowlab": data.manifest.flowlab,
        "fingerprint": data.fingerprint,
        "episodes": overview.episodes,
        "frames": overview.frames,
        "megabytes": overview.megabytes,
        "missing": data.missing,
        "world_frame": data.provenance.world_frame,
    }
    checks = total_checks(data)
    if as_json:
        manifest = data.manifest.model_dump(mode="json")
        recordings = {"recordings": manifest["recordings"]} if manifest["recordings"] else {}
        recordings |= {} if checks is None else {"checks": facts_of_checks(checks)}
        more = {"tasks": tasks, "listed": episodes, "arrays": arrays, "stages": stages, "stats": data.stats}
        print_json(
            {**about, **more, "settings": manifest["settings"], "provenance": data.provenance.model_dump(mode="json")}
            | recordings
        )
        return
    for name, value in about.items():
        echo(f"{name.replace('_', ' '):<12} {value if value != {} else 'none'}")
    print_table(["task", "episodes", "asked for", "frames", "rejected"], [list(t.values()) for t in tasks])
    _print_episodes(episodes, every)
    columns = ["array", "dimensions", "shape of the first shard", "type", "unit"]
    print_table(columns, [list(a.values()) for a in arrays])
    limits = [
        [name, _numbers(a["min"]), _numbers(a["max"]), _numbers(a["mean"]), _numbers(a["std"])]
        for name, a in data.stats["arrays"].items()
    ]
    print_table(["array", "min", "max", "mean", "std"], limits)
    print_quality(data.stats)
    if data.provenance.inferred is not None:
        print_inferred(data.provenance, data.provenance.inferred)
    if checks is not None:
        print_checks(checks)


def _print_episodes(episodes: list[dict[str, Any]], every: bool) -> None:
    """Episodes by the numbers that other commands take: all, or the first ones."""
    listed = episodes if every else episodes[:_LISTED]
    columns = [
        name for name in ("episode", "task", "seed", "frames", "recording") if any(e[name] != "" for e in listed)
    ]
    print_table(columns, [[str(e[name]) for name in columns] for e in listed])
    if len(listed) < len(episodes):
        echo(f"... and {counted(len(episodes) - len(listed), 'episode')} more; --all lists them")


def _numbers(values: list[float]) -> str:
    """At most four numbers of a channel list."""
    return " ".join(f"{v:.3g}" for v in values[:4]) + (" ..." if len(values) > 4 else "")


@click.command()
@click.argument("folder", type=PATH)
@quiet_option
@json_option
def validate(folder: Path, as_json: bool) -> None:
    """Check a dataset, a training run or an experiment: one line for each finding, exit code 3 if there is any.

    What is no fault is a warning on the error output: that there are no actions to learn, and what spoke against a
    recording when it was labeled, too little to refuse it.
    """
    findings = []
    for finding in _findings_of(folder):
        findings.append(finding)
        if not as_json:
            echo(str(finding))
    if as_json:
        print_json([{"file": f.place, "problem": f.problem} for f in findings])
    _warn_of_doubts(folder)
    if findings:
        raise DataError(f"{folder}: {counted(len(findings), 'finding')}")
    if not as_json:
        echo(f"{folder}: sound{_reservation(folder)}")


def _findings_of(folder: Path) -> "Iterator[Finding]":
    """What is wrong with a dataset, a run or an experiment."""
    if (folder / "units").is_dir():
        from flowlab.benchmark.validation import validate_experiment

        return validate_experiment(folder)
    if any((folder / name).exists() for name in ("policy.json", "run.json")):
        from flowlab.evaluation.validation import validate_run

        return validate_run(folder)
    from flowlab.storage.validation import validate

    return validate(folder)


def _warn_of_doubts(folder: Path) -> None:
    """Say what was doubtful of recordings, and which were never checked; what is damaged has been told of."""
    from flowlab.pipeline.kept_checks import total_checks
    from flowlab.storage.dataset import Dataset
    from flowlab.storage.manifest import MANIFEST
    from flowlab.storage.trainable import missing_actions

    totals = None
    with suppress(FlowlabError):
        dataset = Dataset(folder) if (folder / MANIFEST).is_file() else None
        if dataset is not None and (without := missing_actions(dataset)):
            warn(f"warning: {folder}: {without}")
        totals = None if dataset is None else total_checks(dataset)
    if totals is None:
        return
    for episode in totals.doubtful:
        for check in episode.doubtful:
            warn(f"warning: {episode.shard}: {episode}: {check.about} is {check.verdict}: {check.says}")
    if totals.not_checked:
        without = counted(totals.not_checked, "episode was", "episodes were")
        warn(f"warning: {folder}: {without} labeled without checks, by an earlier flowlab")


def _reservation(folder: Path) -> str:
    """What checking cannot tell, to be added to what is sound."""
    if not (folder / "policy.json").exists():
        return ""
    from flowlab.evaluation.validation import has_checksums

    return "" if has_checksums(folder) else "; of an earlier version, without checksums: a changed number is not found"


@click.command()
@click.argument("dataset", type=PATH)
@click.option(
    "--to",
    "exporter",
    type=PluginName(EXPORTERS),
    required=True,
    metavar="NAME",
    help="Which tool: lerobot, dp3, or one of a plug-in.",
)
@click.option("--out", type=PATH, required=True, help="Where to write.")
@click.option("--task", help="Only this task's episodes.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Change an option of the exporter.")
@quiet_option
@json_option
def export(dataset: Path, exporter: str, out: Path, task: str | None, settings: tuple[str, ...], as_json: bool) -> None:
    """Write a dataset in another tool's layout.

    lerobot: a LeRobotDataset v3.0. dp3: the zarr v2 store that 3D-Diffusion-Policy's MetaworldDataset loads.
    'flowlab plugins exporters' lists what is installed.
    """
    from flowlab.storage.dataset import Dataset
    from flowlab.storage.exporters.base import make_exporter

    to = make_exporter(exporter, settings)
    data = Dataset(dataset)
    count = to.export(data, out, task)
    if data.reservation:
        warn(f"flowlab: {data.reservation}")
    if as_json:
        print_json({"dataset": str(dataset), "exporter": exporter, "out": str(out), "episodes": count})
        return
    echo(f"{counted(count, 'episode')} written to {out} for {exporter}")
