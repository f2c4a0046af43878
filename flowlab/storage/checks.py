"""What can be wrong with the content of an episode."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from flowlab.geometry.camera import pose_fault
from flowlab.provenance import Provenance
from flowlab.records import Episode, PositionSource, Sight
from flowlab.storage.schema import SCHEMA

TELEPORT = 0.15
"""A query point that moves more than this in one step [m] is wrong; the fastest of all 50 tasks, the
faucet's handle, moves half as far."""
OFF_SURFACE = 0.03
"""A visible point this much farther from the cloud [m] than the cloud is coarse lies on no surface."""
OFF_SURFACE_SHARE = 0.02
"""Share of an episode's visible points that may do so: pixels at silhouettes show what is behind."""
LOOKED_AT = 8
"""Every so many frames it is looked whether points lie on the surface: labels that do not fit do not for one frame."""
FASTEST = 3.0
"""An estimated point that is faster than this [m/s], and jumps farther than its stated errors explain, is wrong."""
JUMPING_SHARE = 0.01
"""Share of an episode's estimated steps that may do so: trackers err."""
OFF_SURFACE_SHARE_ESTIMATED = 0.05
"""The same of estimated tracks: sensors err too."""


@dataclass(frozen=True, slots=True)
class ArrayProblem:
    """Something wrong with one array."""

    array: str
    """Its path in the shard."""
    what: str


def episode_problems(e: Episode, provenance: Provenance) -> Iterator[ArrayProblem]:
    """Everything wrong with an episode that comes from where ``provenance`` says."""
    for spec in SCHEMA:
        values = spec.of(e) if spec.dtype.startswith("float") else None
        if values is not None and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            yield ArrayProblem(spec.path, f"not finite at step {row}" if spec.per_step else "not finite")
            return
    for check in _CHECKS:
        yield from check(e)
    if provenance.tracks == "estimated" and e.tracks.quality is None:
        yield ArrayProblem("data/sigma", "missing; estimated tracks must state their error")
    yield from _inferred(e, provenance)
    if provenance.action_limits is not None:
        yield from _beyond_limits(e.action, *map(np.array, provenance.action_limits))


def _inferred(e: Episode, provenance: Provenance) -> Iterator[ArrayProblem]:
    """What was inferred states an error above 0, and nothing else does."""
    what = () if provenance.inferred is None else provenance.inferred.what
    for name, sigma in (("state", e.state_sigma), ("action", e.action_sigma)):
        array = f"data/{name}_sigma"
        if (sigma is not None) != (name in what):
            there = f"states errors of a {name} that the manifest does not call inferred"
            yield ArrayProblem(
                array, there if sigma is not None else f"missing; an inferred {name} must state its error"
            )
        elif sigma is not None and not (sigma > 0).all():
            t, k = np.argwhere(~(sigma > 0))[0]
            yield ArrayProblem(array, f"number {k} at step {t} states an error that is not above 0")


def _beyond_limits(action: np.ndarray, low: np.ndarray, high: np.ndarray) -> Iterator[ArrayProblem]:
    """Actions as executed lie within their limits."""
    if action.shape[1] != len(low):
        yield ArrayProblem("data/action", f"has {action.shape[1]} numbers a step, and limits are known of {len(low)}")
        return
    beyond = np.maximum(action - high, low - action)
    t, k = np.unravel_index(beyond.argmax(), beyond.shape)
    if beyond[t, k] > 0:
        limits = f"[{low[k]:g}, {high[k]:g}]"
        yield ArrayProblem(
            "data/action", f"reaches {action[t, k]:.3g} at step {t}; actions as executed lie in {limits}"
        )


def _teleports(e: Episode) -> Iterator[ArrayProblem]:
    step = np.linalg.norm(e.flow[:-1], axis=-1)
    if e.tracks.quality is not None:
        yield from _estimated_teleports(e, step)
    elif step.size and step.max() > TELEPORT:
        t, m = np.unravel_index(step.argmax(), step.shape)
        yield ArrayProblem(
            "data/tracks", f"point {m} jumps {step.max():.3f} m after step {t}; at most {TELEPORT} is possible"
        )


def _estimated_teleports(e: Episode, step: np.ndarray) -> Iterator[ArrayProblem]:
    """Only points that were followed through a step can jump in it; one that comes back from hiding may be anywhere."""
    quality = e.tracks.quality
    assert quality is not None
    known = e.tracks.visible & (quality.source != PositionSource.FILLED)
    known = known[1:] & known[:-1]
    possible = np.maximum(TELEPORT, FASTEST * np.diff(e.time_s))[:, None]
    far = known & (step > possible + 3 * (quality.sigma[1:] + quality.sigma[:-1]))
    if far.sum() > JUMPING_SHARE * known.sum():
        t, m = np.unravel_index(np.where(far, step, 0).argmax(), step.shape)
        yield ArrayProblem(
            "data/tracks",
            f"{far.sum()} of {known.sum()} steps of visible points are jumps that their stated errors do not explain; "
            f"the farthest, of point {m} after step {t}, is {step[t, m]:.3f} m",
        )


