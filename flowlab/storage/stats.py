"""Statistics of a dataset, gathered while it is written and merged without reading it again."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from flowlab.geometry.moving import MOVING_IN_EPISODE_M, STILL_STEP_M
from flowlab.records import Episode, PositionSource, Quality

_BINS = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 241), [np.inf]])
"""Bins of step lengths [m], 40 to a decade: quantiles read off them are right to 6 %."""
_CHANNELS: dict[str, Callable[[Episode], np.ndarray | None]] = {
    "point_cloud": lambda e: e.point_cloud,
    "state": lambda e: e.state,
    "action": lambda e: e.action,
    "tracks": lambda e: e.tracks.xyz_world,
    "flow": lambda e: e.flow[:-1],
    "object_pose": lambda e: e.object_pose,
}

Summary = dict[str, Any]
"""JSON values. ``arrays`` maps a name to count, min, max, mean and m2 per channel; ``steps`` holds the
histogram of step lengths, ``quality`` (of estimated tracks only) that of stated errors and how many positions
come from where; further numbers are sums."""


def summarize(episodes: Iterable[Episode]) -> Summary:
    """The mergeable statistics of some episodes."""
    return merge(_of_episode(e) for e in episodes)


def merge(parts: Iterable[Summary]) -> Summary:
    """The statistics of several sets of episodes together (Chan et al.'s pairwise update)."""
    total: Summary = {
        "episodes": 0, "frames": 0, "moving_points": 0, "points": 0, "arrays": {},
        "steps": np.zeros(len(_BINS) - 1, np.int64),
    }  # fmt: skip
    for part in parts:
        for name in ("episodes", "frames", "moving_points", "points"):
            total[name] += part[name]
        total["steps"] = total["steps"] + np.asarray(part["steps"])
        for name, new in part["arrays"].items():
            old = total["arrays"].get(name)
            total["arrays"][name] = new if old is None else _merge_moments(old, new)
        if "quality" in part:
            total["quality"] = _merge_sums(total.get("quality", {}), part["quality"])
    total["steps"] = total["steps"].tolist()
    return total


def describe(summary: Summary) -> dict[str, Any]:
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


def _of_episode(e: Episode) -> Summary:
    traveled = np.linalg.norm(e.tracks.xyz_world - e.tracks.xyz_world[0], axis=-1).max(0)
    arrays = {name: take(e) for name, take in _CHANNELS.items()}
    quality = {} if e.tracks.quality is None else {"quality": _of_quality(e.tracks.quality, e.tracks.visible)}
    return quality | {
        "episodes": 1,
        "frames": len(e),
        "points": traveled.size,
        "moving_points": int((traveled > MOVING_IN_EPISODE_M).sum()),
        "steps": _count_steps(e.flow[:-1]).tolist(),
        "arrays": {name: _moments(a) for name, a in arrays.items() if a is not None and a.size},
    }


def _of_quality(quality: Quality, visible: np.ndarray) -> dict[str, list[int]]:
    """Sums over all points and steps: histograms of sigma, and positions by source."""
    return {
        "sigma": np.histogram(quality.sigma, _BINS)[0].tolist(),
        "sigma_visible": np.histogram(quality.sigma[visible], _BINS)[0].tolist(),
        "source": [int((quality.source == s).sum()) for s in PositionSource],
    }


def _merge_sums(a: Mapping[str, list[int]], b: Mapping[str, list[int]]) -> dict[str, list[int]]:
    return {name: np.add(a.get(name, 0), values).tolist() for name, values in b.items()}


def _describe_quality(sums: Mapping[str, list[int]]) -> dict[str, Any]:
    """Quantiles of sigma [m], the share of visible positions, and the share that comes from each source."""
    sigma, visible, source = (np.array(sums[name]) for name in ("sigma", "sigma_visible", "source"))
    total = max(int(sigma.sum()), 1)
    return {
        "sigma_m": {f"p{q}": _quantile(sigma, q / 100) for q in (50, 90, 95)},
        "visible_sigma_m": {f"p{q}": _quantile(visible, q / 100) for q in (50, 90, 95)},
        "visible_share": int(visible.sum()) / total,
        "source_share": {
            s.name.lower(): int(source[s]) / total for s in PositionSource if s is not PositionSource.SIMULATOR
        },
    }


def _moments(values: np.ndarray) -> dict[str, Any]:
    """Count, limits, mean and sum of squared deviations of every channel (the last axis)."""
    rows = values.reshape(-1, values.shape[-1]).astype(np.float64)
    mean = rows.mean(0)
    return {
        "count": len(rows),
        "min": rows.min(0).tolist(),
        "max": rows.max(0).tolist(),
        "mean": mean.tolist(),
        "m2": ((rows - mean) ** 2).sum(0).tolist(),
    }


def _merge_moments(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
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
