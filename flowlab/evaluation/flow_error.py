"""How well a policy predicted what its own actions did to the scene."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Float32

from flowlab.evaluation.results import RolloutFlowError
from flowlab.geometry.camera import Camera
from flowlab.geometry.moving import MOVING_IN_PLAN_M
from flowlab.grading.tapvid import tapvid
from flowlab.records import Queries
from flowlab.sim.exact_tracks import RigidFlowSettings, rigid_tracks
from flowlab.sim.recorder import Rollout

_DIGITS = 4
"""After the point, of what is kept."""


def flow_error(
    rollout: Rollout,
    queries: Queries,
    predicted: Sequence[tuple[int, Float32[np.ndarray, "K M 3"]]],
    n_action_steps: int,
) -> RolloutFlowError | None:
    """Compare the flow that plans predicted with the motion of the simulated bodies that the points lie on.

    Args:
        rollout: The episode as it went.
        queries: The points; only distinct ones count.
        predicted: The step of each plan, and its flow [m], action by action, in the world frame.
        n_action_steps: How many actions of each plan were done before the next; only they count.

    Returns:
        The error over all plans; None where no point moves.
    """
    distinct = slice(0, queries.count)
    tracks = rigid_tracks(rollout, queries, RigidFlowSettings())[0][:, distinct].astype(np.float64)
    _, z = rollout.camera.project(tracks)
    parts = [
        _errors_of_plan(flow[:n_action_steps, distinct], tracks[step : step + 1 + n_action_steps], z[step + 1 :])
        for step, flow in predicted
        if step + 1 < len(tracks)  # the last action's end is not among the poses
    ]
    if not sum(part.moving.size for part in parts):
        return None
    names = [f.name for f in fields(PlanErrors)]
    together = {name: np.concatenate([getattr(part, name) for part in parts], -1) for name in names}
    return PlanErrors(**together).summarize(rollout.camera)


@dataclass(frozen=True, slots=True)
class PlanErrors:
    """Distances [m] between predicted and true places over the executed steps of some plans.

    Of the two rows of a table the first is the policy's, the second that of predicting no motion.
    """

    moving: Float[np.ndarray, "2 P"]
    """Of P pairs of a moving point and a step."""
    last: Float[np.ndarray, "2 E"]
    """Of moving points at the last executed step of each plan."""
    still: Float[np.ndarray, "S"]
    """Of points that do not move; the policy's only."""
    depth: Float[np.ndarray, "P"]
    """How far from the camera the moving points truly are [m]."""

    def summarize(self, camera: Camera) -> RolloutFlowError:
        """The figures that are kept."""
        seen = np.ones(self.moving.shape[-1], bool)
        (ade, zero_ade), (fde, zero_fde) = 1e3 * self.moving.mean(1), 1e3 * self.last.mean(1)
        policy, zero = (tapvid(e, seen, seen, self.depth, camera) for e in self.moving)
        figures = {
            "ade_mm": ade,
            "zero_ade_mm": zero_ade,
            "fde_mm": fde,
            "zero_fde_mm": zero_fde,
            "apd": policy.apd,
            "zero_apd": zero.apd,
            "average_jaccard": policy.average_jaccard,
            "zero_average_jaccard": zero.average_jaccard,
            "still_mm": 1e3 * self.still.mean() if self.still.size else 0.0,
        }
        rounded = {name: round(float(value), _DIGITS) for name, value in figures.items()}
        counts = {"pairs": self.moving.shape[-1], "ends": self.last.shape[-1], "still_pairs": self.still.size}
        return RolloutFlowError(**counts, **rounded)


def _errors_of_plan(
    flow: Float32[np.ndarray, "K M 3"], tracks_world: Float[np.ndarray, "J M 3"], z: Float[np.ndarray, "L M"]
) -> PlanErrors:
    """One plan's flow [m] against where the points truly were, from when it was made to the next; z from one step later
    on."""
    true = tracks_world[1:] - tracks_world[0]
    distance = np.stack([np.linalg.norm(d, axis=-1) for d in (flow[: len(true)].cumsum(0) - true, true)])
    moves = (distance[1] > MOVING_IN_PLAN_M).any(0)
    return PlanErrors(
        moving=distance[:, :, moves].reshape(2, -1),
        last=distance[:, -1, moves],
        still=distance[0][:, ~moves].reshape(-1),
        depth=z[: len(true), moves].reshape(-1),
    )
