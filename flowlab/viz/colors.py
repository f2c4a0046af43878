"""The colors that recordings, stills and videos share: tracks loud, by role or by stated error; clouds quiet."""

import numpy as np
from jaxtyping import Float, Int, UInt8

from flowlab.records import Episode, Role
from flowlab.viz.stated_error import sigma_rgb, stated_sigma

UNKNOWN = -1
"""Stands for the role of a point whose owner is not known."""
ROLE_RGB = {
    Role.BACKGROUND: (138, 143, 152),
    Role.ROBOT: (62, 134, 214),
    Role.OBJECT: (240, 134, 50),
    Role.PROP: (70, 172, 120),
    Role.MARKER: (214, 78, 140),
    UNKNOWN: (163, 130, 200),
}
"""sRGB of each role; told apart by people who confuse red with green, too."""
SERIES_RGB = [
    (94, 160, 230), (245, 156, 80), (108, 196, 150), (230, 112, 162), (178, 150, 218), (222, 200, 90),
    (110, 205, 215), (226, 112, 98), (170, 178, 188),
]  # fmt: skip
"""Lines of one plot, in turn."""
SUCCESS_RGB = (255, 255, 255)
PREDICTED_RGB = (232, 255, 84)
"""What a policy predicts: brighter than any role, and than clouds."""
_PALETTE = np.array([ROLE_RGB[role] for role in (*Role, UNKNOWN)], np.uint8)  # so that -1 finds the last
_CLOUD_GRAY = np.array([150, 154, 160])


def role_rgb(role: Int[np.ndarray, "*batch"]) -> UInt8[np.ndarray, "*batch 3"]:
    """The color of each role."""
    colors: np.ndarray = _PALETTE[role]
    return colors


def track_rgb(episode: Episode) -> UInt8[np.ndarray, "T M 3"]:
    """The color of every distinct query point at every step: by stated error where there is one, else by role."""
    M, sigma = episode.queries.count, stated_sigma(episode)
    if sigma is not None:
        return sigma_rgb(sigma)
    return np.broadcast_to(role_rgb(episode.query_role[:M]), (len(episode), M, 3))


def cloud_rgb(role: Int[np.ndarray, "*batch"], tint: float = 0.35) -> UInt8[np.ndarray, "*batch 3"]:
    """Gray with a share ``tint`` of the role's color; plain gray where the role is not known."""
    known = (role != UNKNOWN)[..., None]
    return np.where(known, (1 - tint) * _CLOUD_GRAY + tint * role_rgb(role), _CLOUD_GRAY).astype(np.uint8)


def cloud_rgb_at(episode: Episode, t: int) -> UInt8[np.ndarray, "P 3"]:
    """The color of every distinct cloud point of step t: by role, or from the color picture where nobody
    knows what any point lies on."""
    points = episode.point_cloud[t, : episode.point_count[t]]
    if episode.rgb is None or (episode.query_role != UNKNOWN).any():
        return cloud_rgb(cloud_role(episode, t))
    uv, z = episode.camera_at(t).project(points)
    u, v = np.round(np.where(z[:, None] > 0, uv, -1)).clip(-1, np.shape(episode.rgb)[2:0:-1]).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < episode.rgb.shape[2]) & (v < episode.rgb.shape[1])
    rgb = np.tile(_CLOUD_GRAY.astype(np.uint8), (len(points), 1))
    rgb[inside] = episode.rgb[t, v[inside], u[inside]]
    return rgb


def cloud_role(episode: Episode, t: int) -> Int[np.ndarray, "P"]:
    """A guess at the role of every distinct cloud point of step t, for tinting: that of the nearest track
    point. Unknown where none is near, as where only the object is tracked."""
    points = episode.point_cloud[t, : episode.point_count[t]]
    count = episode.queries.count
    marks = episode.tracks.xyz_world[t, :count]
    if len(points) == 0 or count < 2:
        return np.full(len(points), UNKNOWN)
    distance, nearest = _nearest(points, marks)
    return np.where(distance <= _reach(episode), episode.query_role[:count][nearest], UNKNOWN)


def _reach(episode: Episode) -> float:
    """How far around it [m] a track point speaks for the cloud: twice the spacing of the query points."""
    xyz_world = episode.queries.xyz_world[: episode.queries.count]
    others = np.linalg.norm(xyz_world[:, None] - xyz_world, axis=-1)
    np.fill_diagonal(others, np.inf)
    return 2 * float(np.median(others.min(1)))


def _nearest(
    points: Float[np.ndarray, "P 3"], marks: Float[np.ndarray, "M 3"]
) -> tuple[Float[np.ndarray, "P"], Int[np.ndarray, "P"]]:
    """How far each point is from the nearest mark [m], and which that is; to import a tree of SciPy takes longer."""
    nearest = ((marks**2).sum(-1) - 2 * points @ marks.T).argmin(1)
    return np.linalg.norm(points - marks[nearest], axis=-1), nearest
