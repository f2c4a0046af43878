"""Demonstrations that a policy was not trained on: its run's own, or those of another dataset."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flowlab.data.replay_buffer import ReplayBuffer, load_buffer
from flowlab.data.source import TrainingSource, open_training_source
from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.policies.checkpoint import LoadedPolicy, check_observer
from flowlab.policies.run_config import RunConfig, check_positions, read_run_config
from flowlab.policies.spec import PolicySpec
from flowlab.policies.trained import RUN, TrainedPolicy
from flowlab.storage.dataset import Dataset
from flowlab.storage.shard import Shard
from flowlab.untrusted import is_there


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Demonstrations that a policy is compared with."""

    dataset: Path
    buffer: ReplayBuffer
    cameras: tuple[Camera | None, ...] | None
    """Of every demonstration, None for one that moves; None where the dataset has none."""


def open_held_out(loaded: LoadedPolicy, data: Path | None = None) -> HeldOut:
    """The demonstrations that a policy's run held out; or those of another dataset, but for scenes of the simulation
    that the policy was trained on.

    Raises:
        DataError: There are none, or the dataset does not fit the policy.
    """
    run = loaded.path.absolute().parents[1]
    source = _open_source(loaded, run, data)
    check_observer(loaded.trained, run, source)
    buffer = load_buffer(source, run, loaded.policy.needs.pictures)
    _check_fit(loaded.policy.spec, buffer, source.path)
    buffer = _select(buffer, _unseen(loaded, run, source, buffer))
    return HeldOut(
        source.path, buffer, _cameras(source.paths, buffer) if source.provenance.kind != "imported" else None
    )


def _open_source(loaded: LoadedPolicy, run: Path, data: Path | None) -> TrainingSource:
    """The dataset that is given, or the run's own, which must be what it was."""
    if data is not None:
        return open_training_source(data)
    paths = _read_plan(run).datasets
    for path in paths:
        if not is_there(path):
            raise DataError(f"{run}: its dataset is no longer at {path}; give where it is now with --data")
    source = open_training_source(*paths, known=True)
    if source.fingerprint != loaded.trained.fingerprint:
        raise DataError(
            f"{run}: was trained on content {loaded.trained.fingerprint} of {source.path}, now {source.fingerprint}; "
            "restore the dataset, or give another with --data"
        )
    return source


def _read_plan(run: Path) -> RunConfig:
    """Which demonstrations were trained on, and which held out."""
    if not (run / RUN).exists():
        raise DataError(
            f"{run}: does not tell which demonstrations were held out (it has no {RUN}); restore it, or give another "
            "dataset with --data"
        )
    return read_run_config(run)


def _check_fit(spec: PolicySpec, buffer: ReplayBuffer, where: Path) -> None:
    """Refuse a dataset whose state or action is another than the policy's, or that lacks what it predicts."""
    for name, wanted, found in (
        ("state", spec.state_width, buffer.state.shape[1]),
        ("action", spec.action_width, buffer.action.shape[1]),
    ):
        if found != wanted:
            raise DataError(f"{where}: '{name}' is {found} wide, and {wanted} in what the policy was trained on")
    if missing := spec.settings.needs.missing_from(buffer):
        raise DataError(
            f"{where}: has no {missing}, which {spec.settings.policy} needs; evaluate it on a dataset that has them"
        )
    if not set(spec.tasks) & set(buffer.tasks):
        raise DataError(
            f"{where}: has the tasks {', '.join(buffer.tasks)}, and the policy was trained on {', '.join(spec.tasks)}"
        )


def _unseen(loaded: LoadedPolicy, run: Path, source: TrainingSource, buffer: ReplayBuffer) -> list[int]:
    """Positions of the demonstrations that the policy knows the task of, and was not trained on."""
    if source.fingerprint == loaded.trained.fingerprint:
        planned = _read_plan(run)
        check_positions(run, planned, len(buffer.episodes))
        if found := [k for k in planned.held_out if k not in planned.train]:
            return found
        raise DataError(
            f"{run}: no demonstration was held out from its training (data.held_out, --overfit); give another dataset "
            "with --data"
        )
    known = _known_scenes(loaded.trained, run, source)
    of_tasks = [k for k, d in enumerate(buffer.episodes) if d.task in loaded.trained.policy.tasks]
    if found := [k for k in of_tasks if (buffer.episodes[k].task, buffer.episodes[k].seed) not in known]:
        return found
    raise DataError(
        f"{source.path}: the policy was trained on the scenes of all its {len(of_tasks)} demonstrations; give a "
        "dataset with others"
    )


def _known_scenes(trained: TrainedPolicy, run: Path, source: TrainingSource) -> set[tuple[str, int]]:
    """Simulated scenes, by task and seed, that a policy was trained on and that another dataset may hold too."""
    planned = read_run_config(run) if (run / RUN).exists() else None
    if source.provenance.is_simulated:
        scene_seeds = [(task, seed) for task in sorted(trained.scene_seeds) for seed in trained.scene_seeds[task]]
        if scene_seeds and planned is not None:
            check_positions(run, planned, len(scene_seeds))
        return set([scene_seeds[k] for k in planned.train] if scene_seeds and planned is not None else scene_seeds)
    if planned is not None and source.path.resolve() in planned.datasets:
        raise DataError(
            f"{source.path}: its content is no longer what {run} was trained on, and nothing tells which of its "
            "demonstrations were; give a dataset of others with --data"
        )
    return set()


def _select(buffer: ReplayBuffer, demos: Sequence[int]) -> ReplayBuffer:
    """The buffer with some of its demonstrations."""
    names = ("queries", "query_role", "query_count")
    mine: dict[str, Any] = {name: getattr(buffer, name)[list(demos)] for name in names}
    return replace(buffer, episodes=tuple(buffer.episodes[k] for k in demos), **mine)


def _cameras(paths: Sequence[Path], buffer: ReplayBuffer) -> tuple[Camera | None, ...]:
    """The camera of every demonstration that has one for all of its rows: a simulated dataset's, or its recording's."""
    shards = {(k, r.task, r.seed): path / r.shard for k, path in enumerate(paths) for r in Dataset(path).refs}
    of_demos = [shards[d.origin, d.task, d.seed] for d in buffer.episodes]
    cameras = {shard: Shard(shard).camera for shard in {*of_demos}}
    return tuple(cameras[shard] for shard in of_demos)
