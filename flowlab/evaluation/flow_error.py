"""How well a policy predicted what its own actions did to the scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from flowlab.evaluation.results import RolloutFlowError
from flowlab.geometry.camera import Camera
from flowlab.grading.tapvid import tapvid
from flowlab.records import Queries
from flowlab.sim.recorder import Rollout
from flowlab.sim.tracks import RigidFlowSettings, rigid_tracks
from flowlab.training.validation import MOVING_M

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
    moving, still, last, depth = [], [], [], []
    for step, flow in predicted:
        true_world = tracks[step + 1 : step + 1 + n_action_steps]  # the last action's end is not among the poses
        if len(true_world) == 0:
            continue
        true = true_world - tracks[step]
        distance = np.stack([np.linalg.norm(d, axis=-1) for d in (flow[: len(true), distinct].cumsum(0) - true, true)])
        moves = (distance[1] > MOVING_M).any(0)
        moving.append(distance[:, :, moves].reshape(2, -1))
        depth.append(z[step + 1 : step + 1 + n_action_steps, moves].reshape(-1))
        last.append(distance[:, -1, moves])
        still.append(distance[0][:, ~moves].reshape(-1))
    if not sum(part.size for part in moving):
        return None
    errors = PlanErrors(*(np.concatenate(x, -1) for x in (moving, last, still, depth)))
    return errors.summarize(rollout.camera)


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
