"""A worker's side of an extraction: one unit, from its seeds to its shard and receipt."""

import resource
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import lru_cache
from pathlib import Path

from flowlab.checksums import sha256_of
from flowlab.errors import DataError
from flowlab.files import locked
from flowlab.pipeline.recipe import parse_recipe
from flowlab.pipeline.stage import Pipeline, Rejected
from flowlab.pipeline.units import WorkUnit
from flowlab.records import Episode
from flowlab.storage import stats
from flowlab.storage.receipts import (
    Receipt,
    Reject,
    RowFormat,
    StageTally,
    common_format,
    keep_receipt,
    known_row_format,
    shard_path,
)
from flowlab.storage.recorded import CONTENT
from flowlab.storage.shard import episode_digest


def run_unit(
    recipe_json: str, stages_folder: Path | None, settings_digest: str, folder: Path, unit: WorkUnit
) -> Receipt:
    """Make the episodes of a unit, write them into its shard, and its receipt beside them.

    Args:
        recipe_json: The recipe, as JSON.
        stages_folder: Where the modules of its own stages may lie.
        settings_digest: Identifies its settings; the shard says it.
        folder: Of the dataset.
        unit: What is to be made.
    """
    pipeline = _pipeline(recipe_json, stages_folder)
    before = dict(pipeline.tallies)
    episodes: list[Episode] = []
    rejects: list[Reject] = []
    kept: list[Episode] = []
    for request in unit.requests:
        try:
            episodes.append(pipeline.run(request))
        except Rejected as rejected:
            position = None
            if rejected.episode is not None:
                position = len(kept)
                kept.append(pipeline.writer.process(rejected.episode))
            about = request.model_dump()
            why = {"stage": rejected.stage, "reason": rejected.reason, "retry": rejected.retry}
            rejects.append(Reject(**about, **why, position=position))
    return keep_unit(
        folder, unit, episodes, rejects, kept, store=pipeline.store, settings_digest=settings_digest,
        stages=lambda: {name: tally.since(before[name]) for name, tally in pipeline.tallies.items()},
    )  # fmt: skip


def keep_unit(
    folder: Path,
    unit: WorkUnit,
    episodes: Sequence[Episode],
    rejects: Sequence[Reject],
    kept: Sequence[Episode],
    *,
    store: Callable[[Path, Sequence[Episode], str], None],
    settings_digest: str,
    stages: Callable[[], Mapping[str, StageTally]],
) -> Receipt:
    """Write what became of a unit: its shard, and then its receipt.

    Args:
        folder: Of the dataset.
        unit: What was to be made.
        episodes: Those that are good.
        rejects: Why others are not.
        kept: Rejected episodes that people may look at.
        store: Writes episodes into a shard.
        settings_digest: What the shard says of the settings.
        stages: What the stages did, asked for when all is stored.
    """
    known = known_row_format(folder)
    with nullcontext() if known else locked(folder):  # the first episodes decide, and only one unit has them
        episodes, misfits = _fitting(episodes, known or known_row_format(folder), unit)
        checksums = {
            place: _store(store, folder, place, unit.name, found, settings_digest)
            for place, found in (("shards", episodes), ("rejects", kept))
        }
        common = common_format(map(RowFormat.of, episodes))
        receipt = Receipt(
            unit=unit.name,
            task=unit.task,
            seeds=unit.seeds,
            accepted=tuple(e.seed for e in episodes),
            frames=tuple(len(e) for e in episodes),
            digests=tuple(episode_digest(e) for e in episodes),
            contents=_contents(unit, [*episodes, *kept]),
            shard_sha256=checksums["shards"],
            rejects_sha256=checksums["rejects"],
            rejects=(*rejects, *misfits),
            stages=stages(),
            state_names=common.state_names if common else (),
            action_names=common.action_names if common else (),
            stats=stats.summarize(episodes) if episodes else {},
            peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        )
        keep_receipt(folder, receipt)
    return receipt


def _contents(unit: WorkUnit, episodes: Sequence[Episode]) -> tuple[str, ...]:
    """What the recordings of a unit are known by: as they were when they were opened, which may be long after."""
    opened = {e.seed: str(e.extras[CONTENT]) for e in episodes if CONTENT in e.extras}
    return tuple(opened.get(seed, content) for seed, content in zip(unit.seeds, unit.contents, strict=False))


def _fitting(
    episodes: Sequence[Episode], known: RowFormat | None, unit: WorkUnit
) -> tuple[list[Episode], list[Reject]]:
    """The episodes whose state and action are the dataset's, and why the others are not kept.

    Raises :class:`DataError` in simulation, where the next seed would be no better.
    """
    fitting: list[Episode] = []
    misfits: list[Reject] = []
    sources = {request.seed: request.source for request in unit.requests}
    for episode in episodes:
        found = RowFormat.of(episode)
        problem = known.problem(found) if known else ""
        source = sources.get(episode.seed, "")
        if not problem:
            known = found.or_names_of(known)
            fitting.append(episode)
        elif source:
            reason = f"{problem}; choose the same ones in the same order, or label it into another --out"
            misfits.append(
                Reject(task=unit.task, seed=episode.seed, stage="write", reason=reason, source=source, retry=True)
            )
        else:
            raise DataError(f"{unit.task} seed {episode.seed}: {problem}; make this task in another --out")
    return fitting, misfits


def _store(
    store: Callable[[Path, Sequence[Episode], str], None],
    folder: Path,
    place: str,
    unit: str,
    episodes: Sequence[Episode],
    settings_digest: str,
) -> str:
    """Write a shard, and its SHA-256; where there is nothing to write, remove what an earlier try has left."""
    path, folder_shard = (folder / shard_path(place, unit, zipped=zipped) for zipped in (True, False))
    if folder_shard.is_dir() and not folder_shard.is_symlink():
        shutil.rmtree(folder_shard, ignore_errors=True)
    if not episodes:
        path.unlink(missing_ok=True)
        return ""
    store(path, episodes, settings_digest)
    return sha256_of(path)


@lru_cache(maxsize=1)
def _pipeline(recipe_json: str, stages_folder: Path | None) -> Pipeline:
    return parse_recipe(recipe_json, "recipe", folder=stages_folder).pipeline()
