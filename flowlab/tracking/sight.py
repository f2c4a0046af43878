"""Sight: why a sensor sees a point, or does not, by the depth that it reads there."""

import numba
import numpy as np
from jaxtyping import UInt8

from flowlab.records import Clip, Sight, Tracks3D

SEEN, COVERED, OUT_OF_VIEW = int(Sight.SEEN), int(Sight.COVERED), int(Sight.OUT_OF_VIEW)
NO_READING, SEEN_THROUGH = int(Sight.NO_READING), int(Sight.SEEN_THROUGH)


def sight_of(clip: Clip, tracks: Tracks3D) -> UInt8[np.ndarray, "T M"]:
    """The :class:`~flowlab.records.Sight` of every position.

    Args:
        clip: The pictures, depth [m] among them.
        tracks: Where the points are, and whether they count as visible: those have a reading or none.
    """
    xyz_cam = clip.to_camera(tracks.xyz_world.astype(np.float64))
    z = xyz_cam[..., 2]
    ahead = np.where(z > 0, z, 1.0)
    uv = xyz_cam[..., :2] / ahead[..., None] * np.diag(clip.camera.K)[:2] + clip.camera.K[:2, 2]
    return _sight(clip.depth, uv, z, tracks.visible)


@numba.njit(cache=True)
def _sight(depth, uv, z, visible) -> np.ndarray:  # type: ignore[no-untyped-def]
    """See :func:`sight_of`; pixels (T, M, 2), depths and visibility (T, M)."""
    height, width = depth.shape[1:]
    out = np.full(z.shape, OUT_OF_VIEW, np.uint8)
    for t in range(z.shape[0]):
        for k in range(z.shape[1]):
            inside = z[t, k] > 0 and -0.5 <= uv[t, k, 0] < width - 0.5 and -0.5 <= uv[t, k, 1] < height - 0.5
            if not (inside or visible[t, k]):
                continue
            i = min(max(int(np.rint(uv[t, k, 1])), 0), height - 1)
            j = min(max(int(np.rint(uv[t, k, 0])), 0), width - 1)
            around = depth[t, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
            read, nearer = 0, 0
            for d in around.flat:
                read += d > 0
                nearer += 0 < d < z[t, k]
            if read == 0:
                out[t, k] = NO_READING
            elif visible[t, k]:
                out[t, k] = SEEN
            else:
                out[t, k] = COVERED if 2 * nearer >= read else SEEN_THROUGH
    return out
