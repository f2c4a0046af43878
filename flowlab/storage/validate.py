"""Everything that would spoil training on a dataset, found before it does."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from flowlab.errors import DataError
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import MANIFEST, Receipt
from flowlab.storage.schema import EPISODE_ENDS, SCHEMA
from flowlab.storage.shard import Shard, episode_digest

TELEPORT = 0.15
"""A query point that moves more than this in one step [m] is wrong; the fastest of all 50 tasks, the
faucet's handle, moves half as far."""
OFF_SURFACE = 0.03
"""A visible point this much farther from the cloud [m] than the cloud is coarse lies on no surface."""
OFF_SURFACE_SHARE = 0.02
"""Share of an episode's visible points that may do so: pixels at silhouettes show what is behind."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing wrong with a dataset."""

    place: str
    """The file."""
    problem: str
    """What was found, what was expected, what to do."""

    def __str__(self) -> str:
        return f"{self.place}: {self.problem}"


def validate(path: Path) -> Iterator[Finding]:
    """Every finding about a dataset; none if it is sound and complete."""
    try:
        dataset = Dataset(path)
    except DataError as error:
        yield _finding(path, error)
        return
    yield from _check_books(dataset)
    seen: dict[tuple[str, int], str] = {}
    for receipt in dataset.receipts:
        if not receipt.accepted:
            continue
        place = path / receipt.shard
        if not place.exists():
            yield Finding(str(place), f"missing, but {path}/receipts/{receipt.unit}.json counts it; {_ANEW}")
            continue
        for task_seed in ((receipt.task, s) for s in receipt.accepted):
            if task_seed in seen:
                yield Finding(str(place), f"{task_seed[0]} seed {task_seed[1]} is also in {seen[task_seed]}")
            seen[task_seed] = str(place)
        try:
            yield from _check_shard(dataset, receipt, Shard(place))
        except DataError as error:
            yield _finding(place, error)


_ANEW = "delete the receipt and run the same extract command again"


def _finding(path: Path, error: DataError) -> Finding:
    place, separator, problem = str(error).partition(": ")
    return Finding(place, problem) if separator else Finding(str(path), place)


def _check_books(dataset: Dataset) -> Iterator[Finding]:
    """Manifest, receipts and folder against each other."""
    path = dataset.path
    for task, missing in dataset.missing.items():
        asked = dataset.manifest.requested[task]
        problem = f"{task}: {asked - missing} of {asked} episodes; run the same extract command again for the rest"
        yield Finding(str(path / MANIFEST), problem)
    counted = {r.shard for r in dataset.receipts if r.accepted}
    for shard in sorted((path / "shards").glob("*.zarr")):
        if f"shards/{shard.name}" not in counted:
            yield Finding(str(shard), "has no receipt, so it does not count; run the same extract command again")


def _check_shard(dataset: Dataset, receipt: Receipt, shard: Shard) -> Iterator[Finding]:
    place = str(shard.path)
    if shard.attributes.get("settings_digest") != dataset.manifest.settings_digest:
        yield Finding(place, f"made with other settings than {MANIFEST} states; remove it and extract again")
    if len(shard) != len(receipt.accepted):
        yield Finding(place, f"holds {len(shard)} episodes, its receipt says {len(receipt.accepted)}; {_ANEW}")
        return
    columns, problems = {}, False
    for spec in SCHEMA:
        if spec.optional and not shard.has(spec):
            continue
        try:
            columns[spec.path] = shard.array(spec.path)
        except DataError as error:
            problems = True
            yield _finding(shard.path, error)
    ends = shard.array(EPISODE_ENDS)
    for problem in [] if problems else _shape_problems(dataset.manifest.settings, columns, ends):
        problems = True
        yield problem.under(place)
    if problems:
        return
    episodes = list(shard.episodes())
    held = [(e.task, e.seed, len(e)) for e in episodes]
    told = [(receipt.task, *x) for x in zip(receipt.accepted, receipt.frames, strict=True)]
    if held != told:
        yield Finding(place, f"holds (task, seed, frames) {held}, its receipt says {told}; {_ANEW}")
        return
    for episode, digest in zip(episodes, receipt.digests, strict=True):
        for problem in _episode_problems(episode, dataset.manifest.settings):
            yield problem.under(place, f"seed {episode.seed}: ")
        if episode_digest(episode) != digest:
            yield Finding(place, f"seed {episode.seed}: content differs from what its receipt says; {_ANEW}")


@dataclass(frozen=True, slots=True)
class _Problem:
    array: str
    what: str

    def under(self, shard: str, who: str = "") -> Finding:
        return Finding(f"{shard}/{self.array}", who + self.what)


