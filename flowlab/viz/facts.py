"""What captions and info panels say of an episode."""

import numpy as np
from jaxtyping import Bool

from flowlab.records import Episode, Role

MOVING_M = 0.01
"""A query point moves if it ever gets this far from where it was first [m]."""


def caption(episode: Episode, shown: int) -> str:
    """An episode in one line; ``shown`` is how many of the moving points have their trails drawn."""
    T, moves = len(episode), int(moving(episode).sum())
    facts = [
        f"{episode.task}, seed {episode.seed}",
        f"{T} steps, {episode.time_s[-1]:.2f} s",
        f"{int(episode.point_count[0])} cloud points",
        f"{episode.queries.count} query points",
        f"{moves} of them move" + (f" ({shown} shown)" if shown < moves else ""),
        f"solved at step {int(episode.success.argmax())}" if episode.success.any() else "not solved",
    ]
    return "   ·   ".join(facts)


def describe(episode: Episode) -> str:
    """The facts of an episode as a Markdown table."""
    roles, counts = np.unique(episode.query_role[: episode.queries.count], return_counts=True)
    camera, solved = episode.camera, int(episode.success.sum())
    rows = {
        "task": episode.task,
        "seed": episode.seed,
        "frames": f"{len(episode)} ({episode.time_s[-1]:.2f} s)",
        "success": f"{solved} steps, first at {int(episode.success.argmax())}" if solved else "never",
        "cloud points": " to ".join(map(str, np.unique([episode.point_count.min(), episode.point_count.max()]))),
        "query points": ", ".join(f"{n} {role_name(r)}" for r, n in zip(roles, counts, strict=True)),
        "visible": f"{episode.tracks.visible[:, : episode.queries.count].mean():.0%} of all track points",
        "camera": f"{camera.width} x {camera.height} px, f = {camera.K[0, 0]:.1f} px",
        "camera position": f"{np.round(camera.T_world_cam[:3, 3], 3).tolist()} m",
    }
    lines = [f"| {key} | {value} |" for key, value in rows.items()]
    return "\n".join([lines[0], "|---|---|", *lines[1:]])


def moving(episode: Episode) -> Bool[np.ndarray, "M"]:
    """Which distinct query points ever get :data:`MOVING_M` away from where they were first."""
    xyz_world = episode.tracks.xyz_world[:, : episode.queries.count]
    far: np.ndarray = np.linalg.norm(xyz_world - xyz_world[0], axis=-1).max(0) > MOVING_M
    return far


def role_name(role: int) -> str:
    """What people call a role; -1 is the role of a point whose owner is not known."""
    return Role(role).name.lower() if role >= 0 else "unknown"
