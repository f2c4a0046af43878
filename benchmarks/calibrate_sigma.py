"""Fit what tells stated errors on simulated recordings, and check it on others.

    python benchmarks/calibrate_sigma.py --recordings DIR

Simulates tasks that no benchmark grades and films procedural scenes of the families that are not held out, and labels
them with both trackers that need no weights. Two error models (``flowlab.tracking.error_model``) are fitted and written
into their packages: of positions that ``rigid-bodies`` carries, and of those that are measured or filled. Each is some
forests of boosted trees: a quantile of the error, and the log-odds that it is above 2 cm, or 15. Tasks and families of
scenes weigh the same, and so do the films of each. What is printed is of films that the trees were not fitted to: a
fifth of all is left out, five times; then each family, and the tasks. Needs OpenGL for color, and LightGBM (``pip
install --group benchmark``).
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightgbm
import numpy as np

from flowlab.errors import DataError
from flowlab.grading import ground_truth
from flowlab.grading.grade import read_clip
from flowlab.grading.scenes.families import making_films
from flowlab.grading.scenes.film import CameraMotion, FilmSettings, make_film
from flowlab.grading.simulate import SimulatedRecording, simulate_recording
from flowlab.records import PositionSource
from flowlab.sim.sensor import CLEAN, KINECT
from flowlab.tracking import uncertainty
from flowlab.tracking.base import make_tracker
from flowlab.tracking.boosted_trees import BoostedTrees
from flowlab.tracking.chunking import ChunkSettings, follow
from flowlab.tracking.error_model import FAR_M, Doubt, ErrorModel, log_scale
from flowlab.tracking.lifting import LiftSettings, lift
from flowlab.tracking.trackers.rigid_bodies import doubt
from flowlab.tracking.trackers.rigid_bodies.tracker import COMPANION, RigidBodies, combined, fit_points

TASKS = (
    "button-press", "coffee-push", "dial-turn", "handle-press", "lever-pull", "peg-insert-side", "plate-slide",
    "stick-push", "sweep", "window-open",
)  # fmt: skip
"""None of the eight that accuracy is reported on."""
SEEDS: dict[CameraMotion | None, range] = {
    None: range(30), "traveling": range(12), "traveling, poses known": range(12, 16)
}  # fmt: skip
"""Of the films of each family of scenes, by camera: as the seed draws it, or carried past the scene."""
_LATER = ("flat", "rolling", "swarm", "large")
_SEEDS_LATER: dict[CameraMotion | None, range] = {
    None: range(16), "traveling": range(4), "traveling, poses known": range(14, 16)
}  # fmt: skip
"""Families that were added once the others had been filmed have fewer films."""
_FOLDS = 5
"""By how many fits, each without a part of the films, the models are checked."""
_KEPT = 8000
"""Positions of a film by a tracker at most, drawn of them all."""
QUANTILE = 0.50
"""Of the error of all, so that about 70 % of what is not doubted is below what is stated: what is likely to be far off,
of which more is stated, has the large errors."""
DOUBTS = {
    True: {
        FAR_M: ((-4.5, -4.0, -2.5, 0.5), (0.0, 0.03, 0.04, 0.05)),
        0.15: ((-6.2, -5.7, -4.5, -2.5), (0.0, 0.03, 0.10, 0.40)),
    },
    False: {FAR_M: ((-2.5, -1.5, 0.0, 1.0, 2.0), (0.0, 0.02, 0.08, 0.20, 0.30))},
}
"""Of what is modeled and what is not, for errors beyond some lengths [m]: see
:attr:`~flowlab.tracking.error_model.Doubt.stated`. Half of all that Lucas-Kanade says is likely far off: were it to
state as much, good labels would be rejected."""
_SAMPLE = 1500
"""Positions of each film."""
_TREES = {
    "num_leaves": 12, "min_data_in_leaf": 300, "learning_rate": 0.07, "lambda_l2": 5.0, "seed": 0, "num_threads": 1,
    "deterministic": True, "force_row_wise": True, "verbosity": -1,
}  # fmt: skip
_ROUNDS = 120
_LEAST_M = 3e-4
"""Less of an error [m] tells nothing: a log would make much of it."""


@dataclass(frozen=True)
class Sample:
    """Positions of one recording by one tracker, all modeled or none."""

    family: str
    """Of scenes, or ``tasks``."""
    carried: bool
    """Whether the camera is."""
    modeled: bool
    evidence: np.ndarray
    """(n, E): of ``rigid-bodies`` where it models them, else of :mod:`flowlab.tracking.uncertainty`."""
    z: np.ndarray
    """Depths [m]."""
    error_m: np.ndarray
    seen: np.ndarray
    """Whether the point is in sight, or said to be."""

    @property
    def group(self) -> str:
        """What it is reported with."""
        return f"{self.family}, carried" if self.carried else self.family


def main() -> None:
    """Make the recordings, print how good the models are, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True, help="folder to keep the recordings in")
    folder: Path = parser.parse_args().recordings
    recordings = [_of_task(folder, task, k) for k, task in enumerate(TASKS)]
    recordings += [
        _of_film(folder, family, seed, camera)
        for camera, seeds in SEEDS.items()
        for family, seed in making_films(seeds)
        if family not in _LATER or seed in _SEEDS_LATER[camera]
    ]
    for modeled, of in ((True, doubt), (False, uncertainty)):
        parts = [[s for s in samples if s.modeled is modeled] for samples in recordings]
        print("modeled" if modeled else "measured or filled")
        parts = [part for part in parts if part]
        _check(parts, [k % _FOLDS for k in range(len(parts))], of.EVIDENCE, "a fifth left out")
        _check(parts, [part[0].family for part in parts], of.EVIDENCE, "all of the family left out")
        with (Path(of.__file__).parent / "error_model.npz").open("wb") as stream:
            _fit([s for part in parts for s in part], of.EVIDENCE).write(stream)


