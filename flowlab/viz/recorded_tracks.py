"""Tracks and their stated errors in a Rerun recording."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
from jaxtyping import Bool, UInt8

from flowlab.records import Episode
from flowlab.viz.blueprint import scene_size
from flowlab.viz.colors import track_rgb
from flowlab.viz.stated_error import MOST_DRAWN_M, is_coarse, sigma_rgb, stated_sigma

TRAIL_STEPS = 20
"""A trail shows where a point was over this many steps."""
_STILL_M = 1e-3
"""A point that moves less than this over a whole trail [m] gets none."""
_HIDDEN_LIGHT = 0.4
"""Brightness of what the camera does not see, against 1 for what it sees."""


def time_columns(episode: Episode, steps: Sequence[int] | None = None) -> list[rr.TimeColumn]:
    """The columns of some steps, or of all."""
    rows = np.arange(len(episode)) if steps is None else np.array(steps)
    return [rr.TimeColumn("step", sequence=rows), rr.TimeColumn("time", duration=episode.time_s[rows])]


def send_tracks(recording: rr.RecordingStream, episode: Episode) -> None:
    """The query points of every step, and their trails."""
    T, M = len(episode), episode.queries.count
    xyz_world = episode.tracks.xyz_world[:, :M]
    rgb = _shaded(track_rgb(episode), episode.tracks.visible[:, :M])
    columns = rr.Points3D.columns(positions=xyz_world.reshape(-1, 3), colors=rgb.reshape(-1, 3))
    recording.send_columns("/world/tracks/points", time_columns(episode), columns.partition([M] * T))
    recording.log("/world/tracks/points", rr.Points3D.from_fields(radii=0.005 * scene_size(episode)), static=True)

    windows = [xyz_world[max(0, t - TRAIL_STEPS) : t + 1] for t in range(T)]
    moved = np.array([np.linalg.norm(np.ptp(w, axis=0), axis=-1) > _STILL_M for w in windows])
    strips = [w[:, k] for w, moving in zip(windows, moved, strict=True) for k in np.flatnonzero(moving)]
    lines = rr.LineStrips3D.columns(strips=strips, colors=rgb[moved])
    recording.send_columns("/world/tracks/trails", time_columns(episode), lines.partition(moved.sum(1)))
    recording.log("/world/tracks/trails", rr.LineStrips3D.from_fields(radii=0.0012 * scene_size(episode)), static=True)


def send_errors(recording: rr.RecordingStream, episode: Episode) -> None:
    """Spheres of the radius of the stated errors that are large, around their points."""
    sigma = stated_sigma(episode)
    if sigma is None or not (large := np.isfinite(sigma) & is_coarse(sigma)).any():
        return
    centers, radius = episode.tracks.xyz_world[:, : episode.queries.count][large], sigma[large]
    spheres = rr.Ellipsoids3D.columns(
        centers=centers, half_sizes=np.repeat(np.minimum(radius, MOST_DRAWN_M)[:, None], 3, 1), colors=sigma_rgb(radius)
    )
    recording.send_columns("/world/tracks/errors", time_columns(episode), spheres.partition(large.sum(1)))
    style = rr.Ellipsoids3D.from_fields(fill_mode="majorwireframe", line_radii=0.0004 * scene_size(episode))
    recording.log("/world/tracks/errors", style, static=True)


def _shaded(rgb: UInt8[np.ndarray, "T M 3"], visible: Bool[np.ndarray, "T M"]) -> UInt8[np.ndarray, "T M 3"]:
    """The colors at every step, darker where the camera does not see the point."""
    return (rgb * np.where(visible, 1.0, _HIDDEN_LIGHT)[..., None]).astype(np.uint8)
