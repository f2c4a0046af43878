"""Which points to follow."""

import math
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float32
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import DataError
from flowlab.geometry.sampling import farthest_points
from flowlab.perception.cleaning import SWITCH
from flowlab.perception.point_cloud import pad
from flowlab.records import Cloud, Queries, Role


class EdgeSettings(Settings):
    """Where a real camera's depth cannot be trusted: beside edges and holes of the depth picture.

    A pixel that sees two surfaces is read somewhere between them; farthest-point sampling prefers such points.
    """

    jump: float = Field(default=0.02, gt=0)
    """Neighboring readings that differ by more than this share of the nearer one have an edge between them."""
    margin_px: int = Field(default=2, ge=0)
    """Points up to this many rows and columns from an edge or a hole are not chosen."""


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
    avoid_edges: Annotated[EdgeSettings | None, SWITCH] = None
    """Choose no points near edges and holes of the depth picture; null does, which is right where depth is exact."""


def queries_in(cloud: Cloud, depth: Float32[np.ndarray, "H W"], settings: QuerySettings) -> Queries:
    """The points to follow from a frame on, given its cloud and its depth picture.

    Raises :class:`DataError` where there is none.
    """
    if settings.avoid_edges is not None:
        cloud = away_from_edges(cloud, depth, settings.avoid_edges)
    return sample_queries(cloud, settings)


def sample_queries(cloud: Cloud, settings: QuerySettings) -> Queries:
    """Choose query points from a cloud; ``scene`` is nested, its first m of M are its sample of m.

    Raises :class:`DataError` where the sampling needs owners the cloud lacks, or nothing is in view.
    """
    index = _choose(cloud, settings)
    if len(index) == 0:
        raise DataError(f"no point to follow: the first frame shows nothing for '{settings.sampling}' queries")
    owner = np.full(len(cloud.xyz_world), -1, np.int16) if cloud.owner is None else cloud.owner
    filled = pad(index, settings.points)
    return Queries(cloud.xyz_world[filled], owner[filled], len(index), cloud.entities, cloud.pixel[filled])


def away_from_edges(cloud: Cloud, depth: Float32[np.ndarray, "H W"], settings: EdgeSettings) -> Cloud:
    """The part of a frame's cloud that lies clear of the edges and holes of its depth picture.

    Raises :class:`DataError` where that is nothing.
    """
    kept = ~near_edges(depth, settings).reshape(-1)[cloud.pixel]
    if not kept.any():
        raise DataError(
            f"no point to follow: every point of the first frame lies within {settings.margin_px} pixels of an edge or "
            "a hole of the depth picture; lower queries.avoid_edges.margin_px or raise queries.avoid_edges.jump"
        )
    owner = None if cloud.owner is None else cloud.owner[kept]
    return replace(cloud, xyz_world=cloud.xyz_world[kept], pixel=cloud.pixel[kept], owner=owner)


def near_edges(depth: Float32[np.ndarray, "H W"], settings: EdgeSettings) -> Bool[np.ndarray, "H W"]:
    """Which pixels lie within the margin of an edge or a hole of a depth picture [m], 0 where there is no reading."""
    from scipy.ndimage import binary_dilation  # heavy, and a dry run does not need it

    edge = ~(depth > 0)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        nearer = np.minimum(depth[a], depth[b])
        apart = (nearer > 0) & (np.abs(depth[a] - depth[b]) > settings.jump * nearer)
        edge[a] |= apart
        edge[b] |= apart
    size = 2 * settings.margin_px + 1
    return binary_dilation(edge, np.ones((size, size), bool))


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
