"""Which of a dataset's query points each episode is trained with, and how much their labels count."""

import math

import numpy as np
from jaxtyping import Float32, Int

from flowlab.data.needs import FlowNeeds
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.errors import DataError
from flowlab.geometry.sampling import farthest_points
from flowlab.perception.point_cloud import pad
from flowlab.records import Role


def choose_queries(buffer: ReplayBuffer, needs: FlowNeeds) -> Int[np.ndarray, "E M"]:
    """Columns of the query points that each episode is trained with.

    ``scene`` takes the first M where the dataset was extracted with that sampling, which is the farthest-point sample
    of M.

    Raises:
        DataError: The dataset has too few query points, or none of the kind asked for.
    """
    found = buffer.queries.shape[1]
    if needs.points > found:
        raise DataError(
            f"motion.points is {needs.points}, and the dataset has {found} query points; add --set motion.points="
            f"{found}, or make the dataset with --set queries.points={needs.points}"
            if found
            else "the dataset has no query points, and the policy learns from how they move; train --policy dp3"
        )
    return np.stack([_choose(buffer, k, needs) for k in range(len(buffer.episodes))])


def label_weight(buffer: ReplayBuffer, needs: FlowNeeds) -> Float32[np.ndarray, "F Q"]:
    """How much the position of every query point counts at every frame."""
    visible = np.where(buffer.visible, 1.0, needs.occluded_weight)
    return (visible / (1 + (buffer.sigma / needs.sigma_m) ** 2)).astype(np.float32)


def _choose(buffer: ReplayBuffer, episode: int, needs: FlowNeeds) -> Int[np.ndarray, "M"]:
    count, wanted = int(buffer.query_count[episode, 0]), needs.points
    xyz, role = buffer.queries[episode, :count], buffer.query_role[episode, :count]
    if needs.sampling == "scene":
        return pad(farthest_points(xyz, wanted), wanted)
    movable = np.flatnonzero(role == Role.OBJECT)
    if not len(movable):
        where = buffer.episodes[episode]
        raise DataError(
            f"{where.task} seed {where.seed}: none of its {count} query points is known to lie on an object; use "
            "--set motion.sampling=scene, or make the dataset with --set queries.sampling=stratified"
        )
    on_object = wanted if needs.sampling == "object" else math.ceil(wanted * needs.query_settings["object_share"])
    chosen = movable[farthest_points(xyz[movable], on_object)]
    if needs.sampling == "stratified":
        chosen = np.concatenate([chosen, farthest_points(xyz, wanted - len(chosen), chosen)])
    return pad(chosen, wanted)
