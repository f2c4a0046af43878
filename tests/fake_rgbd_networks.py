"""Stand-ins for TAPIP3D and both SpatialTrackers: the calling contracts of their public code, without their networks.

Like those of :mod:`fake_networks` they refuse what the real ones refuse or would silently get wrong, and find points
by looking. Where a point is in depth they read from the depth they are given.
"""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from fake_networks import SIZE, _followed, _require, dots
from torch import nn
from torch.nn.functional import interpolate

from flowlab.geometry.camera import Camera
from flowlab.records import Clip

SLOPE = 0.002
"""By which the plane of :func:`slanted` is farther away for every pixel to the right [m]."""


def slanted(frames: int = 20, size: tuple[int, int] = SIZE, **options: Any) -> tuple[Clip, np.ndarray, np.ndarray]:
    """The clip of dots before a slanted plane, by a camera that moves in the world; their centers (T, 2, 2) in
    pixels, and in the camera (T, 2, 3). Focal lengths differ, as does nothing else that x and y might share."""
    clip, xy = dots(frames, size=size, **options)
    w, h = size
    camera = Camera(w, h, np.array([[1.1 * w, 0, 0.45 * w], [0, 1.3 * w, 0.55 * h], [0, 0, 1.0]]), np.eye(4))
    depth = np.broadcast_to((1 + SLOPE * np.arange(w)).astype(np.float32), clip.depth.shape).copy()
    xyz = camera.unproject(xy, 1 + SLOPE * xy[..., 0])
    return Clip(clip.rgb, depth, camera, _poses(frames)), xy, xyz


def _poses(frames: int) -> np.ndarray:
    angle = 0.3 + 0.02 * np.arange(frames)
    c, s, T = np.cos(angle), np.sin(angle), np.tile(np.eye(4), (frames, 1, 1))
    T[:, 0, 0], T[:, 0, 2], T[:, 2, 0], T[:, 2, 2] = c, s, -s, c
    T[:, :3, 3] = np.stack([0.1 * angle, 0 * angle + 0.5, angle], -1)
    return T


def _depth_at(depth: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """Depth (T, N) of (T, H, W) at pixels (T, N, 2), between them."""
    size = torch.tensor([depth.shape[2], depth.shape[1]])
    grid = ((xy + 0.5) / size * 2 - 1)[:, :, None].float()
    found = nn.functional.grid_sample(depth[:, None].float(), grid, align_corners=False, padding_mode="border")
    return found[:, 0, :, 0]


def _check_video(video: torch.Tensor, shape: tuple[int, ...], most: int) -> None:
    _require(tuple(video.shape) == shape, f"video is {shape}, found {tuple(video.shape)}")
    _require(video.dtype == torch.float32, f"video is float32, found {video.dtype}")
    _require(most / 2 < float(video.max()) <= most and float(video.min()) >= 0, f"video is 0 to {most}")


# TAPIP3D: zbw001/TAPIP3D, models/__init__.py, models/point_tracker_3d.py, utils/inference_utils.py


class PointTracker3D(nn.Module):
    """Looks where a query's place in the world is in the picture, and says where in the world that is afterwards."""

    seq_len = 16

    def __init__(self, image_size: Any) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(1))
        self.image_size, self.mode = tuple(image_size), "local"

    def set_image_size(self, size: tuple[int, int]) -> None:
        self.image_size = size

    def set_eval_mode(self, mode: str) -> None:
        assert mode in ("raw", "local")
        self.mode = mode

    def forward(
        self,
        *,
        rgb_obs: torch.Tensor,
        depth_obs: torch.Tensor,
        num_iters: int,
        query_point: torch.Tensor,
        intrinsics: torch.Tensor,
        extrinsics: torch.Tensor,
        mode: str,
        depth_roi: torch.Tensor,
    ) -> tuple[Any, list[Any]]:
        _, frames, _, h, w = rgb_obs.shape
        assert mode == "inference"
        _require(self.mode == "raw", "local mode follows in each query's camera")
        assert self.image_size == rgb_obs.shape[-2:]
        _check_video(rgb_obs, (1, frames, 3, h, w), 1)
        _require(depth_obs.shape == (1, frames, h, w) and depth_obs.dtype == torch.float32, "depth is (1, T, H, W)")
        _require(intrinsics.shape == (1, frames, 3, 3) and extrinsics.shape == (1, frames, 4, 4), "for every frame")
        _require(query_point.dtype == torch.float32 and query_point.shape[::2] == (1, 4), "queries are (1, N, 4)")
        _require(frames >= self.seq_len, "in fewer frames than a window no point moves")
        _require(0 < float(depth_roi[0]) < 1e-3 and float(depth_roi[1]) >= float(depth_obs.median()), "range of depth")
        self.asked = query_point[0]
        t, K, T_cam_world = query_point[0, :, 0].long(), intrinsics[0], extrinsics[0]
        local = (T_cam_world[t, :3, :3] @ query_point[0, :, 1:, None])[..., 0] + T_cam_world[t, :3, 3]
        pixel = (K[t] @ local[..., None])[..., 0]
        pixel = pixel[:, :2] / pixel[:, 2:]
        read = _depth_at(depth_obs[0, t], pixel[:, None])[:, 0]
        _require(bool(((read - local[:, 2]).abs() < 0.02).all()), "a query lies on the surface that depth shows there")
        xy, seen = _followed(rgb_obs[0].permute(0, 2, 3, 1), torch.cat([t[:, None].float(), pixel], 1))
        rays = torch.cat([xy, torch.ones_like(xy[..., :1])], -1) @ torch.linalg.inv(K).transpose(1, 2)
        at = rays * _depth_at(depth_obs[0], xy)[..., None]
        T = torch.linalg.inv(T_cam_world)
        world = at @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
        logits = torch.where(seen, 4.0, 1.0)  # of which 1.0, a chance of 0.73, is not yet visible
        return SimpleNamespace(coords=(world * self.scale)[None], visibs=logits[None]), []