def _quality(e: Episode) -> Iterator[ArrayProblem]:
    """Estimated tracks state an error, and claim to be measured only where something was."""
    quality = e.tracks.quality
    if quality is None:
        return
    measured = quality.source == PositionSource.MEASURED
    wrong = {
        "sigma": (quality.sigma <= 0, "states an error that is not above 0"),
        "source": (
            (quality.source < PositionSource.MEASURED) | (quality.source > PositionSource.FILLED),
            "has a source that is none",
        ),
        "visible": (measured & ~e.tracks.visible, "is measured, yet not visible"),
        "depth_valid": (
            measured & e.tracks.visible & ~quality.depth_valid,
            "is measured, yet the sensor gave no depth",
        ),
    }
    if quality.sight is not None:
        unseen = (quality.sight != Sight.SEEN) & (quality.sight != Sight.NO_READING)
        wrong["sight"] = (
            (quality.sight > max(Sight))
            | (e.tracks.visible & unseen)
            | (~e.tracks.visible & (quality.sight == Sight.SEEN)),
            "has a sight that is none, or not that of a point that is visible or not",
        )
    for name in ("forward_backward", "disagreement", "residual"):
        values = getattr(quality, name)
        wrong[name] = ((values < 0) & (values != -1), "is below 0, and not the -1 that stands for unknown")
    for name, (where, what) in wrong.items():
        if where.any():
            t, m = np.argwhere(where)[0]
            yield ArrayProblem(f"data/{name}", f"point {m} at step {t} {what}, and so are {where.sum() - 1} more")


def _times(e: Episode) -> Iterator[ArrayProblem]:
    if not (np.diff(e.time_s) > 0).all():
        yield ArrayProblem("data/time", f"does not rise after step {int((np.diff(e.time_s) <= 0).argmax())}")


def _poses(e: Episode) -> Iterator[ArrayProblem]:
    """Poses of a camera that moves are poses, the first that of the episode's camera."""
    if e.T_world_cam is None:
        return
    for t, T in enumerate(e.T_world_cam):
        if fault := pose_fault(T):
            yield ArrayProblem("data/T_world_cam", f"{fault}, at step {t}")
            return
    if not np.allclose(e.T_world_cam[0], e.camera.T_world_cam, rtol=0, atol=1e-6):
        yield ArrayProblem("data/T_world_cam", "begins elsewhere than where the shard says that the camera is")


def _counts(e: Episode) -> Iterator[ArrayProblem]:
    n = e.point_cloud.shape[1]
    if not ((e.point_count >= 1) & (e.point_count <= n)).all():
        yield ArrayProblem(
            "data/point_count", f"ranges from {e.point_count.min()} to {e.point_count.max()}, not 1 to {n}"
        )


def _anchors(e: Episode) -> Iterator[ArrayProblem]:
    gap = np.abs(np.linalg.norm(e.tracks.xyz_world[0] - e.queries.xyz_world, axis=-1) - e.tracks.association_distance)
    if gap.max() > 1e-4:
        yield ArrayProblem(
            "data/tracks", f"point {gap.argmax()} starts {gap.max() * 1e3:.2f} mm from where it was anchored"
        )


def _off_surface(e: Episode) -> Iterator[ArrayProblem]:
    """Visible points must lie on the cloud, as far as a sampled cloud can tell.

    A farthest-point sample leaves no point of its cloud farther away than its own least spacing, so a
    visible point, which is within a pixel of the cloud, is that near to the sample; unless it has left
    the crop, which the cloud's extent tells. Estimated points may be off by as much as they say.
    """
    from scipy.spatial import cKDTree  # heavy, and nothing else of storage needs it

    far = total = 0
    quality = e.tracks.quality
    known = e.tracks.visible if quality is None else e.tracks.visible & (quality.source != PositionSource.FILLED)
    slack = np.zeros(known.shape, np.float32) if quality is None else 2 * quality.sigma
    for t in range(0, len(e), LOOKED_AT):
        cloud = e.point_cloud[t, : e.point_count[t]]
        xyz = e.tracks.xyz_world[t]
        if len(cloud) < 2 or not known[t].any():
            continue
        tree = cKDTree(cloud, compact_nodes=False, balanced_tree=False)
        inside = known[t] & ((xyz > tree.mins) & (xyz < tree.maxes)).all(1)
        seen = xyz[inside]
        if len(seen) == 0:
            continue
        total += len(seen)
        distance = np.asarray(tree.query(seen)[0]) - e.tracks.association_distance.max() - slack[t, inside]
        if distance.max() > OFF_SURFACE:  # else there is no need to know how coarse the cloud is
            spacing = np.asarray(tree.query(cloud, k=2)[0])[:, 1].min()
            far += int((distance > spacing + OFF_SURFACE).sum())
    if far > (OFF_SURFACE_SHARE if quality is None else OFF_SURFACE_SHARE_ESTIMATED) * total:
        yield ArrayProblem(
            "data/tracks", f"{far} of {total} visible points lie off the surface; the labels do not fit the cloud"
        )


_CHECKS: tuple[Callable[[Episode], Iterator[ArrayProblem]], ...] = (
    _times, _poses, _teleports, _quality, _counts, _anchors, _off_surface,
)  # fmt: skip
