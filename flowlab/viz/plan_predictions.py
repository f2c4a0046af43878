"""What a policy's plans predicted, each beside what then came: what pictures of predicted flow are drawn from."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from flowlab.geometry.moving import MOVING_IN_PLAN_M
from flowlab.records import Episode, FlowPrediction, Role

PREDICTED_M = 0.002
"""A path is drawn if its point is predicted to get this far from where it was [m]."""


@dataclass(frozen=True, slots=True)
class PlanPrediction:
    """One plan of an episode: the predicted paths of the distinct query points, and those they took."""

    step: int
    """When it was made."""
    predicted_world: Float32[np.ndarray, "H M 3"]
    """Row 0: where every point was then [m]; row k: where it was predicted after k more actions."""
    true_world: Float32[np.ndarray, "K M 3"]
    """Where the points were [m], up to the step of the next plan (K - 1 actions of this one were executed)."""

    @property
    def predicted_moving(self) -> Bool[np.ndarray, "M"]:
        """Which points were predicted to move."""
        far: np.ndarray = _farthest(self.predicted_world) > PREDICTED_M
        return far

    @property
    def moving(self) -> Bool[np.ndarray, "M"]:
        """Which points did move."""
        far: np.ndarray = _farthest(self.true_world) > MOVING_IN_PLAN_M
        return far

    @property
    def error(self) -> Float[np.ndarray, "K-1 N"]:
        """How far from the prediction the N points that did move were [m], after each executed action."""
        off = self.predicted_world[1 : len(self.true_world)] - self.true_world[1:]
        distance: np.ndarray = np.linalg.norm(off[:, self.moving], axis=-1)
        return distance

    def mean_predicted_distance(self, points: Bool[np.ndarray, "M"]) -> float:
        """How far some points were predicted to get, on average [m]; 0 for none."""
        return float(_farthest(self.predicted_world[:, points]).mean()) if points.any() else 0.0


def plan_predictions(episode: Episode, prediction: FlowPrediction) -> list[PlanPrediction]:
    """Every plan of an episode, in order, of the distinct query points."""
    M, steps = episode.queries.count, [int(s) for s in prediction.step]
    ends = [*steps[1:], len(episode) - 1]  # the last action's end is not among the rows
    tracks, horizon = episode.tracks.xyz_world[:, :M], prediction.paths_world.shape[1]
    return [
        PlanPrediction(step, paths[:, :M], tracks[step : min(end + 1, step + horizon)])
        for step, end, paths in zip(steps, ends, prediction.paths_world, strict=True)
    ]


def largest_predicted_motion(episode: Episode, plans: list[PlanPrediction]) -> int:
    """Index of the plan that predicts the objects to move farthest, or all points where nobody knows which are."""
    points = episode.query_role[: episode.queries.count] == Role.OBJECT
    if not points.any():
        points = np.ones_like(points)
    return int(np.argmax([plan.mean_predicted_distance(points) for plan in plans]))


def prediction_errors(plans: list[PlanPrediction]) -> Iterator[tuple[int, float]]:
    """Steps, and how far off the points that move then were on average [m], by the last plan before the
    step. Steps of plans under which nothing moves are left out."""
    for plan in plans:
        if plan.moving.any():
            yield from ((plan.step + k, float(off.mean())) for k, off in enumerate(plan.error, 1))


def _farthest(paths: Float32[np.ndarray, "H M 3"]) -> Float[np.ndarray, "M"]:
    """How far [m] each path gets from its start."""
    distance: np.ndarray = np.linalg.norm(paths - paths[:1], axis=-1).max(0)
    return distance