def from_config(cfg: Any, image_size: Any) -> nn.Module:
    assert cfg["name"] == "point_tracker_3d"
    _require(not cfg["encoder"]["pretrained"], "would download CoTracker's weights through torch.hub")
    return PointTracker3D(image_size)


def get_grid_queries(
    grid_size: int, depths: torch.Tensor, intrinsics: torch.Tensor, extrinsics: torch.Tensor
) -> torch.Tensor:
    _require(depths.shape[0] == 1 and intrinsics.ndim == 4 and extrinsics.ndim == 4, "with a batch of 1")
    h, w = depths.shape[2:]
    u, v = np.meshgrid(np.linspace(1, w - 2, grid_size).round(), np.linspace(1, h - 2, grid_size).round())
    ray = torch.from_numpy(np.stack([u.ravel(), v.ravel(), np.ones(u.size)], -1)).float()
    z = depths[0, 0][ray[:, 1].long(), ray[:, 0].long()]
    local = (ray @ torch.linalg.inv(intrinsics[0, 0]).T) * z[:, None]
    T = torch.linalg.inv(extrinsics[0, 0])
    return torch.cat([torch.zeros(len(z), 1), local @ T[:3, :3].T + T[:3, 3]], 1)[None][:, z > 0]


_OMEGACONF = {
    "__init__": "from contextlib import contextmanager\n\n\n@contextmanager\ndef open_dict(cfg):\n"
    "    cfg.open = True\n    yield\n    cfg.open = False\n",
    "base": "class Metadata: pass\nclass ContainerMetadata: pass\n",
    "nodes": "class AnyNode: pass\n",
    "listconfig": "class ListConfig:\n"
    "    def __init__(self, values):\n        self.values = list(values)\n"
    "    def __getitem__(self, index):\n        return self.values[index]\n",
    "dictconfig": "class DictConfig:\n"
    "    def __init__(self, values):\n        self.values = values\n"
    "    def __getitem__(self, key):\n        value = self.values[key]\n"
    "        if isinstance(value, DictConfig): value.open = getattr(self, 'open', False)\n        return value\n"
    "    def __contains__(self, key):\n        return key in self.values\n"
    "    def __setitem__(self, key, value):\n        assert self.open, 'structs are closed'\n"
    "        self.values[key] = value\n",
}
"""Objects that no file of weights may hold unless it is said that it may, and settings that are closed."""


