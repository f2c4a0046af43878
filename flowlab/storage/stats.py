"""Statistics of a dataset, gathered while it is written and merged without reading it again."""

from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from flowlab.geometry.moving import MOVING_IN_EPISODE_M, STILL_STEP_M
from flowlab.records import Episode, PositionSource, Quality

_BINS = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 241), [np.inf]])
"""Bins of step lengths [m], 40 to a decade: quantiles read off them are right to 6 %."""
_ROUNDING, _EDGE_SHARE = 1e-9, 1e-3
"""So much may the same statistics differ between machines: of sums, and of steps by the bin they fall into."""
_CHANNELS: dict[str, Callable[[Episode], np.ndarray | None]] = {
    "point_cloud": lambda e: e.point_cloud,
    "state": lambda e: e.state,
    "action": lambda e: e.action,
    "tracks": lambda e: e.tracks.xyz_world,
    "flow": lambda e: e.flow[:-1],
    "object_pose": lambda e: e.object_pose,
}

_Count = Annotated[int, Field(ge=0, lt=1 << 53)]
_Histogram = Annotated[list[_Count], Field(min_length=len(_BINS) - 1, max_length=len(_BINS) - 1)]


class Moments(TypedDict):
    """Limits, mean and sum of squared deviations of every channel of an array."""

    count: _Count
    min: list[float]
    max: list[float]
    mean: list[float]
    m2: list[float]


class QualitySums(TypedDict):
    """Of estimated tracks: histograms of stated errors [m], and how many positions come from each source."""

    sigma: _Histogram
    sigma_visible: _Histogram
    source: Annotated[list[_Count], Field(min_length=len(PositionSource), max_length=len(PositionSource))]


class MergeableStats(TypedDict, total=False):
    """Mergeable statistics of some episodes, as JSON values; of none it is empty."""

    episodes: _Count
    frames: _Count
    points: _Count
    moving_points: _Count
    steps: _Histogram
    """Of the lengths of the points' steps [m]."""
    arrays: dict[str, Moments]
    quality: QualitySums


_COUNTS: tuple[Literal["episodes", "frames", "moving_points", "points"], ...] = (
    "episodes", "frames", "moving_points", "points",
)  # fmt: skip


def summarize(episodes: Iterable[Episode]) -> MergeableStats:
    """The mergeable statistics of some episodes."""
    return merge(_of_episode(e) for e in episodes)


def merge(parts: Iterable[MergeableStats]) -> MergeableStats:
    """The statistics of several sets of episodes together (Chan et al.'s pairwise update)."""
    arrays: dict[str, Moments] = {}
    steps = np.zeros(len(_BINS) - 1, np.int64)
    total: MergeableStats = {"episodes": 0, "frames": 0, "moving_points": 0, "points": 0, "arrays": arrays}
    for part in parts:
        for count in _COUNTS:
            total[count] += part[count]
        steps += part["steps"]
        for name, new in part["arrays"].items():
            arrays[name] = _merge_moments(arrays[name], new) if name in arrays else new
        if "quality" in part:
            total["quality"] = _merge_sums(total["quality"], part["quality"]) if "quality" in total else part["quality"]
    return total | {"steps": steps.tolist()}


def stats_problem(summary: MergeableStats) -> str:
    """What keeps a summary from being one of some episodes, in words; empty where nothing does."""
    if lacking := {"episodes", "frames", "points", "moving_points", "steps", "arrays"} - summary.keys():
        return f"lacks {', '.join(sorted(lacking))}"
    for name, m in summary["arrays"].items():
        if len({len(m["min"]), len(m["max"]), len(m["mean"]), len(m["m2"])}) != 1:
            return f"arrays.{name}: min, max, mean and m2 must be equally long"
    return ""


def differing_stats(told: MergeableStats, found: MergeableStats) -> str:
    """The first statistic in which two summaries of the same episodes differ by more than rounding, by its path; empty
    where they agree. Histograms may differ by a few steps that lie on the edge of a bin."""
    for count in _COUNTS:
        if told[count] != found[count]:
            return count
    sums = [("steps", told["steps"], found["steps"])]
    if told.keys() != found.keys() or told["arrays"].keys() != found["arrays"].keys():
        return "arrays"
    if "quality" in told:
        sums += [
            (f"quality.{k}", told["quality"][k], found["quality"][k]) for k in ("sigma", "sigma_visible", "source")
        ]
    for name, a, b in sums:
        if np.abs(np.subtract(a, b)).sum() > max(2, _EDGE_SHARE * sum(b)):
            return name
    for name, new in found["arrays"].items():
        old = told["arrays"][name]
        scale = np.abs(np.array([new["min"], new["max"]])).max(0) + 1e-12
        if old["count"] != new["count"] or len(old["mean"]) != len(new["mean"]):
            return f"arrays.{name}"
        for moment in ("min", "max", "mean", "m2"):
            limit = _ROUNDING * (scale if moment != "m2" else scale**2 * new["count"])
            if not (np.abs(np.subtract(old[moment], new[moment])) <= limit).all():
                return f"arrays.{name}.{moment}"
    return ""


