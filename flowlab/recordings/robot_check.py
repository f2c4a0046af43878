"""Whether what moves in the pictures moves as the robot's position says: evidence of focal length, unit and pose."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from flowlab.geometry.transforms import rigid
from flowlab.recordings.base import SampleStream
from flowlab.recordings.pose_readings import READINGS
from flowlab.recordings.robot_explanations import Explanation, as_said, explanations
from flowlab.recordings.robot_fit import Sureness, linear_support, refined, sureness
from flowlab.recordings.robot_motion import SeenSteps, turn_between
from flowlab.recordings.robot_points import MovingPoints, moving_points, positions_at
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_ABOUT = "robot"
_AS = "as the first three numbers of its state say"
_TOO_LITTLE = "too little is seen to move while the robot does to compare calibration with that"
_REACH_M = (0.02, 3.0)
"""A position [m] that a robot's recording has goes so far at least, and at most."""
_LEAST_WAY_M = 0.015
"""Pairs of pictures between which it goes less tell nothing [m]."""
_PAIRS = 8
"""So many pairs must agree."""
_PAIRS_UNPOSED = 12
"""And so many where nothing is said of how the camera is turned: some turn fit nine pairs of joint angles, of one of
280 simulated arms."""
_AGREE, _AGREE_OTHERWISE = 0.35, 0.6
"""And this share of those with points around the gripper, for calibration as it is said, and for another."""
_CLEARLY = 0.75
"""Where that share does as it is said, nothing else is tried."""
_NEAR_BEST = 0.5
"""Calibration as it is said holds where it explains at least this share of what the best does."""
_MORE = 1.5
"""A scale is doubtful, though calibration holds as it is said, where it explains so many times as much."""
_TIMES = 3.0
"""Another is told where it explains so many times as much."""
_SIMPLER = 0.7
"""A simpler kind of error is told where it explains this share of what the best does."""
_LEFT = 0.13
"""And where steps are off by less than this share of the way, in the median."""
_SHEARED = 1.35
"""What explains so many times as much once its axes are sheared is no position."""
_MIRRORED = 0.8
"""A turn is told where a mirrored robot explains less than this share."""
_SURE = 0.08
"""A scale that is less sure (one standard deviation) is not told."""
_FINE, _DOUBTED = 0.1, 0.16
"""Scales (as logarithms) up to which calibration is right, and from which on it is doubtful: flow at the
rim of a gripper takes off 4 % of its steps, as of 25 tasks, and points of a forearm some more. A turn [rad] takes steps
off by as much: up to the first of these the rotation of T_world_cam is right."""
_STRONG = (12, 0.7, 0.1)
"""Pairs, their share and what steps are off by, to doubt a scale where nothing is said of how the camera is turned:
with less, velocities did so once."""
_ONE_KIND = 0.15
"""Scales are of a focal length, or of a unit, where they differ by less from what it would do."""
_TURNED_RAD, _TURN_SURE_RAD = float(np.radians(20)), float(np.radians(10))
_READ_RAD = float(np.radians(15))
"""Another reading of T_world_cam is the right one where it turns to within this of what is seen, and it is in place."""
_AWAY_M = 0.6
"""What moves with the robot is at most so far from its position [m]."""
_GRIPPER_M = 0.28
"""Things farther from its position [m] are of a forearm, which goes less far: they tell no scale. Of seven tasks whose
gripper is seen they are 0.09 to 0.24 m away, of one whose forearm hides it 0.32."""
_LAGS_S = 0.4
"""State is tried at times up to so much off [s]."""
_LAG_STEPS = 4


@dataclass(frozen=True, slots=True)
class Seen:
    """What moves in a recording, and the state that may say so."""

    points: tuple[MovingPoints, ...]
    state: SampleStream

    def at(self, late_s: float = 0.0) -> SeenSteps:
        """Steps of points with those of a state to whose times so much was added [s]."""
        times = np.array([p.time_s for p in self.points]).reshape(-1, 2) - late_s
        at = positions_at(self.state, times.ravel()).reshape(-1, 2, 3)
        way = at[:, 1] - at[:, 0]
        goes = np.linalg.norm(way, axis=1) >= _LEAST_WAY_M
        points, none = [p for p, tells in zip(self.points, goes, strict=True) if tells], [np.empty((0, 3))]
        return SeenSteps(
            np.repeat(np.arange(len(points)), [len(p.start) for p in points]).astype(np.int64),
            np.concatenate([p.start for p in points] or none),
            np.concatenate([p.step for p in points] or none),
            at[goes, 0],
            way[goes],
        )

    def lags(self) -> list[float]:
        """What may be added to the times of the state [s], the least first."""
        apart = float(np.median([p.time_s[1] - p.time_s[0] for p in self.points]))
        step = min(apart / 2, _LAGS_S / 4)
        return [sign * k * step for k in range(1, _LAG_STEPS + 1) if k * step <= _LAGS_S for sign in (1, -1)]


