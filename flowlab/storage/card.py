"""The dataset card: what a stranger who finds the folder needs to know."""

import hashlib
import json
import re
from collections.abc import Collection, Sequence
from typing import Any

from flowlab.storage.manifest import Manifest
from flowlab.storage.receipts import Receipt
from flowlab.storage.schema import EPISODE_ENDS, SCHEMA
from flowlab.text import counted, markdown

CARD = "README.md"
_CARD = """---
tags: [robotics, point-cloud, 3d-flow, flowlab]
---
# 3D-flow dataset {recipe}

{held}, made by flowlab {version}. World frame: {world_frame}

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
_MARK = "\n<!-- of what flowlab counted: {facts}; text: {text} -->\n"
"""Ends a card: digests of what it was written from, and of all above. Another flowlab may put it in other words."""
_MARKED = re.compile(r"(.*)\n<!-- of what flowlab counted: (\w{16}); text: (\w{16}) -->\n", re.DOTALL)

_QUALITY = """
Tracks are estimated from pictures, by the tracker {tracker}; every position states its error as `data/sigma`.
Of visible points it is {p50:.2g} mm in the median and {p90:.2g} mm at the 90th percentile. {visible:.0%} of all
positions are visible; {shares}.
"""


def dataset_card(
    manifest: Manifest, receipts: Sequence[Receipt], stats: dict[str, Any], arrays: Collection[str]
) -> str:
    """The text of the dataset's ``README.md``; ``arrays`` are the paths of those that its shards hold."""
    held = f"{counted(stats['episodes'], 'episode')}, {counted(stats['frames'], 'frame')}"
    rows = _task_rows(manifest, receipts)
    text = _text(manifest, rows, stats, held, schema_table(arrays))
    facts = json.dumps([manifest.recipe, manifest.provenance.world_frame, rows, stats], sort_keys=True)
    return text + _MARK.format(facts=_digest(facts), text=_digest(text))


def says_the_same(
    found: str, card: str, manifest: Manifest, receipts: Sequence[Receipt], stats: dict[str, Any]
) -> bool:
    """Whether a card that was found says what ``card``, which was written now, does: in its words, or, undamaged, in
    those of another flowlab."""
    if found == card:
        return True
    theirs, mine = _MARKED.fullmatch(found), _MARKED.fullmatch(card)
    if theirs and mine:
        return theirs[2] == mine[2] and theirs[3] == _digest(theirs[1])
    held = f"{stats['episodes']} episodes, {stats['frames']} frames"  # of the first flowlab, which had no mark yet
    return found == _text(manifest, _task_rows(manifest, receipts), stats, held, schema_table())


def without_mark(card: str) -> str:
    """A card without its last line, which is nothing to read."""
    marked = _MARKED.fullmatch(card)
    return marked[1] if marked else card


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _task_rows(manifest: Manifest, receipts: Sequence[Receipt]) -> list[str]:
    """A row of the table for each task."""
    rows = []
    for task in manifest.requested:
        mine = [r for r in receipts if r.task == task]
        frames = sum(sum(r.frames) for r in mine)
        rejected = sum(len(r.rejects) for r in mine)
        rows.append(f"| {markdown(task)} | {sum(len(r.accepted) for r in mine)} | {frames} | {rejected} |")
    return rows


def _text(manifest: Manifest, rows: Sequence[str], stats: dict[str, Any], held: str, arrays: str) -> str:
    """All that there is to read."""
    return _CARD.format(
        recipe=markdown(manifest.recipe),
        version=markdown(manifest.flowlab),
        world_frame=markdown(manifest.provenance.world_frame),
        held=held,
        tasks="\n".join(rows),
        still=stats["motion"]["still_share"],
        moving=stats["motion"]["moving_point_share"],
        p95=stats["motion"]["step_m"]["p95"] * 1e3,
        quality=_quality(manifest, stats["quality"]) if "quality" in stats else "",
        ends=EPISODE_ENDS,
        arrays=arrays,
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


def schema_table(arrays: Collection[str] | None = None) -> str:
    """The arrays of a shard as a Markdown table: those at the paths given, or all that there can be."""
    if arrays is not None and not arrays:
        return "There are none yet."
    rows = []
    for s in SCHEMA:
        if arrays is None or s.path in arrays:
            optional = "; optional" if s.optional and arrays is None else ""
            rows.append(f"| `{s.path}` | {', '.join(s.dims)} | {s.dtype} | {s.unit} | {s.meaning}{optional} |")
    return "\n".join(["| array | dimensions | type | unit | meaning |", "|---|---|---|---|---|", *rows])
