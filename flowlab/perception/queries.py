"""Which points to follow."""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.geometry.sampling import farthest_points
from flowlab.perception.observer import pad
from flowlab.records import Cloud, Queries, Role


class QuerySettings(Settings):
    """How query points are chosen from the first cropped cloud."""

    points: int = Field(default=100, gt=0)
    """M. The paper uses 100 and ablates 50 and 200."""
    sampling: Literal["scene", "object", "stratified"] = "scene"
    """``scene``: farthest-point sample of everything (the paper's). ``object``: of what can move and is
    not the robot (the paper's ablation). ``stratified``: a guaranteed share of those, the rest from the
    scene around them."""
    object_share: float = Field(default=1 / 3, gt=0, lt=1)
    """The share ``stratified`` guarantees, as far as that many object points are in view."""


def sample_queries(cloud: Cloud, settings: QuerySettings) -> Queries:
    """Choose query points from a cloud; ``scene`` is nested, its first m of M are its sample of m.

    Raises :class:`DataError` where the sampling needs owners the cloud lacks, or nothing is in view.
    """
    index = _choose(cloud, settings)
    if len(index) == 0:
        raise DataError(f"no point to follow: the first frame shows nothing for '{settings.sampling}' queries")
    owner = np.full(len(cloud.xyz_world), -1, np.int16) if cloud.owner is None else cloud.owner
    filled = pad(index, settings.points)
    return Queries(cloud.xyz_world[filled], owner[filled], len(index), cloud.entities)


def _choose(cloud: Cloud, settings: QuerySettings) -> np.ndarray:
    if settings.sampling == "scene":
        return farthest_points(cloud.xyz_world, settings.points)
    movable = _object_points(cloud)
    wanted = settings.points if settings.sampling == "object" else math.ceil(settings.points * settings.object_share)
    chosen = movable[farthest_points(cloud.xyz_world[movable], wanted)]
    if settings.sampling == "object":
        return chosen
    rest = farthest_points(cloud.xyz_world, settings.points - len(chosen), chosen)
    return np.concatenate([chosen, rest])


def _object_points(cloud: Cloud) -> np.ndarray:
    """Indices of the points on things that can move and are not the robot."""
    if cloud.owner is None:
        raise DataError(
            "'object' and 'stratified' queries need to know what owns each point, which this source does not; "
            "use queries.sampling=scene"
        )
    roles = np.array([e.role for e in cloud.entities] + [-1])
    return np.flatnonzero(roles[cloud.owner] == Role.OBJECT)