def check_robot(source: "ParsedRecording") -> Iterator[Check]:
    """Whether what moves goes as the state's first three numbers say; one check, or none without a state.

    Args:
        source: A recording whose camera stands still, or has poses.
    """
    state = next(iter(source.streams.state), None)
    if state is None or state.values.shape[1] < 3 or len(state.time_s) < 2:
        return
    reach = float(np.ptp(state.values[:, :3].astype(float), axis=0).max())
    if not _REACH_M[0] <= reach <= _REACH_M[1]:
        yield Check(_ABOUT, Verdict.ASSUMED, f"the first three numbers of its state go over {reach:.3g}: calibration "
                    f"is compared with positions that go over {_REACH_M[0]:g} to {_REACH_M[1]:g} m")  # fmt: skip
        return
    seen = Seen(tuple(moving_points(source, state)), state)
    yield judge(seen, _pose_said(source), source.write_to)


def _pose_said(source: "ParsedRecording") -> Float64[np.ndarray, "4 4"] | None:
    """T_world_cam of the first row, where it is one that turns."""
    given, poses = source.metadata.T_world_cam, source.frame_check.T_world_cam
    if poses is None and given is None:
        return None
    T = np.array(given, float) if poses is None else poses[0]
    return None if np.allclose(T[:3, :3], np.eye(3), atol=1e-6) else T


def judge(seen: Seen, T_world_cam: Float64[np.ndarray, "4 4"] | None, write_to: str) -> Check:
    """What follows from how things move while the robot does.

    Args:
        seen: What moves.
        T_world_cam: Pose of the camera; None where nothing is said of it.
        write_to: What the user is to write into.
    """
    steps = seen.at()
    if len(steps) < _PAIRS:
        return Check(_ABOUT, Verdict.ASSUMED, _TOO_LITTLE)
    R = None if T_world_cam is None else T_world_cam[:3, :3].T
    at_once = as_said(steps, R)
    if at_once is not None and _holds_as_said(at_once, _CLEARLY) and (R is not None or not _sheared(steps, at_once)):
        return _as_said(steps, at_once, T_world_cam, write_to)
    found = explanations(steps, R)
    said = next((e for e in found if not e.scaled and e.turned == (R is None)), None)
    most = max((e.support.score for e in found), default=0.0)
    if R is None and said is not None and _sheared(steps, said):
        said = None
    if said is not None and _holds_as_said(said, _AGREE) and said.support.score >= _NEAR_BEST * most:
        return _as_said(steps, said, T_world_cam, write_to)
    return _at_other_times(seen, R, most) or _otherwise(steps, found, said, T_world_cam, write_to)


def _holds(found: Explanation, agree: float) -> bool:
    """Whether enough goes along."""
    support = found.support
    return support.count >= _PAIRS and support.agreement >= agree and support.left <= _LEFT


def _holds_as_said(said: Explanation, agree: float) -> bool:
    """The same of calibration as it is said."""
    return _holds(said, agree) and said.support.count >= _least(said)


def _least(said: Explanation) -> int:
    """Pairs that must agree with calibration as it is said, which leaves the turn open where there is no pose."""
    return _PAIRS_UNPOSED if said.turned else _PAIRS


def _sheared(steps: SeenSteps, found: Explanation) -> bool:
    """Whether more goes along if the state's axes are sheared: then they are no position."""
    return linear_support(steps, found.motion).score > _SHEARED * found.support.score


def _mirrored(steps: SeenSteps, found: Explanation) -> bool:
    """Whether things go nearly as well as a mirror shows the robot: of what goes about in a plane that is not told, nor
    is then how the camera is turned."""
    mirror = as_said(replace(steps, way=-steps.way, at=-steps.at), None)
    return mirror is not None and mirror.support.score > _MIRRORED * found.support.score


