"""An episode as a Rerun recording, with a blueprint that opens well."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr

from flowlab.files import output_file
from flowlab.geometry.moving import MOVING_IN_PLAN_M
from flowlab.geometry.transforms import rotation_from_6d
from flowlab.records import Episode, FlowPrediction
from flowlab.text import one_line
from flowlab.viz.blueprint import CHECKS, INFO, make_blueprint, scene_size
from flowlab.viz.captions import describe, describe_checks
from flowlab.viz.colors import PREDICTED_RGB, SERIES_RGB, SUCCESS_RGB, cloud_rgb_at
from flowlab.viz.plan_predictions import PREDICTED_M, PlanPrediction, plan_predictions, prediction_errors
from flowlab.viz.recorded_pictures import send_camera, send_pictures
from flowlab.viz.recorded_tracks import send_errors, send_tracks, time_columns
from flowlab.viz.stated_error import COARSE_M, SIGMA_RGB, is_coarse, stated_sigma

_MOST_CLOUD_POINTS, _FEWEST_CLOUD_POINTS = 80_000, 256
"""Of all steps together, and of each: what keeps a recording small."""
_LEGEND = (
    "The bright yellow lines, which end in dots, are where the policy predicted the points to go when it made its last "
    f"plan, step by step; points predicted to stay within {1000 * PREDICTED_M:.0f} mm have none. The flow error is how "
    "far from there the points truly were at each step, on average over those that move more than "
    f"{1000 * MOVING_IN_PLAN_M:.0f} mm under the plan."
)


def write_rrd(
    episode: Episode, path: Path, *, name: str, about: str = "", prediction: FlowPrediction | None = None
) -> None:
    """Write a ``.rrd`` that opens in any Rerun viewer. ``path`` is either absent, as before, or whole.

    ``name`` is what the viewer calls the recording; ``about`` is Markdown put above the facts in its info panel.
    What a policy has ``prediction`` is drawn from the step of each plan to that of the next.
    All positions are meters in the world frame of the episode.
    """
    recording = rr.RecordingStream("flowlab")
    plans = [] if prediction is None else plan_predictions(episode, prediction)
    errors = list(prediction_errors(plans))
    stream = recording.binary_stream()  # Rerun's own files are cut off without a word where a disk is full
    try:
        with _strict():
            recording.send_blueprint(make_blueprint(episode, flow_error=bool(errors)), make_active=False)
            recording.send_recording_name(one_line(name))
            for send in (
                _send_cloud,
                send_tracks,
                send_errors,
                send_camera,
                send_pictures,
                _send_object,
                _send_scalars,
            ):
                send(recording, episode)
            if plans:
                _send_predictions(recording, episode, plans)
            if errors:
                _send_flow_error(recording, episode, errors)
            legend = f"\n\n{_LEGEND}" if plans else ""
            _send_text(recording, INFO, f"{about}\n\n{describe(episode)}{legend}")
            if checks := describe_checks(episode):
                _send_text(recording, CHECKS, checks)
            content = stream.read()
    finally:
        recording.disconnect()
    with output_file(path) as temporary:
        temporary.write_bytes(content or b"")


@contextmanager
def _strict() -> Iterator[None]:
    """Makes Rerun raise what it otherwise warns of, leaving data out."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)


def _send_text(recording: rr.RecordingStream, panel: str, text: str) -> None:
    """A panel of text."""
    recording.log(panel, rr.TextDocument(text.strip(), media_type=rr.MediaType.MARKDOWN), static=True)


