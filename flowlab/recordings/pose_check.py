"""Whether poses of a camera that moves are right: under them, what stands still stays where it is in the world."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from flowlab.geometry.transforms import rigid
from flowlab.recordings.hand_eye import estimate_hand_eye
from flowlab.recordings.pose_pairs import FlowPair, floor_m, flow_pairs
from flowlab.recordings.pose_readings import READINGS
from flowlab.recordings.pose_scale import estimate_scale, scaled
from flowlab.recordings.pose_steps import come_again
from flowlab.recordings.poses import poses_at
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_NO_BETTER = 0.9
"""Poses that leave more than this share explain nothing."""
_EXPLAINED = 0.5
"""Right poses leave less than this share of how far the scene moves before the camera."""
_ERRS = 1.5
"""Times what sensors and flow err by, from which on poses are wrong."""
_SOME, _SOME_PAIRS = 0.2, 0.25
"""Poses are wrong for some of the time where not even so many of the points stay; of 73 films with true poses, one pair
of eight has that in two. Refused are poses that explain nothing in so many pairs, two at least."""
_BETTER = 0.5
"""Another reading of the poses is the right one where it leaves less than this share of what they leave."""
_SHIFTED = 0.6
"""The same, of poses at other times."""
_MOST = 0.75
"""In so many of the pairs."""
_LEAST_PAIRS = 4
"""Poses at other times are tried on half as many pairs at least."""
_SHIFT_M = 0.003
"""And by no less than this [m]."""
_MUST_BE = (
    "the poses must be those of the color camera itself (x right, y down, z forward), not of a flange or another "
    "camera, in meters, on the clock of the pictures ('T_world_cam_offset_s')"
)
_OFFSETS_S = tuple(float(x) for x in np.arange(-10, 11) * 0.05 if x)
_READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    **READINGS,
    "in millimeters": lambda T: rigid(T[:, :3, :3], T[:, :3, 3] / 1000),
}


def check_poses_fit(source: "ParsedRecording") -> Check:
    """Whether the scene stands still under the poses, and whether it does so only by another reading of them."""
    T = source.frame_check.T_world_cam
    assert T is not None
    found = [pair.without_carried(T) for pair in flow_pairs(source)]
    pairs = [pair for pair in found if pair.fit().left_m < floor_m([pair])]
    if not pairs:
        says = "it moves as its poses say; too little texture and depth in the pictures to tell whether these are right"
        return Check("camera", Verdict.ASSUMED, says)
    off, fixed = _off_m(pairs, T), float(np.median([np.median(p.moved_m()) for p in pairs]))
    seen = (f"under its poses the scene stays within {1000 * off:.1f} mm in the median between {len(pairs)} pairs of "
            f"pictures, and would move by {1000 * fixed:.1f} mm before a camera that stands still")  # fmt: skip
    verdict, says = _judged(source, pairs, T, off, fixed)
    return Check("camera", verdict, f"it moves{says}: {seen}" if verdict is Verdict.OK else f"{seen}{says}")


def _judged(
    source: "ParsedRecording", pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"], off: float, fixed: float
) -> tuple[Verdict, str]:
    """What follows from how far apart points are under the poses T, and would be without [m]."""
    floor = floor_m(pairs)
    # Between others, poses of other times would fit by chance.
    late, best, unshifted = _best_offset(source, [p for p in pairs if np.median(p.moved_m()) > floor])
    if best < min(_SHIFTED * unshifted, floor) and unshifted - best > _SHIFT_M and not come_again(T):
        write = late + (source.metadata.T_world_cam_offset_s or 0.0)
        return Verdict.REFUSED if off > floor else Verdict.DOUBTFUL, (
            f", within {1000 * best:.1f} mm if {late:g} s were added to the times of the poses: their clocks differ; "
            f"write 'T_world_cam_offset_s: {write:.3g}' into {source.write_to}")  # fmt: skip
    others = {how: _off_m(pairs, read(T)) for how, read in _READINGS.items()}
    how = min(others, key=lambda k: others[k])
    little = fixed <= 2 * floor
    fits = off <= floor and (
        off <= _EXPLAINED * fixed or (little and (fixed <= floor / 2 or off <= _NO_BETTER * fixed))
    )
    if not fits and others[how] < min(_BETTER * off, _EXPLAINED * fixed):
        return Verdict.REFUSED, (
            f", within {1000 * others[how]:.1f} mm if each were {how}: T_world_cam must map coordinates of the camera "
            "(x right, y down, z forward) to the world's [m]; correct the poses")  # fmt: skip
    explained, taken = _judged_explained(pairs, T, off), _judged_as_taken(source, pairs, T, off, fixed, fits=fits)
    return taken if explained is None else (max(taken[0], explained[0], key=lambda v: v.severity), explained[1])


def _judged_as_taken(
    source: "ParsedRecording", pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"], off: float, fixed: float, *,
    fits: bool,
) -> tuple[Verdict, str]:  # fmt: skip
    """What follows where no other reading of the poses is any better."""
    floor = floor_m(pairs)
    contradicted = [p for p in pairs if _contradicts(p, T, floor)]
    if 0 < len(contradicted) < _MOST * len(pairs):
        return _judged_in_part(source, contradicted, len(pairs), T)
    if fits:
        told, little = off <= _EXPLAINED * fixed or fixed <= floor / 2, fixed <= 2 * floor
        return (Verdict.OK, " little" if little else "") if told else (Verdict.ASSUMED, (
            ": that is too little to tell whether the poses are right"))  # fmt: skip
    worse = off > _EXPLAINED * fixed
    why = "they explain too little of it" if worse else "that is more than sensors err by"
    refused = worse and off > _ERRS * floor and not _some_stays(pairs, T, floor)
    return Verdict.REFUSED if refused else Verdict.DOUBTFUL, f": {why}; {_MUST_BE}"


def _judged_explained(pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"], off: float) -> tuple[Verdict, str] | None:
    """What follows where the poses of something else, or scaled, would explain what is seen: by what does so best."""
    found = [x for x in (_judged_hand(pairs, T), _judged_scale(pairs, T, off)) if x is not None]
    return min(found)[1:] if found else None


_Explained = tuple[float, Verdict, str]
"""Within what the scene stays then [m], and what follows."""


def _judged_hand(pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"]) -> _Explained | None:
    """What follows where poses are those of what the camera is mounted on."""
    mounted = estimate_hand_eye(pairs, T)
    if mounted is None:
        return None
    T_world_cam = T @ mounted.T_hand_cam
    off, then = (np.array([p.off_m(poses) for p in pairs]) for poses in (T, T_world_cam))
    verdict, best = mounted.judged(off, then, floor_m(pairs)), float(np.median(then))
    return None if verdict is Verdict.OK else (best, verdict, (
        f", within {1000 * best:.1f} mm if they were of a hand on which the camera is turned by "
        f"{np.degrees(mounted.turn_rad):.0f} degrees and {1000 * mounted.away_m:.0f} mm away; {_MUST_BE}"))  # fmt: skip


def _judged_scale(pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"], off: float) -> _Explained | None:
    """What follows where the camera moves farther, or less far, by its pictures than by its poses."""
    scale = estimate_scale(pairs, T)
    if scale is None or scale.share <= 0:
        return None
    best = _off_m(pairs, scaled(T, scale.share))
    verdict = scale.judged(best / max(off, 1e-9))
    return None if verdict is Verdict.OK else (best, verdict, (
        f", within {1000 * best:.1f} mm if the camera had moved {scale.share:.2f} times as far: poses are in another "
        "unit or of no known scale, as of SLAM with one camera, or 'depth_unit_m' or the focal length is wrong; "
        "correct which it is"))  # fmt: skip


def _contradicts(pair: FlowPair, T: Float[np.ndarray, "T 4 4"], floor: float) -> bool:
    """Whether poses explain little of how far the scene moves: neither most of it nor, as where something that moves
    fills the picture, some."""
    off, fixed = pair.off_m(T), float(np.median(pair.moved_m()))
    return off > max(_ERRS * floor, _EXPLAINED * fixed) and pair.off_m(T, _SOME) > floor


def _some_stays(pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"], floor: float) -> bool:
    """Whether in most pairs some points stay that would move before a camera that stands still: then it may be that
    something that moves fills most of the picture."""
    shares = [((p.apart_m(T) <= floor) & (p.moved_m() > 2 * floor)).mean() for p in pairs]
    return bool(np.median(shares) >= _SOME)


def _judged_in_part(
    source: "ParsedRecording", contradicted: list[FlowPair], count: int, T: Float[np.ndarray, "T 4 4"]
) -> tuple[Verdict, str]:
    """What follows where the scene stays under the poses between most of ``count`` pairs of pictures, not between some:
    a camera whose tracking was lost for a while."""
    worst = max(contradicted, key=lambda p: p.off_m(T))
    first, second = (source.streams.color.names[int(source.frame_check.color[r])] for r in worst.rows)
    lost = sum(p.off_m(T) >= _NO_BETTER * np.median(p.moved_m()) for p in contradicted)
    many = lost >= max(2, _SOME_PAIRS * count)
    return Verdict.REFUSED if many else Verdict.DOUBTFUL, (
        f", but not between {len(contradicted)} of them, by {1000 * worst.off_m(T):.1f} mm from {first} to {second}: "
        "the poses are wrong there, as where tracking of the camera was lost, or something that moves fills the "
        "picture; correct or leave out the poses of these frames")  # fmt: skip


def _off_m(pairs: list[FlowPair], T: Float[np.ndarray, "T 4 4"]) -> float:
    """How far apart points are that should be one, in most of the pairs."""
    return float(np.median([p.off_m(T) for p in pairs]))


def _best_offset(source: "ParsedRecording", pairs: list[FlowPair]) -> tuple[float, float, float]:
    """What added to the times of the poses [s] has the scene stay best, within what, and within what as it is [m].

    Both are of the pairs that have poses at the other times, and most of these must fit better.
    """
    poses, clock = source.streams.poses, source.streams.color.time_s[source.frame_check.color]
    assert poses is not None
    here, _ = poses_at(poses, clock, np.inf)
    as_it_is = np.array([p.off_m(here) for p in pairs])
    found = []
    for late in _OFFSETS_S:
        T, known = poses_at(poses, clock - late, np.inf)
        mine = np.array([known[list(p.rows)].all() for p in pairs])
        off = np.array([p.off_m(T) for p, is_known in zip(pairs, mine, strict=True) if is_known])
        if 2 * mine.sum() >= max(len(pairs), _LEAST_PAIRS) and (off < as_it_is[mine]).sum() >= _MOST * mine.sum():
            found.append((float(off.mean()), late, float(as_it_is[mine].mean())))
    best, late, unshifted = min(found, default=(np.inf, 0.0, np.inf))
    return late, best, unshifted
