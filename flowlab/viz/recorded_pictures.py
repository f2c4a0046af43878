"""Camera and pictures in a Rerun recording: upright, and small enough to be sent to somebody."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import rerun as rr
from jaxtyping import Float, Num

from flowlab.geometry.camera import Camera
from flowlab.records import Episode
from flowlab.viz.blueprint import CAMERA, DEPTH, RGB, scene_size
from flowlab.viz.colors import SERIES_RGB
from flowlab.viz.orientation import is_upside_down, world_is_camera_frame
from flowlab.viz.recorded_tracks import time_columns

_LONGEST_COLOR_PX, _LONGEST_DEPTH_PX = 400, 160
"""Of the longer side: larger pictures are made smaller."""
_MOST_PICTURES = 120
"""Of an episode; the steps between keep the picture before them."""
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 75]
_HALF_TURN = np.diag([-1.0, -1, 1])


def send_camera(recording: rr.RecordingStream, episode: Episode) -> None:
    """The camera at every step, and which way is up; one that hangs upside down is turned about its axis."""
    camera = _shown_camera(episode.camera)
    turn = _HALF_TURN if is_upside_down(episode.camera) else np.eye(3)
    axes = rr.ViewCoordinates.RDF if world_is_camera_frame(episode.camera) else rr.ViewCoordinates.RIGHT_HAND_Z_UP
    recording.log("/", axes, static=True)
    if episode.T_world_cam is None:
        T_world_cam = episode.camera.T_world_cam
        pose = rr.Transform3D(translation=T_world_cam[:3, 3], mat3x3=T_world_cam[:3, :3] @ turn)
        recording.log(CAMERA, pose, static=True)
    else:
        T = episode.T_world_cam
        columns = rr.Transform3D.columns(translation=T[:, :3, 3], mat3x3=T[:, :3, :3] @ turn)
        recording.send_columns(CAMERA, time_columns(episode), columns)
        recording.log("/world/camera_path", rr.LineStrips3D([T[:, :3, 3]], colors=SERIES_RGB[-1]), static=True)
    pinhole = rr.Pinhole(
        image_from_camera=camera.K,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.1 * scene_size(episode),
    )
    recording.log(CAMERA, pinhole, static=True)


def send_pictures(recording: rr.RecordingStream, episode: Episode) -> None:
    """Depth and color, whichever there are: of every step, or of every second, third... of long episodes."""
    steps = range(0, len(episode), -(-len(episode) // _MOST_PICTURES))
    times = time_columns(episode, steps)
    if episode.depth is not None:
        depth_mm = [_millimeters(_upright(episode, episode.depth[t])) for t in steps]
        style = rr.EncodedDepthImage.from_fields(meter=1000.0, depth_range=_limits(depth_mm), colormap="viridis")
        recording.log(DEPTH, style, static=True)
        blobs = [_encoded(".png", picture) for picture in depth_mm]
        recording.send_columns(DEPTH, times, rr.EncodedDepthImage.columns(blob=blobs, media_type=_types("png", blobs)))
    if episode.rgb is not None:
        camera = _shown_camera(episode.camera)
        size = camera.width, camera.height
        bgr = [
            cv2.resize(_upright(episode, episode.rgb[t])[..., ::-1], size, None, 0, 0, cv2.INTER_AREA) for t in steps
        ]
        blobs = [_encoded(".jpg", picture, _JPEG) for picture in bgr]
        recording.send_columns(RGB, times, rr.EncodedImage.columns(blob=blobs, media_type=_types("jpeg", blobs)))


def _shown_camera(camera: Camera) -> Camera:
    """The camera of the color pictures: upright, with as many pixels as they have."""
    scale = 1 / max(1, -(-max(camera.width, camera.height) // _LONGEST_COLOR_PX))
    K, width, height = camera.K.copy(), round(camera.width * scale), round(camera.height * scale)
    if is_upside_down(camera):
        K[:2, 2] = [camera.width - 1 - K[0, 2], camera.height - 1 - K[1, 2]]
    stretch = np.array([width / camera.width, height / camera.height])
    K[:2, :2] *= stretch[:, None]
    K[:2, 2] = (K[:2, 2] + 0.5) * stretch - 0.5
    return replace(camera, K=K, width=width, height=height)


def _upright(episode: Episode, picture: Num[np.ndarray, "v u *rgb"]) -> Num[np.ndarray, "v u *rgb"]:
    """A picture as it is to be looked at."""
    return picture[::-1, ::-1] if is_upside_down(episode.camera) else picture


def _millimeters(depth: Float[np.ndarray, "v u"]) -> Num[np.ndarray, "y x"]:
    """A depth picture [m] as millimeters, every n-th pixel where it has many."""
    apart = -(-max(depth.shape) // _LONGEST_DEPTH_PX)
    few = depth[apart // 2 :: apart, apart // 2 :: apart]
    return np.clip(few * 1000 + 0.5, 0, 65535).astype(np.uint16)


def _limits(depth_mm: Sequence[Num[np.ndarray, "y x"]]) -> list[float]:
    """What the colors of depth pictures reach from and to [mm]."""
    known = np.concatenate([picture[picture > 0] for picture in depth_mm])
    return [0.0, float(np.percentile(known, 95)) if len(known) else 1.0]


def _encoded(ending: str, picture: Num[np.ndarray, "v u *bgr"], options: Sequence[int] = ()) -> bytes:
    """The content of a picture's file."""
    return cv2.imencode(ending, np.ascontiguousarray(picture), options)[1].tobytes()


def _types(kind: str, blobs: Sequence[bytes]) -> list[str]:
    return [f"image/{kind}"] * len(blobs)
