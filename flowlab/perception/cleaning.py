"""Clearing the cloud of a real scene of its table and of stray points."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from pydantic import BeforeValidator, Field

from flowlab.config import Settings
from flowlab.errors import MissingLibraryError

SWITCH = BeforeValidator(lambda value: {True: {}, False: None}[value] if isinstance(value, bool) else value)
"""Lets a group of settings that is off by default be turned on with ``true``."""


class TableSettings(Settings):
    """The table is the largest plane in the crop, found anew in every frame."""

    distance_m: float = Field(default=0.01, gt=0)
    """Points up to this far above the plane [m] still belong to it."""
    min_share: float = Field(default=0.15, ge=0, le=1)
    """A plane that holds less than this share of the points is no table, and nothing is removed."""
    trials: int = Field(default=500, gt=0)
    """Planes tried (RANSAC)."""
    seed: int = Field(default=0, ge=0)
    """Of the trials: the same cloud always gives the same plane."""


class OutlierSettings(Settings):
    """A stray point is farther from its neighbors than is usual in its cloud."""

    neighbors: int = Field(default=20, gt=0)
    """Nearest neighbors whose mean distance is looked at."""
    std_ratio: float = Field(default=2.0, gt=0)
    """How many standard deviations that may lie above the cloud's mean."""


def above_table(
    xyz_world: Float[np.ndarray, "P 3"], eye_world: Float[np.ndarray, "3"], settings: TableSettings
) -> Bool[np.ndarray, "P"]:
    """Which points lie above the largest plane: on the camera's side of it, and not in it."""
    everything = np.ones(len(xyz_world), bool)
    if len(xyz_world) < 3:
        return everything
    open3d = _open3d()
    open3d.utility.random.seed(settings.seed)
    (*normal, offset), inside = _cloud(xyz_world).segment_plane(settings.distance_m, 3, settings.trials)
    if len(inside) < settings.min_share * len(xyz_world):
        return everything
    height = xyz_world @ np.array(normal) + offset
    return height * np.sign(eye_world @ np.array(normal) + offset) > settings.distance_m


def not_stray(xyz_world: Float[np.ndarray, "P 3"], settings: OutlierSettings) -> Bool[np.ndarray, "P"]:
    """Which points are not stray."""
    kept = np.zeros(len(xyz_world), bool)
    if len(xyz_world):
        kept[_cloud(xyz_world).remove_statistical_outlier(settings.neighbors, settings.std_ratio)[1]] = True
    return kept


def _cloud(xyz_world: np.ndarray) -> Any:
    open3d = _open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz_world.astype(np.float64)))


def _open3d() -> Any:
    """The library, which takes a second to import, and which most clouds do without."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"removing tables and stray points needs Open3D, which cannot be loaded ({error}); install what it asks "
            "for with 'apt-get install libusb-1.0-0', or set observer.remove_table and observer.remove_outliers to null"
        ) from error
    return open3d
