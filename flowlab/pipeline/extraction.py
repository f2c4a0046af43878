"""Datasets of simulated demonstrations: make one, or say what that would take."""

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from flowlab.arguments import check_names, check_optional_count, check_path, check_settings
from flowlab.engines.base import core_count
from flowlab.errors import FlowlabError, UsageError, unknown_name
from flowlab.pipeline.filling import engine_for, fill
from flowlab.pipeline.recipe import Recipe, load_recipe, parse_recipe
from flowlab.pipeline.scheduling import ExtractionProgress, SeedScheduler
from flowlab.pipeline.stage import EpisodeRequest, Rejected
from flowlab.pipeline.units import JobShard
from flowlab.sim.loading import load_mujoco
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import Manifest
from flowlab.storage.receipts import read_receipts
from flowlab.storage.schema import SCHEMA


def extract(
    tasks: Iterable[str] | str,
    out: Path | str,
    *,
    episodes: int | None = None,
    recipe: str | Recipe = "metaworld",
    settings: Iterable[str] = (),
    without: Iterable[str] | str = (),
    engine: str = "local",
    workers: int | None = None,
    shard: JobShard | str = JobShard(),
    repair: bool = False,
    on_progress: Callable[[ExtractionProgress], None] | None = None,
) -> Dataset:
    """Make a dataset of simulated demonstrations with exact tracks, as ``flowlab extract-sim`` does.

    Args:
        tasks: Names of tasks or of groups of them, or one name; where there are none, the recipe's.
        out: Folder of the dataset. One that was made with the same settings is continued or extended.
        episodes: Successful episodes of each task; None for as many as the recipe says.
        recipe: Name of a recipe that comes with flowlab, path of a YAML file, or a recipe.
        settings: Changes of single settings, ``observer.points=512``.
        without: What to leave out, ``actions`` or ``state`` or both, as in films of a robot; see
            :func:`flowlab.label_actions`.
        engine: Where it is done: the name of an engine.
        workers: Processes; None for one for each core.
        shard: The part to do, for jobs that fill one dataset together: ``0/4``.
        repair: Read all that is there, and make again what is damaged.
        on_progress: Called whenever an episode is there.

    Returns:
        The dataset, complete but for what other shards do.

    Raises:
        UsageError: A name, a setting or the recipe does not fit.
        DataError: The folder holds a dataset that was made with other settings.
        UnfinishedError: Some units failed; the dataset is whole, and the same call does the rest.
    """
    chosen, names = _prepare(tasks, episodes, recipe, settings, without)
    plan = SeedScheduler(dict.fromkeys(names, chosen.episodes), chosen.first_seed)
    return fill(
        chosen,
        manifest_for(chosen, names),
        lambda _: plan,
        check_path(out, "out"),
        start_engine=engine_for(chosen, engine, workers),
        share=JobShard.parse(shard) if isinstance(shard, str) else shard,
        report=on_progress or (lambda _: None),
        repair=repair,
    )


@dataclass(frozen=True, slots=True)
class ExtractionEstimate:
    """What an extraction would take, by one episode of it."""

    tasks: int
    episodes_wanted: int
    episodes_to_do: int
    """Those wanted that the dataset does not have yet."""
    frames_per_episode: str
    """Of the episode that was timed, and which that was."""
    cpu_s_per_episode: float
    workers: int
    estimated_minutes: float
    estimated_megabytes: float
    """Before compression."""
    out: str


def estimate(
    tasks: Iterable[str] | str,
    out: Path | str,
    *,
    episodes: int | None = None,
    recipe: str | Recipe = "metaworld",
    settings: Iterable[str] = (),
    without: Iterable[str] | str = (),
    workers: int | None = None,
) -> ExtractionEstimate:
    """What :func:`extract` would do, timed on the first seed of the first task; nothing is written.

    Args:
        tasks: See :func:`extract`, as for all others.

    Raises:
        FlowlabError: The episode that would be timed is rejected.
    """
    chosen, names = _prepare(tasks, episodes, recipe, settings, without)
    pipeline = chosen.pipeline()
    request = EpisodeRequest(task=names[0], seed=chosen.first_seed)
    try:
        pipeline.run(request)  # compiles and loads
        start = time.process_time()
        episode = pipeline.run(request)
    except Rejected as rejected:
        raise FlowlabError(
            f"{request.task} seed {request.seed} is rejected at {rejected.stage} ({rejected}): no estimate"
        ) from rejected
    seconds = time.process_time() - start
    workers = check_optional_count(workers, "workers") or core_count()
    have = Counter(task for r in read_receipts(Path(out)) for task in [r.task] * len(r.accepted))
    todo = sum(max(chosen.episodes - have[t], 0) for t in names)
    episode_bytes = sum(v.nbytes for s in SCHEMA if s.per_step and (v := s.of(episode)) is not None)
    return ExtractionEstimate(
        tasks=len(names),
        episodes_wanted=chosen.episodes * len(names),
        episodes_to_do=todo,
        frames_per_episode=f"{len(episode)} ({request.task} seed {request.seed})",
        cpu_s_per_episode=round(seconds, 3),
        workers=workers,
        estimated_minutes=round(todo * seconds / workers / 60, 2),
        estimated_megabytes=round(todo * episode_bytes / 1e6, 1),
        out=str(out),
    )


def manifest_for(recipe: Recipe, tasks: tuple[str, ...]) -> Manifest:
    """The manifest of the dataset that a recipe makes. Raises :class:`UsageError` where it does not simulate."""
    provenance = recipe.pipeline().provenance(tasks[0])
    if not provenance.is_simulated:
        raise UsageError(f"recipe {recipe.name}: extract-sim needs a stage that simulates at the start, as 'expert'")
    return Manifest(
        recipe=recipe.name,
        settings=recipe.settings(),
        provenance=provenance,
        first_seed=recipe.first_seed,
        requested=dict.fromkeys(tasks, recipe.episodes),
    )


def _prepare(
    tasks: Iterable[str] | str,
    episodes: int | None,
    recipe: str | Recipe,
    settings: Iterable[str],
    without: Iterable[str] | str,
) -> tuple[Recipe, tuple[str, ...]]:
    """The recipe with its changes, and the names of the tasks."""
    load_mujoco()
    from flowlab.sim.tasks import tasks_named

    episodes = check_optional_count(episodes, "episodes")
    changes = [*check_settings(settings), *([f"episodes={episodes}"] if episodes is not None else [])]
    chosen = _withholding(load_recipe(recipe, changes), check_names(without, "without"))
    asked = check_names(tasks, "tasks") or chosen.tasks
    names = tasks_named(asked)
    if not names:
        raise UsageError("name the tasks to extract, as in 'flowlab extract-sim hammer push --out data/demo'")
    return chosen, names


_WITHOUT = {"actions": "action", "state": "state"}


def _withholding(recipe: Recipe, what: Iterable[str]) -> Recipe:
    """The recipe, with a stage before its last that leaves something out."""
    names = [*what]
    for name in names:
        if name not in _WITHOUT:
            raise unknown_name("thing to leave out", name, _WITHOUT)
    if not names:
        return recipe
    values = json.loads(recipe.model_dump_json())
    values["stages"].insert(-1, {"stage": "withhold", "what": sorted({_WITHOUT[name] for name in names})})
    return parse_recipe(json.dumps(values), recipe.name, folder=recipe.folder)
