"""Clearing the cloud of a real scene of its table and of outliers."""

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
    """An outlier is farther from its neighbors than is usual in its cloud."""

    neighbors: int = Field(default=20, gt=0)
    """Nearest neighbors whose mean distance is looked at."""
    std_ratio: float = Field(default=2.0, gt=0)
    """How many standard deviations that may lie above the cloud's mean."""


def table_mask(
    xyz_world: Float[np.ndarray, "P 3"], eye_world: Float[np.ndarray, "3"], settings: TableSettings
) -> Bool[np.ndarray, "P"]:
    """Which points belong to the largest plane, or lie behind it as the camera sees it.

    Args:
        xyz_world: The cloud [m].
        eye_world: Where the camera is [m]; points on its side of the plane are above the table.
        settings: How a plane is found, and what belongs to it.

    Returns:
        True where a point is the table or below it; nowhere, if no plane holds enough points to be a table.

    Raises:
        MissingLibraryError: Open3D cannot be loaded.
    """
    nothing = np.zeros(len(xyz_world), bool)
    if len(xyz_world) < 3:
        return nothing
    open3d = _open3d()
    open3d.utility.random.seed(settings.seed)
    (*normal, offset), inside = _cloud(xyz_world).segment_plane(settings.distance_m, 3, settings.trials)
    if len(inside) < settings.min_share * len(xyz_world):
        return nothing
    height = xyz_world @ np.array(normal) + offset
    return ~(height * np.sign(eye_world @ np.array(normal) + offset) > settings.distance_m)


def outlier_mask(xyz_world: Float[np.ndarray, "P 3"], settings: OutlierSettings) -> Bool[np.ndarray, "P"]:
    """Which points are outliers: farther from their neighbors than is usual in their cloud.

    Args:
        xyz_world: The cloud [m].
        settings: How many neighbors, and how far is unusual.

    Raises:
        MissingLibraryError: Open3D cannot be loaded.
    """
    outlier = np.ones(len(xyz_world), bool)
    if len(xyz_world):
        outlier[_cloud(xyz_world).remove_statistical_outlier(settings.neighbors, settings.std_ratio)[1]] = False
    return outlier


def _cloud(xyz_world: np.ndarray) -> Any:
    """Points as Open3D's cloud."""
    open3d = _open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz_world.astype(np.float64)))


def _open3d() -> Any:
    """The library, which takes a second to import, and which most clouds do without."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"removing tables and outliers needs Open3D, which cannot be loaded ({error}); install what it asks "
            "for with 'apt-get install libusb-1.0-0', or set observer.remove_table and observer.remove_outliers to null"
        ) from error
    return open3d
