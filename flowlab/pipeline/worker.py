"""A worker's side of an extraction: one unit, from its seeds to its shard and receipt."""

import resource
from functools import lru_cache
from pathlib import Path

from flowlab.pipeline.recipe import parse_recipe
from flowlab.pipeline.stage import EpisodeRequest, Pipeline, Rejected
from flowlab.pipeline.units import WorkUnit
from flowlab.storage import stats
from flowlab.storage.dataset import keep_receipt
from flowlab.storage.manifest import Receipt, Reject
from flowlab.storage.shard import episode_digest


def run_unit(recipe_json: str, settings_digest: str, folder: Path, unit: WorkUnit) -> Receipt:
    """Make the episodes of a unit, write them into its shard, and its receipt beside them."""
    pipeline = _pipeline(recipe_json)
    before = dict(pipeline.tallies)
    episodes, rejects = [], []
    for seed in unit.seeds:
        try:
            episodes.append(pipeline.run(EpisodeRequest(task=unit.task, seed=seed)))
        except Rejected as rejected:
            stage, reason = rejected.args
            rejects.append(Reject(task=unit.task, seed=seed, stage=stage, reason=reason))
    if episodes:
        pipeline.store(folder / "shards" / f"{unit.name}.zarr", episodes, settings_digest)
    receipt = Receipt(
        unit=unit.name,
        task=unit.task,
        seeds=unit.seeds,
        accepted=tuple(e.seed for e in episodes),
        frames=tuple(len(e) for e in episodes),
        digests=tuple(episode_digest(e) for e in episodes),
        rejects=tuple(rejects),
        stages={name: tally.since(before[name]) for name, tally in pipeline.tallies.items()},
        stats=stats.summarise(episodes) if episodes else {},
        peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )
    keep_receipt(folder, receipt)
    return receipt


@lru_cache(maxsize=1)
def _pipeline(recipe_json: str) -> Pipeline:
    return parse_recipe(recipe_json, "recipe").pipeline()