def _of_task(folder: Path, task: str, k: int) -> list[Sample]:
    found = []
    for sensor in (KINECT, CLEAN) if k % 3 == 0 else (KINECT,):
        recording = folder / f"{task}-{'clean' if sensor is CLEAN else 'kinect'}"
        simulate_recording(recording, task, 100 + k, SimulatedRecording(sensor=sensor))
        found += _collect(recording, "tasks", False)
    return found


def _of_film(folder: Path, family: str, seed: int, camera: CameraMotion | None) -> list[Sample]:
    recording = folder / f"{family}{'' if camera is None else '-carried'}-{seed}"
    make_film(recording, family, seed, FilmSettings(camera=camera))
    return _collect(recording, family, camera is not None)


def _collect(recording: Path, family: str, carried: bool) -> list[Sample]:
    """The positions of a recording by both trackers, but for the first frame's."""
    print(recording.name, flush=True)
    try:
        clip, truth = read_clip(recording), ground_truth.read(recording)
    except DataError as error:
        print(f"    left out: {error}")
        return []
    options = RigidBodies()
    followed, companion = (
        follow(clip, truth.query_px, make_tracker("lucas-kanade"), chunks) for chunks in (ChunkSettings(), COMPANION)
    )
    fitted = fit_points(clip, truth.query_px, companion, options)
    against = np.zeros((*truth.visible.shape, len(doubt.EVIDENCE)))
    if fitted is not None:
        against[:, fitted.points] = fitted.evidence
    samples = []
    for tracks in (followed, combined(clip, companion, fitted, options.unexplained)):
        lifted = lift(clip, tracks, LiftSettings())
        xyz_cam = clip.to_camera(lifted.xyz_world.astype(np.float64))
        error_m = np.linalg.norm(xyz_cam - truth.tracks_cam, axis=-1)
        seen, by_model = truth.visible | lifted.visible, lifted.source == PositionSource.MODEL
        for modeled, values in ((False, uncertainty.evidence(clip, tracks, lifted)), (True, against)):
            mine = (by_model == modeled) & (np.arange(len(clip)) > 0)[:, None]
            if mine.any():
                kept = np.random.default_rng(0).permutation(mine.sum())[:_KEPT]
                columns = (x[mine][kept] for x in (values.astype(np.float32), xyz_cam[..., 2], error_m, seen))
                samples.append(Sample(family, carried, modeled, *columns))
    return samples


def _by_family(samples: Sequence[Sample]) -> list[list[Sample]]:
    return [[s for s in samples if s.family == name] for name in dict.fromkeys(s.family for s in samples)]


def _check(parts: list[list[Sample]], fold: Sequence[object], grows: Mapping[str, int], how: str) -> None:
    """Print how good models are on recordings that they are not fitted to: of one fold after the other."""
    stated = []
    for out in dict.fromkeys(fold):
        model = _fit([s for part, k in zip(parts, fold, strict=True) if k != out for s in part], grows)
        left = [s for part, k in zip(parts, fold, strict=True) if k == out for s in part]
        stated += [(s, _stated(model, s)) for s in left]
    print(how)
    for group in dict.fromkeys(s.group for s, _ in stated):
        _report(group, [(s, sigma) for s, sigma in stated if s.group == group])