def write_tapip3d(folder: Path) -> Path:
    """A checkout of the repository, and OmegaConf beside it, to be put on ``sys.path``."""
    _write(folder / "TAPIP3D" / "models" / "__init__.py", "from fake_rgbd_networks import from_config\n")
    _write(
        folder / "TAPIP3D" / "utils" / "inference_utils.py",
        "import models\nfrom fake_rgbd_networks import get_grid_queries\n",
    )
    for name, content in _OMEGACONF.items():
        _write(folder / "site" / "omegaconf" / f"{name}.py", content)
    return folder / "TAPIP3D"


def write_tapip3d_weights(file: Path, resolution: tuple[int, int]) -> Path:
    """As its training writes them; ``omegaconf`` must be importable."""
    from omegaconf.dictconfig import DictConfig
    from omegaconf.listconfig import ListConfig

    model = DictConfig({"name": "point_tracker_3d", "encoder": DictConfig({"pretrained": True})})
    cfg = DictConfig({"model": model, "train_dataset": DictConfig({"resolution": ListConfig(resolution)})})
    torch.save({"cfg": cfg, "weight": {"scale": torch.ones(1)}}, file)
    return file


# SpatialTracker: henry123-boy/SpaTracker, models/spatracker/predictor.py and models/build_spatracker.py


class _SpaTracker(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(1))