def _send_cloud(recording: rr.RecordingStream, episode: Episode) -> None:
    """The cloud of every step; in long episodes a coarser one, which the first of farthest-point samples are."""
    steps = range(len(episode))
    most = max(_FEWEST_CLOUD_POINTS, _MOST_CLOUD_POINTS // len(episode))
    points = [episode.point_cloud[t, : min(most, episode.point_count[t])] for t in steps]
    colors = [cloud_rgb_at(episode, t)[:most] for t in steps]
    columns = rr.Points3D.columns(positions=np.concatenate(points), colors=np.concatenate(colors))
    recording.send_columns("/world/cloud", time_columns(episode), columns.partition([len(p) for p in points]))
    recording.log("/world/cloud", rr.Points3D.from_fields(radii=0.0025 * scene_size(episode)), static=True)


def _send_predictions(recording: rr.RecordingStream, episode: Episode, plans: Sequence[PlanPrediction]) -> None:
    """The paths that each plan predicts; one that predicts none clears those of the plan before."""
    drawn = [plan.predicted_world[:, plan.predicted_moving].swapaxes(0, 1) for plan in plans]
    times = time_columns(episode, [plan.step for plan in plans])
    counts = [len(paths) for paths in drawn]
    strips = rr.LineStrips3D.columns(strips=[path for paths in drawn for path in paths])
    ends = rr.Points3D.columns(positions=np.concatenate([paths[:, -1] for paths in drawn]))
    recording.send_columns("/world/predicted/paths", times, strips.partition(counts))
    recording.send_columns("/world/predicted/ends", times, ends.partition(counts))
    thin, small = 0.0008 * scene_size(episode), 0.0022 * scene_size(episode)
    recording.log("/world/predicted/paths", rr.LineStrips3D.from_fields(radii=thin, colors=PREDICTED_RGB), static=True)
    recording.log("/world/predicted/ends", rr.Points3D.from_fields(radii=small, colors=PREDICTED_RGB), static=True)


def _send_object(recording: rr.RecordingStream, episode: Episode) -> None:
    """The object's pose at every step, if it is known."""
    if episode.object_pose is None:
        return
    R_world_object = rotation_from_6d(episode.object_pose[:, 3:])
    columns = rr.Transform3D.columns(translation=episode.object_pose[:, :3], mat3x3=R_world_object)
    recording.send_columns("/world/object", time_columns(episode), columns)
    recording.log("/world/object", rr.TransformAxes3D(0.08 * scene_size(episode)), static=True)


def _send_scalars(recording: rr.RecordingStream, episode: Episode) -> None:
    """Lines of state, action, success, and of the quality of tracks."""
    for group, table in (("state", episode.state), ("action", episode.action)):
        for k, column in enumerate(table.T):
            color = SERIES_RGB[k % len(SERIES_RGB)]
            _send_line(recording, episode, f"{group}/{k}", column, name=f"{group} {k}", color=color)
    _send_line(recording, episode, "success", episode.success.astype(float), name="success", color=SUCCESS_RGB)
    if (sigma := stated_sigma(episode)) is not None:
        median, p90 = np.percentile(1000 * sigma, [50, 90], axis=1)
        seen = 100 * episode.tracks.visible[:, : episode.queries.count].mean(1)
        for key, values, name, color in [
            ("sigma_median", median, "σ median [mm]", SIGMA_RGB[0]),
            ("sigma_p90", p90, "σ 90th percentile [mm]", SIGMA_RGB[3]),
            ("sigma_below", 100 * (~is_coarse(sigma)).mean(1), f"σ < {1000 * COARSE_M:.0f} mm [%]", SERIES_RGB[0]),
            ("visible", seen, "in sight [%]", SUCCESS_RGB),
        ]:
            _send_line(recording, episode, f"quality/{key}", values, name=name, color=color)


def _send_flow_error(recording: rr.RecordingStream, episode: Episode, errors: Sequence[tuple[int, float]]) -> None:
    """The line of flow errors."""
    steps, error = zip(*errors, strict=True)
    values, name = 1000 * np.array(error), "flow error [mm]"
    _send_line(recording, episode, "flow_error", values, name=name, color=PREDICTED_RGB, steps=steps)


def _send_line(
    recording: rr.RecordingStream,
    episode: Episode,
    key: str,
    values: np.ndarray,
    *,
    name: str,
    color: tuple[int, ...],
    steps: Sequence[int] | None = None,
) -> None:
    """One line of a plot: a value for each of some steps, or of all."""
    recording.log(f"/scalars/{key}", rr.SeriesLines(names=name, colors=color, widths=1.5), static=True)
    recording.send_columns(f"/scalars/{key}", time_columns(episode, steps), rr.Scalars.columns(scalars=values))