def _fit(samples: Sequence[Sample], grows: Mapping[str, int]) -> ErrorModel:
    doubts = DOUBTS[samples[0].modeled].items()
    return ErrorModel(
        _fit_trees(samples, grows),
        tuple(Doubt(_fit_trees(samples, grows, far), np.array(least)) for far, least in doubts),
    )


def _fit_trees(samples: Sequence[Sample], grows: Mapping[str, int], beyond_m: float | None = None) -> BoostedTrees:
    """Trees of the log-odds of an error beyond a length of positions in sight or said to be, or of a quantile of the
    log of the error of all: of its mean where it is below 2 cm, and so much more."""
    rng, rows, targets, weights = np.random.default_rng(0), [], [], []
    for mine in _by_family(samples):
        for sample in mine:
            pick = rng.permutation(np.flatnonzero(sample.seen | (beyond_m is None)))[:_SAMPLE]
            error = sample.error_m[pick]
            log_error = np.log(np.clip(error, _LEAST_M, FAR_M)) - log_scale(sample.z[pick])
            rows.append(sample.evidence[pick])
            targets.append(log_error if beyond_m is None else error > beyond_m)
            weights.append(np.full(len(pick), 1e4 / _SAMPLE / len(mine)))
    evidence, target, weight = (np.concatenate(x) for x in (rows, targets, weights))
    settings = {"objective": "regression" if beyond_m is None else "binary"} | _TREES
    settings["monotone_constraints"] = list(grows.values())
    booster = lightgbm.train(settings, lightgbm.Dataset(evidence, target, weight=weight), _ROUNDS)
    trees = _as_arrays(booster.dump_model()["tree_info"])
    np.testing.assert_allclose(trees(evidence), booster.predict(evidence, raw_score=True), rtol=1e-4, atol=1e-4)
    if beyond_m is not None:
        return trees
    off = target - trees(evidence)
    order = np.argsort(off)
    more = off[order][np.searchsorted(np.cumsum(weight[order]), QUANTILE * weight.sum())]
    first = np.arange(len(trees.value)) < np.append(trees.root, len(trees.value))[1]
    return replace(trees, value=trees.value + np.float32(more) * (first & (trees.column < 0)))


def _as_arrays(trees: Sequence[dict[str, Any]]) -> BoostedTrees:
    """LightGBM's trees; the value that it begins with is in the leaves of its first."""
    nodes: list[tuple[int, float, int, int, float]] = []

    def add(node: dict[str, Any]) -> int:
        place = len(nodes)
        nodes.append((-1, 0.0, 0, 0, node.get("leaf_value", 0.0)))
        if "split_feature" in node:
            assert node["decision_type"] == "<="
            left, right = add(node["left_child"]), add(node["right_child"])
            nodes[place] = (node["split_feature"], node["threshold"], left, right, 0.0)
        return place

    root = [add(tree["tree_structure"]) for tree in trees]
    column, threshold, left, right, value = zip(*nodes, strict=True)
    return BoostedTrees(
        np.array(root, np.int32), np.array(column, np.int16), np.array(threshold), np.array([left, right], np.int32).T,
        np.array(value, np.float32),
    )  # fmt: skip


def _stated(model: ErrorModel, sample: Sample) -> np.ndarray:
    if sample.modeled:
        return doubt.stated_error(sample.evidence, sample.z, model)
    return model.stated_error(sample.evidence, sample.z)


def _report(group: str, stated: Sequence[tuple[Sample, np.ndarray]]) -> None:
    """What is stated of positions of films that it was not fitted to, in the mean over these."""
    below, wrong, doubted = [], [], []
    for sample, sigma in stated:
        error, seen = sample.error_m, sample.seen
        below.append((error < sigma).mean())
        wrong.append(((error > FAR_M) & (error > 4 * sigma))[seen].mean() if seen.any() else 0.0)
        near = seen & (error <= FAR_M)
        doubted.append((sigma[near] > FAR_M).mean() if near.any() else 0.0)
    print(
        f"# {group}, {len(below)} times: {np.mean(below):.2f} below, {np.mean(wrong):.2%} confidently wrong, "
        f"{np.max(wrong):.1%} at the worst, {np.mean(doubted):.2f} of what is near said to be far"
    )


if __name__ == "__main__":
    main()
