"""How the gripper is held: its opening and what else a state tells, read off the cloud around it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from flowlab.actions.kernel import MOST_ROWS, KernelRegression
from flowlab.actions.path import smooth
from flowlab.actions.robot import GripperPath
from flowlab.actions.shape import GripperShape

_GRID_M = 0.01
_BLUR_M = 0.008
"""How far a point is felt."""
_EDGE = 0.01
"""Share of the shape at either end, along each axis, that is not looked at."""
_MARGIN_M = 0.03
_JITTER_M = 0.0015
"""Poses are as far off as this when they are found."""


@dataclass(frozen=True, slots=True)
class GripReader:
    """What the cloud around a known pose tells of the rest of the state."""

    nodes: Float[np.ndarray, "g 3"]
    """Places in the gripper's axes at which it is felt for points [m]."""
    regression: KernelRegression
    unit: Float[np.ndarray, "r"]
    """How much each number varies in demonstrations."""

    def read(
        self, clouds: Sequence[np.ndarray], path: GripperPath
    ) -> tuple[Float[np.ndarray, "T r"], Float[np.ndarray, "T r"]]:
        """The numbers of every frame, and how far off they may be, not yet calibrated."""
        x = _felt(self.nodes, clouds, path)
        spread = self.regression.novelty(x)[:, None] * self.unit
        return smooth(self.regression.predict(x)), spread + 1e-6


def fit_grip(
    shape: GripperShape,
    clouds: Sequence[np.ndarray],
    path: GripperPath,
    rest: Float[np.ndarray, "F r"],
    rng: np.random.Generator,
) -> GripReader:
    """Learn to read the rest of the state.

    Args:
        shape: Of the gripper.
        clouds: Of every frame of the demonstrations.
        path: The gripper's pose in each.
        rest: The rest of the state in each.
        rng: Draws by how much poses are off.
    """
    low, high = (
        np.quantile(shape.xyz, q, axis=0) + m for q, m in ((_EDGE, -_MARGIN_M / 3), (1 - _EDGE, _MARGIN_M / 3))
    )
    axes = [np.arange(a, b, _GRID_M) for a, b in zip(low, high, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    nodes = nodes[shape.tree.query(nodes)[0] < _MARGIN_M]
    frames = np.arange(len(path))
    if len(frames) > MOST_ROWS // 2:
        frames = np.sort(rng.choice(frames, MOST_ROWS // 2, replace=False))
    chosen, some = [clouds[int(k)] for k in frames], path.rows(frames)
    moved = some.moved_to(some.position + rng.normal(0, _JITTER_M, (len(frames), 3)))
    x = np.concatenate([_felt(nodes, chosen, some), _felt(nodes, chosen, moved)])
    y = np.concatenate([rest[frames]] * 2)
    return GripReader(nodes, KernelRegression.fit(x, y, ridge=0.1, sharpness=1.0), rest.std(0))


def _felt(nodes: np.ndarray, clouds: Sequence[np.ndarray], path: GripperPath) -> Float[np.ndarray, "T g"]:
    """How many points are around each place; the square root, so that nearly empty places count too."""
    felt = np.zeros((len(path), len(nodes)))
    tree = cKDTree(nodes)
    for k, cloud in enumerate(clouds):
        local = path.to_gripper(np.asarray(cloud, float), k)
        pairs = cKDTree(local).sparse_distance_matrix(tree, 3 * _BLUR_M, output_type="ndarray")
        np.add.at(felt[k], pairs["j"], np.exp(-(pairs["v"] ** 2) / (2 * _BLUR_M**2)))
    return np.sqrt(felt)
