"""How far labels that were estimated from films are from exact ones of the same points."""

from typing import Any

import numpy as np

from flowlab.geometry.transforms import apply, inverse
from flowlab.grading.ground_truth import GroundTruth
from flowlab.grading.metrics import EstimatedTracks, TrackErrors, TrackMetrics, average, measure
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset


def compare_labels(estimated: Dataset, exact: Dataset) -> dict[str, Any]:
    """The errors of a dataset's labels, averaged over its demonstrations.

    Args:
        estimated: Labels that state their error.
        exact: The same demonstrations and query points in the same order, and who owns each point.

    Returns:
        Of points away from where they started, and of those on objects: median error [mm], share within 20 mm; the
        share of positions that are far off and do not say so; the mean stated error [mm].

    Raises:
        AssertionError: Something but the labels differs.
    """
    pairs = list(zip(estimated, exact, strict=True))
    found = average([_measured(*pair) for pair in pairs])
    sigma = [e.tracks.quality.sigma[1:, : e.queries.count] for e, _ in pairs if e.tracks.quality is not None]
    return {
        "all": _short(found.all),
        "moving": _short(found.moving),
        "object": _short(found.object),
        "confidently_wrong": found.confidently_wrong,
        "median_sigma_mm": float(np.median(np.concatenate([s.ravel() for s in sigma]))) * 1e3,
    }


def _measured(estimated: Episode, exact: Episode) -> TrackMetrics:
    """One demonstration's."""
    for name in ("point_cloud", "state", "action"):
        assert np.array_equal(getattr(estimated, name), getattr(exact, name)), f"{name} differs, not only labels"
    assert np.array_equal(estimated.queries.xyz_world, exact.queries.xyz_world), "the query points differ"
    distinct, camera = slice(exact.queries.count), exact.camera
    to_camera = inverse(camera.T_world_cam)

    def seen(episode: Episode) -> tuple[np.ndarray, np.ndarray]:
        xyz = apply(to_camera, episode.tracks.xyz_world[:, distinct].astype(np.float64)).astype(np.float32)
        return xyz, episode.tracks.visible[:, distinct]

    role = exact.query_role[distinct].astype(np.int8)
    truth = GroundTruth(np.zeros((len(role), 2), np.float32), *seen(exact), role)
    assert estimated.tracks.quality is not None
    stated = EstimatedTracks(*seen(estimated), estimated.tracks.quality.sigma[:, distinct])
    return measure(stated, truth, camera)


def _short(errors: TrackErrors | None) -> dict[str, float] | None:
    return None if errors is None else {"median_mm": errors.median_mm, "within_20mm": errors.within_20mm}
