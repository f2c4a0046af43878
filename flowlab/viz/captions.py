"""What captions and info panels say of an episode."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool

from flowlab.geometry.moving import MOVING_IN_EPISODE_M
from flowlab.recordings.verdicts import stored_checks, worst_first
from flowlab.records import Episode, PositionSource, Role
from flowlab.text import cut, markdown
from flowlab.viz.stated_error import describe_shares


def caption(episode: Episode, shown: int) -> str:
    """An episode in one line; ``shown`` is how many of the moving points have their trails drawn."""
    T, moves = len(episode), int(moving(episode).sum())
    parts = [
        f"{episode.task}, seed {episode.seed}",
        f"{T} steps, {episode.time_s[-1]:.2f} s",
        f"{int(episode.point_count[0])} cloud points",
        f"{episode.queries.count} query points",
        f"{moves} of them move" + (f" ({shown} shown)" if shown < moves else ""),
        _ending(episode),
    ]
    return "   ·   ".join(parts)


def _ending(episode: Episode) -> str:
    """When an episode was solved; of a recording, who made its tracks and how sure they are."""
    if episode.tracks.quality is not None:  # of a recording, which nobody needs to tell whether it succeeded
        return f"tracker {cut(tracker_name(episode), 40)}: {sigma_summary(episode)}"
    solved = f"solved at step {int(episode.success.argmax())}" if episode.success.any() else "not solved"
    return f"{solved}   ·   exact tracks"


def sigma_summary(episode: Episode, t: int | slice = slice(None)) -> str:
    """Median and 90th percentile of the stated errors, of a step or of all; needs ``tracks.quality``."""
    assert episode.tracks.quality is not None
    median, p90 = np.percentile(1000 * episode.tracks.quality.sigma[t, : episode.queries.count], [50, 90])
    return f"σ median {median:.0f} mm, p90 {p90:.0f} mm"


def tracker_name(episode: Episode) -> str:
    """Which tracker labeled the episode; empty for exact tracks."""
    return "" if episode.tracks.quality is None else str(_about_tracker(episode).get("tracker", "not known"))


def _about_tracker(episode: Episode) -> Mapping[str, Any]:
    """What :meth:`flowlab.tracking.base.Tracker.describe` said, as far as it was kept."""
    about = episode.extras.get("tracker")
    return about if isinstance(about, Mapping) else {}


def _path(episode: Episode) -> str:
    """How far a camera that moves goes, in words."""
    if episode.T_world_cam is None:
        return ""
    steps = np.linalg.norm(np.diff(episode.T_world_cam[:, :3, 3], axis=0), axis=1)
    return f" at first; it moves by {steps.sum():.2f} m in all"


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
        "camera position": f"{np.round(camera.T_world_cam[:3, 3], 3).tolist()} m{_path(episode)}",
    }
    if "source" in episode.extras:
        rows["recording"] = episode.extras["source"]
    rows |= _describe_quality(episode)
    lines = [f"| {key} | {markdown(str(value))} |" for key, value in rows.items()]
    return "\n".join([lines[0], "|---|---|", *lines[1:]])


def describe_checks(episode: Episode) -> str:
    """What was found when the recording of an episode was checked, the worst first, as a Markdown table.

    Returns:
        The table, or a sentence where nothing was checked; empty for episodes that were not recorded.
    """
    if "reader" not in episode.extras:
        return ""
    checks = stored_checks(episode.extras)
    if checks is None:
        return "The recording was not checked: it was labeled by an earlier flowlab."
    lines = [f"| {c.verdict} | {markdown(c.about)} | {markdown(c.says)} |" for c in worst_first(checks)]
    return "\n".join(["| verdict | about | what was found |", "|---|---|---|", *lines])


def _describe_quality(episode: Episode) -> dict[str, str]:
    """What is known of the error of estimated tracks; nothing for exact ones."""
    quality, count = episode.tracks.quality, episode.queries.count
    if quality is None:
        return {}
    source, shares = np.unique(quality.source[:, :count], return_counts=True)
    shares = shares / shares.sum()
    return {
        "tracker": tracker_name(episode),
        "its license": str(_about_tracker(episode).get("license", "not known")),
        "positions": ", ".join(
            f"{n:.0%} {PositionSource(s).name.lower()}" for s, n in zip(source, shares, strict=True)
        ),
        "stated error": sigma_summary(episode),
        "stated below": describe_shares(quality.sigma[:, :count]),
        "color of tracks": "class of the stated error σ: turquoise below 5 mm, yellow 10, orange 20, red 50, purple "
        "from there on; dark where out of sight",
    }


def moving(episode: Episode) -> Bool[np.ndarray, "M"]:
    """Which distinct query points ever get :data:`MOVING_IN_EPISODE_M` away from where they were first; of estimated
    tracks, beyond twice their stated errors."""
    quality, count = episode.tracks.quality, episode.queries.count
    xyz_world = episode.tracks.xyz_world[:, :count]
    doubt = 0.0 if quality is None else 2 * np.hypot(quality.sigma[:, :count], quality.sigma[0, :count])
    far: np.ndarray = (np.linalg.norm(xyz_world - xyz_world[0], axis=-1) - doubt).max(0) > MOVING_IN_EPISODE_M
    return far


def role_name(role: int) -> str:
    """What people call a role; -1 is the role of a point whose owner is not known."""
    return Role(role).name.lower() if role >= 0 else "unknown"
