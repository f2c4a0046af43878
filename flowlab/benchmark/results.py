"""Results of experiments on disk, and those of runs that were evaluated."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from flowlab.benchmark.episode_columns import columns_path, read_columns, write_columns
from flowlab.benchmark.migrations import migrate_result
from flowlab.checksums import with_checksum, without_checksum
from flowlab.config import explain
from flowlab.errors import DataError
from flowlab.evaluation.checkpoints import read_evaluations
from flowlab.evaluation.results import PolicyResult
from flowlab.evaluation.training_record import describe_run
from flowlab.files import remove_leftovers, told_when_unwritable, write_atomically
from flowlab.policies.trained import read_trained
from flowlab.text import shown
from flowlab.untrusted import is_there, read_json

_ADVICE = "restore it, or delete it and the experiment does it again"
_EPISODES = "episodes_sha256"
"""Key that tells the checksum of the episodes beside a result; earlier results hold their episodes."""
UNITS = "units"
"""Folder of an experiment that holds its results."""


def unit_path(experiment: Path, name: str) -> Path:
    """Where an experiment keeps the result of a unit."""
    return experiment / UNITS / f"{name}.json"


def write_result(path: Path, result: PolicyResult) -> None:
    """Write a result: its episodes as columns, and then what else is known of it as JSON; it counts from then on."""
    with told_when_unwritable(path, "make room, then give the same command again"):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        values = result.model_dump(
            mode="json", exclude_defaults=True, exclude={"evaluations": {"__all__": {"outcomes"}}}
        )
        values[_EPISODES] = write_columns(columns_path(path), result.evaluations)
        write_atomically(path, json.dumps(with_checksum(values)) + "\n")


def read_result(path: Path) -> PolicyResult:
    """The inverse of :func:`write_result`; what older versions wrote, all of it JSON, is read too.

    Raises:
        DataError: A file is damaged.
    """
    values = without_checksum(read_json(path, _ADVICE), str(path), _ADVICE)
    try:
        if isinstance(values, dict) and _EPISODES in values:
            values = _with_episodes(values, path)
        return PolicyResult.model_validate(migrate_result(values))
    except ValidationError as error:
        raise DataError(f"{path}: {explain(error, PolicyResult)}; {_ADVICE}") from error


def _with_episodes(values: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The values of a result, with the episodes that are beside it."""
    values = dict(values)
    episodes = read_columns(
        columns_path(path), values.pop(_EPISODES), f"restore it, or delete {path} and the experiment does it again"
    )
    evaluations = values.get("evaluations")
    for e in evaluations if isinstance(evaluations, list) else ():
        if isinstance(e, dict):
            asked = (e.get("step"), e.get("n_action_steps"))
            e["outcomes"] = next((episodes.pop(key) for key in episodes if key == asked), [])
    if episodes:
        step, n_action_steps = next(iter(episodes))
        raise DataError(
            f"{columns_path(path)}: has episodes at step {shown(step)}, {shown(n_action_steps)} steps executed, of "
            f"which {path} knows nothing; {_ADVICE}"
        )
    return values


def read_results(folders: Sequence[Path]) -> list[PolicyResult]:
    """All results of experiments and of evaluated runs. Raises :class:`DataError` where a folder is neither."""
    results = []
    for folder in folders:
        results += read_experiment(folder) if (folder / UNITS).is_dir() else [_read_run(folder)]
    return results


def read_experiment(out: Path) -> list[PolicyResult]:
    """All results of an experiment. Raises :class:`DataError` where there is none yet."""
    found = sorted(p for p in (out / UNITS).glob("*.json") if not p.name.startswith("."))
    if not found:
        raise DataError(f"{out}: no unit of the experiment is done yet; 'flowlab bench --out {out}' goes on with it")
    return [read_result(path) for path in found]


def _read_run(run: Path) -> PolicyResult:
    """What has been evaluated of a run so far."""
    if not is_there(run):
        raise DataError(f"{run}: there is no such folder")
    read_trained(run)
    evaluations = read_evaluations(run)
    if not evaluations:
        raise DataError(f"{run}: has not been evaluated yet; do so with 'flowlab eval {run}'")
    return describe_run(run, evaluations)
