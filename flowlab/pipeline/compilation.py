"""Whether labeling begins by compiling its kernels, as it does once on a machine: users are told why they wait."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from flowlab.pipeline.recipe import Recipe
from flowlab.pipeline.stages.recording import TrackStage

NOTICE = (
    "the first labeling on this machine compiles flowlab's kernels, which takes from some seconds to about a minute "
    "and is kept for all later ones"
)
_ALWAYS = ("perception.point_cloud:unproject_and_crop", "geometry.sampling:_farthest", "tracking.lifting:_read")
"""A kernel of each module that every labeling uses."""
_OF_TRACKERS = {
    "rigid-bodies": tuple(
        f"tracking.trackers.rigid_bodies.{name}"
        for name in (
            "_absolute_orientation:fit_rigid",
            "_costs:motion_costs",
            "_energies:energies",
            "_gauss_newton:align",
            "_surfaces:aggregate",
        )
    )
}


def will_compile(recipe: Recipe) -> bool:
    """Whether some kernel that labeling needs is not in Numba's cache on this machine, or is older than its source."""
    return any(not _is_cached(kernel) for kernel in _kernels(recipe))


def _kernels(recipe: Recipe) -> Iterator[Any]:
    trackers = [s.tracker for s in recipe.stages if isinstance(s, TrackStage)]
    for place in (*_ALWAYS, *(place for tracker in trackers for place in _OF_TRACKERS.get(tracker, ()))):
        module, name = place.split(":")
        yield getattr(import_module(f"flowlab.{module}"), name)


def _is_cached(kernel: Any) -> bool:
    """Whether Numba has compiled a kernel from its source as it is; one that is not compiled at all has no wait."""
    stats = getattr(kernel, "stats", None)
    if stats is None or stats.cache_path is None:  # with NUMBA_DISABLE_JIT
        return stats is None
    source = Path(inspect.getfile(kernel.py_func))
    indices = Path(stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in indices)
