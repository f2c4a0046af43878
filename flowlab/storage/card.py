"""The dataset card: what a stranger who finds the folder needs to know."""

from collections.abc import Sequence
from typing import Any

from flowlab.storage.manifest import Manifest, Receipt
from flowlab.storage.schema import EPISODE_ENDS, SCHEMA

_CARD = """---
tags: [robotics, point-cloud, 3d-flow, flowlab]
---
# 3D-flow dataset `{recipe}`

{episodes} episodes, {frames} frames, made by flowlab {version}. World frame: {world_frame}

`flowlab info` shows more, `flowlab validate` checks it, `flowlab viz --episode 0` draws it.

| task | episodes | frames | rejected seeds |
|---|---|---|---|
{tasks}

Motion: {still:.0%} of all point steps are still (< 0.1 mm); {moving:.0%} of the query points move more
than 1 cm in their episode; the 95th percentile of a step is {p95:.2g} mm.

## Arrays of a shard

`shards/*.zarr` are zarr v3 groups of whole episodes; `{ends}` gives the row after each episode's last.

{arrays}
"""


def dataset_card(manifest: Manifest, receipts: Sequence[Receipt], stats: dict[str, Any]) -> str:
    """The text of the dataset's ``README.md``."""
    rows = []
    for task in manifest.requested:
        mine = [r for r in receipts if r.task == task]
        frames = sum(sum(r.frames) for r in mine)
        rejected = sum(len(r.rejects) for r in mine)
        rows.append(f"| {task} | {sum(len(r.accepted) for r in mine)} | {frames} | {rejected} |")
    return _CARD.format(
        recipe=manifest.recipe,
        version=manifest.flowlab,
        world_frame=manifest.world_frame,
        episodes=stats["episodes"],
        frames=stats["frames"],
        tasks="\n".join(rows),
        still=stats["motion"]["still_share"],
        moving=stats["motion"]["moving_point_share"],
        p95=stats["motion"]["step_m"]["p95"] * 1e3,
        ends=EPISODE_ENDS,
        arrays=schema_table(),
    )


def schema_table() -> str:
    """The arrays of a shard as a Markdown table."""
    rows = [
        f"| `{s.path}` | {', '.join(s.dims)} | {s.dtype} | {s.unit} | {s.meaning}{'; optional' if s.optional else ''} |"
        for s in SCHEMA
    ]
    return "\n".join(["| array | dimensions | type | unit | meaning |", "|---|---|---|---|---|", *rows])