def describe(summary: MergeableStats) -> dict[str, Any]:
    """What ``stats.json`` says: limits, mean and deviation per channel, and how much moves."""
    arrays = {
        name: {
            "count": m["count"],
            "min": m["min"],
            "max": m["max"],
            "mean": m["mean"],
            "std": np.sqrt(np.array(m["m2"]) / max(m["count"], 1)).tolist(),
        }
        for name, m in sorted(summary["arrays"].items())
    }
    steps = np.array(summary["steps"])
    still = int(steps[_BINS[1:] <= STILL_STEP_M].sum())
    motion = {
        "still_share": still / max(int(steps.sum()), 1),
        "moving_point_share": summary["moving_points"] / max(summary["points"], 1),
        "step_m": {f"p{q}": _quantile(steps, q / 100) for q in (50, 90, 95, 99)},
    }
    about = {"episodes": summary["episodes"], "frames": summary["frames"], "arrays": arrays, "motion": motion}
    return about | ({"quality": _describe_quality(summary["quality"])} if "quality" in summary else {})


def step_quantile(flows: Iterable[np.ndarray], q: float) -> float:
    """The length [m] that so large a share of all steps (T, M, 3) stays below, as :func:`describe` tells it."""
    return _quantile(np.sum([_count_steps(flow) for flow in flows], 0), q)


def _count_steps(flow: np.ndarray) -> np.ndarray:
    """How many steps are of what length."""
    return np.histogram(np.linalg.norm(flow, axis=-1), _BINS)[0]


def _of_episode(e: Episode) -> MergeableStats:
    traveled = np.linalg.norm(e.tracks.xyz_world - e.tracks.xyz_world[0], axis=-1).max(0)
    arrays = {name: take(e) for name, take in _CHANNELS.items()}
    summary: MergeableStats = {
        "episodes": 1,
        "frames": len(e),
        "points": traveled.size,
        "moving_points": int((traveled > MOVING_IN_EPISODE_M).sum()),
        "steps": _count_steps(e.flow[:-1]).tolist(),
        "arrays": {name: _moments(a) for name, a in arrays.items() if a is not None and a.size},
    }
    if e.tracks.quality is not None:
        summary["quality"] = _of_quality(e.tracks.quality, e.tracks.visible)
    return summary


def _of_quality(quality: Quality, visible: np.ndarray) -> QualitySums:
    """Sums over all points and steps: histograms of sigma, and positions by source."""
    return {
        "sigma": np.histogram(quality.sigma, _BINS)[0].tolist(),
        "sigma_visible": np.histogram(quality.sigma[visible], _BINS)[0].tolist(),
        "source": [int((quality.source == s).sum()) for s in PositionSource],
    }


def _merge_sums(a: QualitySums, b: QualitySums) -> QualitySums:
    return {
        "sigma": np.add(a["sigma"], b["sigma"]).tolist(),
        "sigma_visible": np.add(a["sigma_visible"], b["sigma_visible"]).tolist(),
        "source": np.add(a["source"], b["source"]).tolist(),
    }


def _describe_quality(sums: QualitySums) -> dict[str, Any]:
    """Quantiles of sigma [m], the share of visible positions, and the share that comes from each source."""
    sigma, visible, source = map(np.array, (sums["sigma"], sums["sigma_visible"], sums["source"]))
    total = max(int(sigma.sum()), 1)
    return {
        "sigma_m": {f"p{q}": _quantile(sigma, q / 100) for q in (50, 90, 95)},
        "visible_sigma_m": {f"p{q}": _quantile(visible, q / 100) for q in (50, 90, 95)},
        "visible_share": int(visible.sum()) / total,
        "source_share": {
            s.name.lower(): int(source[s]) / total for s in PositionSource if s is not PositionSource.SIMULATOR
        },
    }


def _moments(values: np.ndarray) -> Moments:
    """Count, limits, mean and sum of squared deviations of every channel (the last axis)."""
    channels = np.ascontiguousarray(values.reshape(-1, values.shape[-1]).T, np.float64)  # 20 times as fast as by rows
    mean = channels.mean(1)
    deviation = channels - mean[:, None]
    return {
        "count": channels.shape[1],
        "min": channels.min(1).tolist(),
        "max": channels.max(1).tolist(),
        "mean": mean.tolist(),
        "m2": np.einsum("cn,cn->c", deviation, deviation).tolist(),
    }


def _merge_moments(a: Moments, b: Moments) -> Moments:
    n = a["count"] + b["count"]
    delta = np.array(b["mean"]) - np.array(a["mean"])
    return {
        "count": n,
        "min": np.minimum(a["min"], b["min"]).tolist(),
        "max": np.maximum(a["max"], b["max"]).tolist(),
        "mean": (np.array(a["mean"]) + delta * b["count"] / n).tolist(),
        "m2": (np.array(a["m2"]) + np.array(b["m2"]) + delta**2 * a["count"] * b["count"] / n).tolist(),
    }


def _quantile(histogram: np.ndarray, q: float) -> float:
    """Upper edge of the bin that holds the quantile [m]."""
    if not histogram.sum():
        return 0.0
    k = int(np.searchsorted(np.cumsum(histogram), q * histogram.sum()))
    return float(_BINS[min(k + 1, len(_BINS) - 2)]) if k else 0.0
