"""What a dataset holds and what making it took, in totals."""

from dataclasses import dataclass

from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import unit_shard
from flowlab.storage.receipts import StageTally
from flowlab.storage.stored_array import StoredArray


@dataclass(frozen=True, slots=True)
class TaskTotals:
    """What there is of one task."""

    task: str
    episodes: int
    requested: int
    frames: int
    rejected: int
    """Seeds or recordings that were kept out."""


@dataclass(frozen=True, slots=True)
class StageTotals:
    """What one stage did, over all runs."""

    stage: str
    calls: int
    cpu_s: float
    cpu_ms_per_frame: float
    """By the frames that the dataset holds."""
    rejects: int


@dataclass(frozen=True, slots=True)
class LeftOutFrame:
    """A frame of a recording that was left out as bad."""

    recording: str
    """Its path."""
    frame: str
    reason: str


@dataclass(frozen=True, slots=True)
class ListedEpisode:
    """An episode by its number."""

    episode: int
    """Position in the dataset, from 0: what ``flowlab viz --episode`` takes."""
    task: str
    seed: int
    frames: int
    recording: str
    """Path of the recording; empty for simulation."""


@dataclass(frozen=True, slots=True)
class DatasetOverview:
    """What a dataset holds and how it was made."""

    episodes: int
    frames: int
    megabytes: float
    """On disk, all files together."""
    tasks: tuple[TaskTotals, ...]
    stages: tuple[StageTotals, ...]
    arrays: tuple[StoredArray, ...]
    """Of the first shard; empty where there is none yet."""


def dataset_overview(dataset: Dataset) -> DatasetOverview:
    """A dataset in totals. Raises :class:`DataError` where its first shard is missing or damaged."""
    first = next((r for r in dataset.receipts if dataset.refs and r.shard == dataset.refs[0].shard), None)
    arrays = unit_shard(dataset.path, first).describe() if first is not None else []
    size = sum(f.stat().st_size for f in dataset.path.rglob("*") if f.is_file())
    return DatasetOverview(
        episodes=len(dataset),
        frames=frame_count(dataset),
        megabytes=round(size / 1e6, 2),
        tasks=task_totals(dataset),
        stages=stage_totals(dataset),
        arrays=tuple(arrays),
    )


def frame_count(dataset: Dataset) -> int:
    """Frames of all episodes."""
    return sum(ref.frames for ref in dataset.refs)


def task_totals(dataset: Dataset) -> tuple[TaskTotals, ...]:
    """Episodes, frames and rejected seeds of every task."""
    totals = []
    for task, wanted in dataset.manifest.requested.items():
        mine = [r for r in dataset.receipts if r.task == task]
        accepted, frames = sum(len(r.accepted) for r in mine), sum(sum(r.frames) for r in mine)
        totals.append(TaskTotals(task, accepted, wanted, frames, sum(len(r.rejects) for r in mine)))
    return tuple(totals)


def list_episodes(dataset: Dataset) -> tuple[ListedEpisode, ...]:
    """All episodes in order, with their numbers."""
    source = {(r.task, r.seed): r.source for r in dataset.manifest.recordings}
    return tuple(
        ListedEpisode(k, ref.task, ref.seed, ref.frames, source.get((ref.task, ref.seed), ""))
        for k, ref in enumerate(dataset.refs)
    )


def stage_totals(dataset: Dataset) -> tuple[StageTotals, ...]:
    """Calls, CPU time and rejects of every stage, in their order."""
    total: dict[str, StageTally] = {}
    for receipt in dataset.receipts:
        for name, tally in receipt.stages.items():
            total[name] = total.get(name, StageTally()).plus(tally)
    frames = max(frame_count(dataset), 1)
    return tuple(
        StageTotals(name, t.calls, round(t.cpu_s, 3), round(t.cpu_s / frames * 1e3, 3), t.rejects)
        for name in dataset.manifest.settings
        if (t := total.get(name)) is not None
    )


def left_out_frames(dataset: Dataset) -> tuple[LeftOutFrame, ...]:
    """The frames of recordings that were left out as bad."""
    source = {(r.task, r.seed): r.source for r in dataset.manifest.recordings}
    if not source:
        return ()
    told: dict[tuple[str, int], list[tuple[str, str]]] = {}
    for receipt in dataset.receipts:
        shard = unit_shard(dataset.path, receipt) if receipt.accepted else None
        for k, seed in enumerate(receipt.accepted):
            told[receipt.task, seed] = shard.about(k).get("bad_frames", []) if shard is not None else []
    return tuple(LeftOutFrame(source.get(key, ""), name, reason) for key in sorted(told) for name, reason in told[key])