def _as_said(steps: SeenSteps, said: Explanation, T: np.ndarray | None, write_to: str) -> Check:
    """What is said where the calibration that is given explains what moves: how exactly it does."""
    motion, support = refined(steps, said.motion, turns=said.turned)
    sure = sureness(steps, motion, support, turns=said.turned)
    fit = replace(said, motion=motion, support=support)
    numbers = _numbers(fit, sure)
    if numbers is None or sure.turn_rad > _TURN_SURE_RAD:
        return Check(_ABOUT, Verdict.ASSUMED, f"{_goes(fit)} {_AS}, along too few directions to tell "
                     "whether calibration is right")  # fmt: skip
    scale, away = _judged_scale(fit, sure), _away(fit, T)
    near = away is None or away < _GRIPPER_M
    if scale is not None and near and support.score > _MORE * said.support.score:
        return Check(_ABOUT, Verdict.DOUBTFUL, f"{_goes(fit)} {numbers} {_AS}: {scale.says}; {_correct(write_to)}")
    if away is not None and away > _AWAY_M:
        return Check(_ABOUT, Verdict.DOUBTFUL, f"{_goes(fit)} {numbers} {_AS}, but {away:.2f} m from there: "
                     f"T_world_cam is not of their frame, or its position is wrong; {_correct(write_to)}")  # fmt: skip
    turned, of = _turned_by(steps, fit, T)
    deep = sure.along <= _SURE
    off = max(abs(np.log(motion.across)), abs(np.log(motion.along)) if deep else 0.0)
    says = f"{_goes(fit)} {numbers} {_AS}{turned}"
    if off > _FINE:
        return Check(_ABOUT, Verdict.ASSUMED, f"{says}: {of} may be off by as much, or flow is")
    unless = "" if deep else ", unless focal length and unit are off alike: little goes along the view"
    return Check(_ABOUT, Verdict.OK, f"{says}: {of} are right to within that{unless}")


def _turned_by(steps: SeenSteps, said: Explanation, T: np.ndarray | None) -> tuple[str, str]:
    """By how much what moves is turned against T_world_cam, in words, where that is told; and what is right then."""
    of = "'intrinsics' and 'depth_unit_m'"
    if T is None:
        return "", of
    motion, support = refined(steps, said.motion)
    if sureness(steps, motion, support).turn_rad >= _TURN_SURE_RAD:
        return "", of
    angle = turn_between(motion.R_cam_base, T[:3, :3].T)
    says = f", turned by {np.degrees(angle):.0f} degrees against T_world_cam"
    return (f"{says}, which may be off by as much", of) if angle > _FINE else (says, f"its rotation, {of}")


def _correct(write_to: str) -> str:
    return f"correct it in {write_to}, unless these are no position in meters"


def _goes(found: Explanation) -> str:
    return f"in {found.support.count} of {found.support.telling} pairs of pictures what moves goes"


def _numbers(found: Explanation, sure: Sureness) -> str | None:
    """How far things go, in words; None where that is not told."""
    if sure.across > _SURE:
        return None
    says = f"{found.motion.across:.2f} times as far across the view"
    return f"{says} and {found.motion.along:.2f} times along it" if sure.along <= _SURE else says


def _away(found: Explanation, T: np.ndarray | None) -> float | None:
    """How far what moves is from where the state is, if T_world_cam is right [m]."""
    return None if T is None else float(np.linalg.norm(found.support.middle + T[:3, 3]))


@dataclass(frozen=True, slots=True)
class _WrongScale:
    """What scales say of focal length and unit."""

    says: str
    what: str | None
    """The key that is wrong, where it is one."""


def _judged_scale(found: Explanation, sure: Sureness) -> _WrongScale | None:
    """What scales say of focal length and unit; None where they are as they should be, or not sure."""
    across, along = np.log(found.motion.across), np.log(found.motion.along)
    if sure.across > _SURE:
        return None
    deep = sure.along <= _SURE
    worst, off_by = max((abs(across), sure.across), (abs(along), sure.along) if deep else (0.0, 0.0))
    if worst < _DOUBTED + 2 * off_by:
        return None
    if deep and abs(along) <= _ONE_KIND:
        size = f"{np.exp(abs(across)):.2f} times too {'large' if across < 0 else 'small'}"
        return _WrongScale(f"the focal length in 'intrinsics' is {size}", "intrinsics")
    if deep and abs(across - along) <= _ONE_KIND:
        times = float(np.exp((across + along) / 2))
        size = f"{max(times, 1 / times):.3g} times too {'large' if times > 1 else 'small'}"
        return _WrongScale(f"'depth_unit_m' is {size}", "depth_unit_m")
    return _WrongScale("'depth_unit_m' or the focal length in 'intrinsics' is wrong", None)


