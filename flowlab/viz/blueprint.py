"""How a recording opens in the viewer: which views there are, what they show, and from where."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float

from flowlab.records import Episode
from flowlab.viz.orientation import up_from_world

CAMERA = "/world/camera/main"
DEPTH = "/depth"
"""Not below the camera: it has fewer pixels than that."""
RGB = f"{CAMERA}/rgb"
INFO, CHECKS = "/info", "/checks"


def make_blueprint(episode: Episode, *, flow_error: bool = False) -> rrb.Blueprint:
    """The scene large, pictures, a table and plots beside it; ``flow_error`` says whether that is plotted."""
    pictures = [
        rrb.Spatial2DView(origin=origin, contents=[f"+ {entity}"], name=name)
        for origin, entity, name, there in [(CAMERA, RGB, "rgb", episode.rgb), (DEPTH, DEPTH, "depth", episode.depth)]
        if there is not None
    ]
    texts = [rrb.TextDocumentView(origin=INFO, name="info")]
    if "reader" in episode.extras:
        texts.append(rrb.TextDocumentView(origin=CHECKS, name="checks"))
    plots = [_plot("action and success", ["+ /scalars/action/**", "+ /scalars/success"], legend=True)]
    if episode.state.shape[1] > 0:
        plots.insert(0, _plot("state", ["+ /scalars/state/**"], legend=episode.state.shape[1] <= 6))
    if episode.tracks.quality is not None:
        name, percent = "stated error and visibility", rrb.ScalarAxis(range=(0, 100))
        plots.insert(0, _plot(name, ["+ /scalars/quality/**"], legend=True, axis_y=percent))
    if flow_error:
        plots.insert(0, _plot("flow error [mm]", ["+ /scalars/flow_error"], legend=False))
    contents = ["+ /world/**", f"- {RGB}/**"]
    floor = rr.components.Plane3D(up_from_world(episode.camera)[2], _box_up(episode)[0][2])
    scene = rrb.Spatial3DView(
        contents=contents,
        name="scene",
        eye_controls=_eye(episode),
        background=[18, 20, 24],
        line_grid=rrb.LineGrid3D(plane=floor, spacing=0.1, color=[52, 56, 62]),
    )
    side = rrb.Vertical(rrb.Tabs(*pictures, *texts), *plots, row_shares=[4, *[6 / len(plots)] * len(plots)])
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[7, 3]),
        rrb.TimePanel(state="collapsed", timeline="step", fps=20, play_state="playing", loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plot(name: str, contents: list[str], *, legend: bool, axis_y: rrb.ScalarAxis | None = None) -> rrb.TimeSeriesView:
    """A view of lines over time."""
    box = rrb.PlotLegend(rrb.Corner2D.RightBottom, visible=legend)
    return rrb.TimeSeriesView(origin="/scalars", contents=contents, name=name, plot_legend=box, axis_y=axis_y)


def _eye(episode: Episode) -> rrb.EyeControls3D:
    """Looks at the scene from 30 degrees above, from a little beside the camera, so that that shows too."""
    R_up_world = up_from_world(episode.camera)
    low, high = _box_up(episode)
    center = (low + high) / 2
    towards = R_up_world @ episode.camera.T_world_cam[:3, 3] - center
    azimuth, elevation = np.arctan2(towards[1], towards[0]) + 0.6, np.deg2rad(30)
    direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    position = center + scene_size(episode) * np.array(direction)
    return rrb.EyeControls3D(position=position @ R_up_world, look_target=center @ R_up_world, eye_up=R_up_world[2])


def scene_size(episode: Episode) -> float:
    """Length [m] of the scene's box, which dots, lines and axes are scaled by."""
    low, high = _box_up(episode)
    return float(np.linalg.norm(high - low))


def _box_up(episode: Episode) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The corners [m] of a box around nearly all of the first cloud and the tracks (nearly all, where they
    are estimated), in axes of which z points up."""
    cloud = episode.point_cloud[0, : episode.point_count[0]]
    tracks = episode.tracks.xyz_world[:, : episode.queries.count].reshape(-1, 3)
    margin = 0 if episode.tracks.quality is None else 1
    R_world_up = up_from_world(episode.camera).T
    bounds = [np.percentile(cloud @ R_world_up, [2, 98], axis=0)]
    bounds += [np.percentile(tracks @ R_world_up, [margin, 100 - margin], axis=0)]
    return np.min(bounds, (0, 1)), np.max(bounds, (0, 1))
