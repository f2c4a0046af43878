"""The dataset card: what a stranger who finds the folder needs to know."""

from collections.abc import Sequence
from typing import Any

from flowlab.storage.manifest import Manifest
from flowlab.storage.receipts import Receipt
from flowlab.storage.schema import EPISODE_ENDS, SCHEMA
from flowlab.text import markdown

_CARD = """---
tags: [robotics, point-cloud, 3d-flow, flowlab]
---
# 3D-flow dataset {recipe}

{episodes} episodes, {frames} frames, made by flowlab {version}. World frame: {world_frame}

`flowlab info` shows more, `flowlab validate` checks it, `flowlab viz --episode 0` draws it.

| task | episodes | frames | rejected |
|---|---|---|---|
{tasks}

Motion: {still:.0%} of all point steps are still (< 0.1 mm); {moving:.0%} of the query points move more
than 1 cm in their episode; the 95th percentile of a step is {p95:.2g} mm.
{quality}
## Arrays of a shard

`shards/*.zarr` are zarr v3 groups of whole episodes; `{ends}` gives the row after each episode's last.

{arrays}
"""

_QUALITY = """
Tracks are estimated from pictures, by the tracker {tracker}; every position states its error as `data/sigma`.
Of visible points it is {p50:.2g} mm in the median and {p90:.2g} mm at the 90th percentile. {visible:.0%} of all
positions are visible; {shares}.
"""


def dataset_card(manifest: Manifest, receipts: Sequence[Receipt], stats: dict[str, Any]) -> str:
    """The text of the dataset's ``README.md``."""
    rows = []
    for task in manifest.requested:
        mine = [r for r in receipts if r.task == task]
        frames = sum(sum(r.frames) for r in mine)
        rejected = sum(len(r.rejects) for r in mine)
        rows.append(f"| {markdown(task)} | {sum(len(r.accepted) for r in mine)} | {frames} | {rejected} |")
    return _CARD.format(
        recipe=markdown(manifest.recipe),
        version=markdown(manifest.flowlab),
        world_frame=markdown(manifest.provenance.world_frame),
        episodes=stats["episodes"],
        frames=stats["frames"],
        tasks="\n".join(rows),
        still=stats["motion"]["still_share"],
        moving=stats["motion"]["moving_point_share"],
        p95=stats["motion"]["step_m"]["p95"] * 1e3,
        quality=_quality(manifest, stats["quality"]) if "quality" in stats else "",
        ends=EPISODE_ENDS,
        arrays=schema_table(),
    )


def _quality(manifest: Manifest, quality: dict[str, Any]) -> str:
    """What the card says of tracks that were estimated."""
    sigma = quality["visible_sigma_m"]
    return _QUALITY.format(
        tracker=markdown(manifest.provenance.tracker or "unknown"),
        p50=sigma["p50"] * 1e3,
        p90=sigma["p90"] * 1e3,
        visible=quality["visible_share"],
        shares=", ".join(f"{share:.0%} are {markdown(source)}" for source, share in quality["source_share"].items()),
    )


def schema_table() -> str:
    """The arrays of a shard as a Markdown table."""
    rows = [
        f"| `{s.path}` | {', '.join(s.dims)} | {s.dtype} | {s.unit} | {s.meaning}{'; optional' if s.optional else ''} |"
        for s in SCHEMA
    ]
    return "\n".join(["| array | dimensions | type | unit | meaning |", "|---|---|---|---|---|", *rows])