class SpaTrackerPredictor(nn.Module):
    def __init__(
        self, checkpoint: str = "spaT_final.pth", interp_shape: tuple[int, int] = (384, 512), seq_length: int = 16
    ) -> None:
        super().__init__()
        checkpoint.rsplit("/", maxsplit=1)[-1].split(".")  # it wants a string
        _require(interp_shape == (384, 512), "the size it was trained on")
        self.interp_shape, self.window = interp_shape, seq_length
        self.model = _SpaTracker()
        with Path(checkpoint).open("rb") as f:
            state = torch.load(f, map_location="cpu")
        if "model" in state:
            state = {**self.model.state_dict(), **{k: v for k, v in state["model"].items() if k == "scale"}}
        self.model.load_state_dict(state)

    def forward(
        self,
        video: torch.Tensor,
        video_depth: torch.Tensor | None = None,
        queries: torch.Tensor | None = None,
        segm_mask: Any = None,
        grid_size: int = 0,
        grid_query_frame: int = 0,
        backward_tracking: bool = False,
        depth_predictor: Any = None,
        wind_length: int = 8,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        frames, _, height, width = video.shape[1:]
        assert video_depth is not None, "would be estimated"
        assert queries is not None, "would follow a grid of its own"
        _check_video(video, (1, frames, 3, height, width), 255)
        _require(video_depth.shape == (frames, 1, height, width), f"depth is (T, 1, H, W), {tuple(video_depth.shape)}")
        _require(float(video_depth.min()) > 0.01, "holes would be nearer than everything")
        _require(queries.shape[::2] == (1, 3) and queries.dtype == torch.float32, "queries are (1, N, 3)")
        _require(wind_length == self.window, "a window of another length than the network's")
        _require(frames > wind_length // 2, "in half a window of frames all positions are 0")
        scale = torch.tensor([self.interp_shape[1] / width, self.interp_shape[0] / height])
        pictures = interpolate(video[0], self.interp_shape, mode="bilinear").permute(0, 2, 3, 1) / 255
        depth = interpolate(video_depth, self.interp_shape, mode="nearest")[:, 0]
        asked = torch.cat([queries[0, :, :1], queries[0, :, 1:] * scale], 1)
        self.asked = asked
        xy, visible = _followed(pictures, asked)
        tracks = torch.cat([xy / scale, _depth_at(depth, xy)[..., None]], -1) * self.model.scale
        return tracks[None], visible[None], queries[..., 0].to(torch.uint8)


# SpatialTrackerV2: henry123-boy/SpaTrackerV2, models/SpaTrackV2/models/predictor.py


class _SpaTrack2(nn.Module):
    def __init__(self, Track_cfg: Any, moge_as_base: bool = False, **settings: Any) -> None:
        super().__init__()
        _require(not moge_as_base, "would download another network for depth")
        _require(not os.path.exists(Track_cfg["base_ckpt"]), "would open a file of its own")
        self.scale = nn.Parameter(torch.zeros(1))


class Predictor(nn.Module):
    def __init__(self, args: Any = None) -> None:
        super().__init__()
        self.spatrack = _SpaTrack2(**args)
        self.S_wind = args["Track_cfg"]["s_wind"]

    def to(self, device: Any) -> None:  # type: ignore[override]
        self.spatrack.to(device)

    def forward(
        self,
        video: torch.Tensor,
        depth: Any = None,
        unc_metric: Any = None,
        intrs: Any = None,
        extrs: Any = None,
        queries: Any = None,
        queries_3d: Any = None,
        iters_track: int = 4,
        full_point: bool = False,
        fps: int = 30,
        track2d_gt: Any = None,
        fixed_cam: bool = False,
        query_no_BA: bool = False,
        stage: int = 0,
        support_frame: int = 0,
        replace_ratio: float = 0.6,
    ) -> tuple[Any, ...]:
        frames, _, height, width = video.shape
        _check_video(video, (frames, 3, height, width), 255)
        _require(frames >= 3, "second differences of two frames are none")
        for values, shape in (
            (depth, (height, width)),
            (unc_metric, (height, width)),
            (intrs, (3, 3)),
            (extrs, (4, 4)),
        ):
            _require(isinstance(values, np.ndarray) and values.shape == (frames, *shape), f"arrays (T, {shape})")
        _require(isinstance(queries, np.ndarray) and queries.shape[1:] == (3,), "np.argsort sorts queries (N, 3)")
        _require(stage == 1 and fixed_cam, "would estimate depth, or the camera, and with them the unit")
        _require(full_point, "queries of unreliable depth would be replaced by others")
        _require(float(depth.min()) > 0.05 and set(np.unique(unc_metric)) <= {0, 1}, "depth, and where it holds")
        self.extrs, self.unc_metric = extrs, unc_metric
        xy, seen = _followed(video.permute(0, 2, 3, 1) / 255, torch.from_numpy(queries).float())
        z = _depth_at(torch.from_numpy(depth), xy)
        rays = torch.cat([xy, torch.ones_like(xy[..., :1])], -1) @ torch.linalg.inv(torch.from_numpy(intrs)).transpose(
            1, 2
        )
        xyz = (rays * z[..., None]).float() * self.spatrack.scale
        vis = (seen.float() * 0.6 + 0.2)[..., None]
        confidence = torch.full_like(vis, 0.75)
        t2d = torch.cat([xy, z[..., None]], -1)
        nothing = torch.zeros(frames, 3, height, width)
        xyz_rgb = torch.cat([xyz, torch.zeros_like(xyz)], -1)
        return (
            torch.from_numpy(extrs),
            torch.from_numpy(intrs),
            nothing,
            nothing[:, 0],
            xyz_rgb,
            t2d,
            vis,
            confidence,
            video,
        )


def write_spatialtracker(folder: Path) -> Path:
    """A checkout of the first version."""
    _write(folder / "models" / "spatracker" / "predictor.py", "from fake_rgbd_networks import SpaTrackerPredictor\n")
    return folder


def write_spatialtracker2(folder: Path) -> Path:
    """A checkout of the second version."""
    code = "from fake_rgbd_networks import Predictor\n"
    _write(folder / "models" / "SpaTrackV2" / "models" / "predictor.py", code)
    return folder


def write_spatialtracker2_weights(folder: Path, **weights: torch.Tensor) -> Path:
    """Weights and settings, as Hugging Face's hub has them."""
    import json

    from safetensors.torch import save_file

    folder.mkdir(parents=True)
    track = {"s_wind": 200, "overlap": 4, "base_ckpt": str(folder)}
    args = {"moge_as_base": True, "backbone_cfg": {}, "ft_cfg": {}, "Track_cfg": track}
    (folder / "config.json").write_text(json.dumps({"args": args}))
    save_file(weights or {"spatrack.scale": torch.ones(1)}, folder / "model.safetensors")
    return folder / "model.safetensors"


def _write(file: Path, content: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