def _at_other_times(seen: Seen, R: np.ndarray | None, most: float) -> Check | None:
    """What is said where things go as a state of other times says."""
    found = [(late, as_said(seen.at(late), R)) for late in seen.lags()]
    held = [(e.support.score, late, e) for late, e in found if e is not None and _holds(e, _AGREE_OTHERWISE)]
    score, late, fit = max(held, key=lambda x: x[0], default=(0.0, 0.0, None))
    if fit is None or score < _SIMPLER * most:
        return None
    return Check(_ABOUT, Verdict.ASSUMED, f"{_goes(fit)} {_AS} if about {late:.2g} s were added to the times of state "
                 "('state_offset_s')")  # fmt: skip


def _otherwise(
    steps: SeenSteps, found: list[Explanation], said: Explanation | None, T: np.ndarray | None, write_to: str
) -> Check:
    """What is said where calibration as it is said does not explain what moves: what does, if anything."""
    before = 0.0 if said is None else said.support.score
    held = [e for e in found if _holds(e, _AGREE_OTHERWISE) and e.support.score > _TIMES * before + 1 and e is not said]
    most = max((e.support.score for e in held), default=0.0)
    fit = next((e for e in held if e.support.score >= _SIMPLER * most), None)
    if fit is not None and not _sheared(steps, fit):
        sure = sureness(steps, fit.motion, fit.support, turns=fit.turned)
        told = _told(fit, sure, T)
        if told is not None and not (T is not None and fit.turned and not fit.scaled and _mirrored(steps, fit)):
            goes = f"{_goes(fit)} {_numbers(fit, sure)}" if fit.scaled else _goes(fit)
            return Check(_ABOUT, Verdict.DOUBTFUL, f"{goes} {_AS}{told}; {_correct(write_to)}")
    if said is not None and said.support.count < _least(said) and said.support.agreement >= _CLEARLY:
        return Check(_ABOUT, Verdict.ASSUMED, _TOO_LITTLE)
    return Check(_ABOUT, Verdict.ASSUMED, "little of what is seen to move goes as the first three numbers of its state "
                 "do: these are no position in meters, the gripper is not seen or goes with the camera, or calibration "
                 "is off in a way that this does not tell")  # fmt: skip


def _told(fit: Explanation, sure: Sureness, T: np.ndarray | None) -> str | None:
    """What another explanation says of calibration; None where it is not sure, or of two mistakes at once: angles of
    joints are explained by these now and then."""
    scale = _judged_scale(fit, sure) if fit.scaled else None
    if sure.turn_rad > _TURN_SURE_RAD or (fit.scaled and scale is None):
        return None
    angle = 0.0 if T is None else turn_between(fit.motion.R_cam_base, T[:3, :3].T)
    turned = angle > _TURNED_RAD + 2 * sure.turn_rad
    if T is not None and turned:
        return None if fit.scaled else _turned(fit, T, angle)
    if scale is None:
        return None
    support = fit.support
    strong = support.count >= _STRONG[0] and support.agreement >= _STRONG[1] and support.left <= _STRONG[2]
    away = _away(fit, T)
    if (away is None and (not strong or scale.what is None)) or (away is not None and away > _GRIPPER_M):
        return None
    return f": {scale.says}"


def _turned(fit: Explanation, T: np.ndarray, angle: float) -> str:
    """What a turn against T_world_cam says of it."""
    says = f", turned by {np.degrees(angle):.0f} degrees against T_world_cam"
    for how, read in READINGS.items():
        meant = read(rigid(T[:3, :3], T[:3, 3]))
        away = _away(fit, meant)
        if turn_between(fit.motion.R_cam_base, meant[:3, :3].T) < _READ_RAD and away is not None and away < _AWAY_M:
            return f"{says}, and as it says if it were {how}"
    return f"{says}: that is wrong, or not of the frame of these numbers"
