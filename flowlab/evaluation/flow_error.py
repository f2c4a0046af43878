"""How well a policy foresaw what its own actions did to the scene."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from flowlab.evaluation.trials import RolloutFlowError
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
    """Compare the flow that plans foresaw with the motion of the simulated bodies that the points lie on.

    ``predicted`` holds the step of each plan and its flow [m], action by action, of which the first ``n_action_steps`` were
    done before the next plan. Only they count, and distinct points. None where no point moves.
    """
    distinct = slice(0, queries.count)
    tracks = rigid_tracks(rollout, queries, RigidFlowSettings())[0][:, distinct].astype(np.float64)
    _, z = rollout.camera.project(tracks)
    moving, still, last, depth = [], [], [], []
    for step, flow in predicted:
        here = tracks[step + 1 : step + 1 + n_action_steps]  # the last action's end is not among the poses
        if len(here) == 0:
            continue
        true = here - tracks[step]
        guess = flow[: len(here), distinct].cumsum(0)
        off = np.stack([np.linalg.norm(guess - true, axis=-1), np.linalg.norm(true, axis=-1)])
        moves = (off[1] > MOVING_M).any(0)
        moving.append(off[:, :, moves].reshape(2, -1))
        depth.append(z[step + 1 : step + 1 + n_action_steps, moves].reshape(-1))
        last.append(off[:, -1, moves])
        still.append(off[0][:, ~moves].reshape(-1))
    off, ends, calm = (np.concatenate(x, -1) if x else np.zeros((2, 0)) for x in (moving, last, still))
    if off.shape[-1] == 0:
        return None
    seen = np.ones(off.shape[-1], bool)
    (ade, zero_ade), (fde, zero_fde) = 1e3 * off.mean(1), 1e3 * ends.mean(1)
    shares, zero = (tapvid(e, seen, seen, np.concatenate(depth), rollout.camera) for e in off)
    figures = {
        "ade_mm": ade,
        "zero_ade_mm": zero_ade,
        "fde_mm": fde,
        "zero_fde_mm": zero_fde,
        "apd": shares.apd,
        "zero_apd": zero.apd,
        "average_jaccard": shares.average_jaccard,
        "zero_average_jaccard": zero.average_jaccard,
        "still_mm": 1e3 * calm.mean() if calm.size else 0.0,
    }
    rounded = {name: round(float(value), _DIGITS) for name, value in figures.items()}
    return RolloutFlowError(pairs=off.shape[-1], ends=ends.shape[-1], still_pairs=calm.size, **rounded)
