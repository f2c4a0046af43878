"""Fit the weights of ``flowlab.tracking.uncertainty`` on simulated recordings, and check them on others.

    python benchmarks/calibrate_sigma.py --recordings DIR

Simulates tasks that no benchmark grades, labels them with both trackers that need no weights, and fits the 68th
percentile of the error by quantile regression, for each source of a position apart. Needs OpenGL for color.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from flowlab.grading import ground_truth
from flowlab.grading.grade import read_clip
from flowlab.grading.simulate import SimulatedRecording, simulate_recording
from flowlab.records import PositionSource
from flowlab.sim.sensor import CLEAN, KINECT
from flowlab.tracking.base import make_tracker
from flowlab.tracking.chunking import ChunkSettings, follow
from flowlab.tracking.lifting import LiftSettings, lift
from flowlab.tracking.uncertainty import EVIDENCE, WEIGHTS, evidence

TASKS = (
    "button-press", "coffee-push", "dial-turn", "handle-press", "lever-pull", "peg-insert-side", "plate-slide",
    "stick-push", "sweep", "window-open",
)  # fmt: skip
"""None of the eight that accuracy is reported on."""
QUANTILE = 0.68
_SAMPLE = 6000
"""Positions per source: enough for nine weights, few enough for the linear program."""


def main() -> None:
    """Make the recordings, fit, and print what to write into ``quality.py``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True, help="folder to keep the recordings in")
    arguments = parser.parse_args()
    rows: dict[PositionSource, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {source: [] for source in WEIGHTS}
    for k, task in enumerate(TASKS):
        for sensor in (KINECT, CLEAN) if k % 3 == 0 else (KINECT,):
            folder = arguments.recordings / f"{task}-{'clean' if sensor is CLEAN else 'kinect'}"
            simulate_recording(folder, task, 100 + k, SimulatedRecording(sensor=sensor))
            print(folder.name, flush=True)
            for name in ("rigid-bodies", "lucas-kanade"):
                _collect(folder, name, k, rows)
    rng = np.random.default_rng(0)
    for source, parts in rows.items():
        values, error, group = (np.concatenate(x) for x in zip(*parts, strict=True))
        pick = rng.permutation(len(error))[:_SAMPLE]
        weights = _fit(values[pick], np.log(np.maximum(error[pick], 2e-4)))
        stated = np.exp(values @ weights)
        print(f"    Source.{source.name}: ({', '.join(f'{w:.3f}' for w in weights)}),")
        print(f"    # {len(error)} positions of {len(np.unique(group))} tasks, {(error < stated).mean():.3f} below")
    print(EVIDENCE)


def _collect(folder: Path, name: str, group: int, rows: dict) -> None:
    clip, truth = read_clip(folder), ground_truth.read(folder)
    tracks = follow(clip, truth.query_px, make_tracker(name), ChunkSettings())
    lifted = lift(clip, tracks, LiftSettings())
    T_world_cam = clip.camera.T_world_cam
    xyz_cam = (lifted.xyz_world - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    error = np.linalg.norm(xyz_cam - truth.tracks_cam, axis=-1)
    values = evidence(clip, tracks, lifted)
    for source, parts in rows.items():
        mine = (lifted.source == source) & (np.arange(len(clip)) > 0)[:, None]
        parts.append((values[mine], error[mine], np.full(int(mine.sum()), group)))


def _fit(values: np.ndarray, log_error: np.ndarray) -> np.ndarray:
    """Linear quantile regression (Koenker and Bassett 1978) as a linear program.

    More evidence of trouble never lowers the stated error. With depth it grows as a triangulating camera's noise
    does, by the square: the simulated scenes span too little depth to tell.
    """
    n, k = values.shape
    cost = np.concatenate([np.zeros(k), np.full(n, QUANTILE), np.full(n, 1 - QUANTILE)])
    equal = sparse.hstack([values, sparse.eye(n), -sparse.eye(n)])
    bounds = [(None, None), (2, 2)] + [(0, None)] * (k - 2 + 2 * n)
    return linprog(cost, A_eq=equal, b_eq=log_error, bounds=bounds, method="highs").x[:k]


if __name__ == "__main__":
    main()