def _shape_problems(
    settings: Mapping[str, Any], columns: dict[str, np.ndarray], ends: np.ndarray
) -> Iterator[_Problem]:
    """Types and shapes against the schema, the settings and each other."""
    if len(ends) == 0 or (np.diff(ends, prepend=0) <= 0).any():
        yield _Problem(EPISODE_ENDS, f"must rise from above 0, found {ends.tolist()[:8]}")
        return
    sizes = {"time": int(ends[-1]), "episode": len(ends), "xyz": 3, "rgb": 3, "pose": 9}
    sizes |= {dim: settings[stage]["points"] for dim, stage in _SIZE_OF.items() if stage in settings}
    for spec in SCHEMA:
        if spec.path not in columns:
            continue
        values = columns[spec.path]
        if values.dtype != spec.dtype:
            yield _Problem(spec.path, f"type is {values.dtype}, expected {spec.dtype}")
        expected = tuple(sizes.setdefault(dim, n) for dim, n in zip(spec.dims, values.shape, strict=False))
        if values.shape != expected or len(values.shape) != len(spec.dims):
            yield _Problem(spec.path, f"shape is {values.shape}, expected {expected} for {', '.join(spec.dims)}")


_SIZE_OF = {"point": "observer", "query": "queries"}
"""Dimensions whose size is the setting ``points`` of a stage."""


def _episode_problems(e: Episode, settings: Mapping[str, Any]) -> Iterator[_Problem]:
    for spec in SCHEMA:
        values = spec.of(e) if spec.dtype.startswith("float") else None
        if values is not None and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            yield _Problem(spec.path, f"not finite at step {row}" if spec.per_step else "not finite")
            return
    for check in _CHECKS:
        yield from check(e)
    if "expert" in settings and np.abs(e.action).max() > 1:
        yield _Problem("data/action", f"reaches {np.abs(e.action).max():.3g}; actions as executed lie in [-1, 1]")


def _teleports(e: Episode) -> Iterator[_Problem]:
    step = np.linalg.norm(e.flow[:-1], axis=-1)
    if step.size and step.max() > TELEPORT:
        t, m = np.unravel_index(step.argmax(), step.shape)
        yield _Problem(
            "data/tracks", f"point {m} jumps {step.max():.3f} m after step {t}; at most {TELEPORT} is possible"
        )


def _times(e: Episode) -> Iterator[_Problem]:
    if not (np.diff(e.time_s) > 0).all():
        yield _Problem("data/time", f"does not rise after step {int((np.diff(e.time_s) <= 0).argmax())}")


def _counts(e: Episode) -> Iterator[_Problem]:
    n = e.point_cloud.shape[1]
    if not ((e.point_count >= 1) & (e.point_count <= n)).all():
        yield _Problem("data/point_count", f"ranges from {e.point_count.min()} to {e.point_count.max()}, not 1 to {n}")


def _anchors(e: Episode) -> Iterator[_Problem]:
    gap = np.abs(np.linalg.norm(e.tracks.xyz_world[0] - e.queries.xyz_world, axis=-1) - e.tracks.association_distance)
    if gap.max() > 1e-4:
        yield _Problem(
            "data/tracks", f"point {gap.argmax()} starts {gap.max() * 1e3:.2f} mm from where it was anchored"
        )


def _off_surface(e: Episode) -> Iterator[_Problem]:
    """Visible points must lie on the cloud, as far as a sampled cloud can tell.

    A farthest-point sample leaves no point of its cloud farther away than its own least spacing, so a
    visible point, which is within a pixel of the cloud, is that near to the sample; unless it has left
    the crop, which the cloud's extent tells.
    """
    far = total = 0
    for t in range(0, len(e), 4):
        cloud = e.point_cloud[t, : e.point_count[t]]
        seen = e.tracks.xyz_world[t, e.tracks.visible[t]]
        seen = seen[((seen > cloud.min(0)) & (seen < cloud.max(0))).all(1)]
        if len(cloud) < 2 or len(seen) == 0:
            continue
        tree = cKDTree(cloud)
        spacing = np.asarray(tree.query(cloud, k=2)[0])[:, 1].min()
        distance = np.asarray(tree.query(seen)[0]) - e.tracks.association_distance.max()
        far, total = far + int((distance > spacing + OFF_SURFACE).sum()), total + len(seen)
    if far > OFF_SURFACE_SHARE * total:
        yield _Problem(
            "data/tracks", f"{far} of {total} visible points lie off the surface; the labels do not fit the cloud"
        )


_CHECKS: tuple[Callable[[Episode], Iterator[_Problem]], ...] = (_times, _teleports, _counts, _anchors, _off_surface)
