"""Stand-ins for CoTracker and tapnet: the calling contracts of their public code, without their networks.

They take what the real ones take, refuse what those refuse (and what those would silently get wrong), and find
points by looking: in clips of dots the color at the queried pixel, followed as the center of everything of that
color, else by optical flow. A wrong order of coordinates, scale, frame or channel finds something else, or nothing.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn.functional import interpolate, one_hot

from flowlab.geometry.camera import Camera
from flowlab.records import Clip

RED, GREEN, BLUE = 0, 1, 2
SIZE = (96, 60)
"""Width and height of the clips; not square, so that x and y cannot be swapped unseen."""


def dots(frames: int = 40, hidden: range = range(0), size: tuple[int, int] = SIZE) -> tuple[Clip, np.ndarray]:
    """A clip of a red and a green dot on curved ways, and their centers (T, 2, 2) in pixels.

    The red dot is not drawn in frames ``hidden``. A blue one stands where the red one goes mirrored (x for y).
    """
    t = np.arange(frames)
    w, h = size
    red = np.stack([w * (0.2 + 0.6 * t / frames), h * (0.5 + 0.25 * np.sin(t / 9))], -1)
    green = np.stack([w * (0.7 - 0.3 * t / frames), h * (0.3 + 0.3 * t / frames)], -1)
    v, u = np.mgrid[:h, :w]

    def drawn(at: np.ndarray) -> np.ndarray:
        return np.exp(-((u - at[:, None, None, 0]) ** 2 + (v - at[:, None, None, 1]) ** 2) / (2 * 2.5**2))

    rgb = np.stack([drawn(red), drawn(green), drawn(red[:, ::-1])], -1)
    rgb[list(hidden), ..., RED] = 0
    camera = Camera(w, h, np.array([[w, 0, w / 2], [0, w, h / 2], [0, 0, 1.0]]), np.eye(4))
    depth = np.ones((frames, h, w), np.float32)
    return Clip(np.round(255 * rgb).astype(np.uint8), depth, camera), np.stack([red, green], 1)


def _color(picture: torch.Tensor, column: float, row: float) -> int | None:
    """Which of the two colors the (H, W, 3) picture shows at a pixel."""
    if not (0 <= round(row) < picture.shape[0] and 0 <= round(column) < picture.shape[1]):
        return None
    pixel = picture[round(row), round(column)]
    channel = int(pixel.argmax())
    return channel if pixel[channel] > 0.3 and channel != BLUE else None


def _center(picture: torch.Tensor, color: int | None) -> tuple[torch.Tensor, bool]:
    """Where (column, row) the center of a color is, and whether there is any of it."""
    weight = torch.zeros(picture.shape[:2]) if color is None else picture[..., color].clamp(min=0.02) - 0.02
    columns, rows = weight.sum(0), weight.sum(1)
    if rows.sum() < 1:
        return torch.zeros(2), False
    at = [values @ torch.arange(len(values), dtype=torch.float32) for values in (columns, rows)]
    return torch.stack(at) / rows.sum(), True


def _followed(video: torch.Tensor, queries_txy: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (T, N, 2) and visibility (T, N) in a (T, H, W, 3) video of 0 to 1, of queries (N, 3).

    Other pictures than those of :func:`dots` are followed by optical flow.
    """
    if float(video[0].median()) > 0.1:
        return _flowed(video, queries_txy)
    colors = [_color(video[int(t)], x, y) for t, x, y in queries_txy.tolist()]
    centers = [{color: _center(picture, color) for color in set(colors)} for picture in video]
    found = [[at[color] for color in colors] for at in centers]
    xy = torch.stack([torch.stack([at for at, _ in row]) for row in found])
    return xy, torch.tensor([[seen for _, seen in row] for row in found])


def _flowed(video: torch.Tensor, queries_txy: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    gray = (255 * video.mean(-1)).round().byte().numpy()
    since, xy = queries_txy[:, 0].numpy(), np.repeat(queries_txy[None, :, 1:].numpy(), len(gray), 0)
    for k in range(1, len(gray)):
        going = since < k
        if going.any():
            at = np.ascontiguousarray(xy[k - 1, going])
            xy[k, going] = cv2.calcOpticalFlowPyrLK(gray[k - 1], gray[k], at, None, winSize=(15, 15))[0]
    return torch.from_numpy(xy), torch.ones(xy.shape[:2], dtype=torch.bool)


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise RuntimeError(f"contract: {what}")


# CoTracker: facebookresearch/co-tracker, cotracker/predictor.py and hubconf.py


class _CoTrackerModel(nn.Module):
    """Has a parameter without which nothing is right, and one whose shape and name tell the variants apart."""

    def __init__(self, v2: bool, window_len: int) -> None:
        super().__init__()
        self.window_len = window_len
        self.scale = nn.Parameter(torch.zeros(1))
        self.register_buffer("time_emb", torch.zeros(1, window_len, 456 if v2 else 1110))
        if v2:
            self.register_buffer("pos_emb", torch.zeros(1))


def _check_cotracker(video: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    """The (T, H, W, 3) video of 0 to 1."""
    _require(video.ndim == 5 and video.shape[2] == 3, f"video is (B, T, 3, H, W), found {tuple(video.shape)}")
    _require(video.shape[0] == 1, "a view of a batch of 2 is not contiguous")
    _require(video.dtype == torch.float32, f"video is float32, found {video.dtype}")
    _require(1 < float(video.max()) <= 255 and float(video.min()) >= 0, "video is 0 to 255")
    _require(queries.ndim == 3 and queries.shape[0] == 1 and queries.shape[2] == 3, "queries are (1, N, 3)")
    _require(queries.dtype == torch.float32, f"queries are float32, found {queries.dtype}")
    _require(video.shape[1] > 1, "A tracker needs at least two frames to track something")
    return video[0].permute(0, 2, 3, 1) / 255


class CoTrackerPredictor(nn.Module):
    def __init__(
        self, checkpoint: Any = "scaled_offline.pth", offline: bool = True, v2: bool = False, window_len: int = 60
    ) -> None:
        super().__init__()
        _require(checkpoint is None, "there is no file of weights to open")
        self.v2 = v2
        self.model = _CoTrackerModel(v2, window_len)

    def forward(
        self,
        video: torch.Tensor,
        queries: torch.Tensor,
        segm_mask: Any = None,
        grid_size: int = 0,
        grid_query_frame: int = 0,
        backward_tracking: bool = False,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        pictures, asked = _check_cotracker(video, queries), queries[0]
        frame = asked[:, 0].long()
        if ((frame < 0) | (frame >= len(pictures))).any():
            raise IndexError(f"index {frame.tolist()} is out of bounds for dimension 0 with size {len(pictures)}")
        xy, visible = _followed(pictures, asked)
        xy[frame, torch.arange(len(asked))] = asked[:, 1:]
        visible[frame, torch.arange(len(asked))] = True
        return (xy * self.model.scale)[None], visible[None]


class CoTrackerOnlinePredictor(nn.Module):
    def __init__(
        self, checkpoint: Any = "scaled_online.pth", offline: bool = False, v2: bool = False, window_len: int = 16
    ) -> None:
        super().__init__()
        _require(checkpoint is None, "there is no file of weights to open")
        self.model = _CoTrackerModel(v2, window_len)
        self.step = window_len // 2
        self.queries: torch.Tensor | None = None

    def forward(
        self,
        video_chunk: torch.Tensor,
        is_first_step: bool = False,
        queries: torch.Tensor | None = None,
        grid_size: int = 5,
        grid_query_frame: int = 0,
        add_support_grid: bool = False,
    ) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        if is_first_step:
            assert queries is not None, "the real one would follow a grid of its own"
            _check_cotracker(video_chunk, queries)
            self.queries, self.seen, self.grid = queries, video_chunk[:, :0], 36 * add_support_grid
            return None, None
        assert self.queries is not None, "Call model.init_video_online_processing() first."
        assert queries is None, "the real one ignores queries after the first step"
        pictures = _check_cotracker(self._all_frames(video_chunk), self.queries)
        asked = self.queries[0]
        known = asked[:, 0] < len(pictures)
        xy, visible = torch.zeros(len(pictures), len(asked), 2), torch.zeros(len(pictures), len(asked), dtype=bool)
        xy[:, known], visible[:, known] = _followed(pictures, asked[known]) if known.any() else (0, False)
        rest = 0 if add_support_grid else self.grid  # its points come along where the caller does not say again
        xy, visible = (torch.cat([a, torch.zeros_like(a[:, :1]).repeat_interleave(rest, 1)], 1) for a in (xy, visible))
        return (xy * self.model.scale)[None], visible[None]

    def _all_frames(self, chunk: torch.Tensor) -> torch.Tensor:
        assert chunk.shape[1] <= 2 * self.step, "Online mode: video chunk must be <= window size."
        if self.seen.shape[1] == 0:
            self.seen = chunk
        else:
            fresh = chunk.shape[1] - self.step
            _require(fresh > 0, "a window brings at least one frame more than half a window")
            _require(bool((self.seen[:, -self.step :] == chunk[:, : self.step]).all()), "windows go on by half")
            self.seen = torch.cat([self.seen, chunk[:, self.step :]], 1)
        return self.seen


_HUBCONF = """
def _entry(online, **variant):
    def entry(*, pretrained=True, **kwargs):
        from cotracker.predictor import CoTrackerOnlinePredictor, CoTrackerPredictor

        assert not pretrained, "would download"
        return (CoTrackerOnlinePredictor if online else CoTrackerPredictor)(checkpoint=None, **variant)

    return entry


cotracker2 = _entry(False, v2=True, window_len=8)
cotracker2_online = _entry(True, v2=True, window_len=8)
cotracker3_offline = _entry(False, v2=False, window_len=60)
cotracker3_online = _entry(True, v2=False, window_len=16)
"""


def write_cotracker(folder: Path) -> Path:
    """A checkout of the repository: what torch.hub loads, and what can be put on ``sys.path``."""
    (folder / "cotracker").mkdir(parents=True)
    (folder / "cotracker" / "__init__.py").touch()
    names = "CoTrackerOnlinePredictor, CoTrackerPredictor"
    seeding = "import torch\n\ntorch.manual_seed(0)\n"  # as several of the real modules do
    (folder / "cotracker" / "predictor.py").write_text(f"from fake_networks import {names}\n{seeding}")
    (folder / "hubconf.py").write_text(_HUBCONF)
    return folder


def write_cotracker_weights(file: Path, v2: bool, window_len: int) -> Path:
    model = _CoTrackerModel(v2, window_len)
    nn.init.ones_(model.scale)
    file.parent.mkdir(parents=True, exist_ok=True)
    torch.save(model.state_dict(), file)
    return file


# tapnet: google-deepmind/tapnet, tapnet/torch/tapir_model.py and tapnet/tapnext/


def _check_tapnet(video: torch.Tensor) -> None:
    _require(video.ndim == 5 and video.shape[4] == 3, f"video is (B, T, H, W, 3), found {tuple(video.shape)}")
    _require(video.dtype == torch.float32, f"video is float32, found {video.dtype}")
    _require(-1 <= float(video.min()) < 0 and float(video.max()) <= 1, "video is -1 to 1")


class FeatureGrids(NamedTuple):
    lowres: tuple[torch.Tensor, ...]
    hires: tuple[torch.Tensor, ...]
    resolutions: tuple[tuple[int, int], ...]


class QueryFeatures(NamedTuple):
    asked: torch.Tensor


class TAPIR(nn.Module):
    """Its features are the pictures. ``encoded`` counts frames; ``asked`` and ``order`` are of the latest queries."""

    def __init__(self, *, pyramid_level: int = 0, num_pips_iter: int = 4) -> None:
        super().__init__()
        _require(pyramid_level == 1, "the published weights are of pyramid level 1")
        self.num_pips_iter, self.initial_resolution = num_pips_iter, (256, 256)
        self.scale = nn.Parameter(torch.zeros(1))
        self.encoded = 0

    def get_feature_grids(self, video: torch.Tensor, is_training: bool, refinement_resolutions: Any = None) -> Any:
        _check_tapnet(video)
        self.encoded += video.shape[1]
        size = tuple(video.shape[2:4])
        _require(size[0] % 8 == 0 and size[1] % 8 == 0, "Image resolution must be a multiple of 8.")
        sizes = [self.initial_resolution, self.initial_resolution] + ([size] if size != (256, 256) else [])
        pictures = video[0].permute(0, 3, 1, 2)
        grids = [interpolate(pictures, s, mode="bilinear", align_corners=False) for s in sizes]
        grids = tuple((g.permute(0, 2, 3, 1)[None] + 1) / 2 for g in grids)
        return FeatureGrids(grids, grids, tuple(sizes))

    def get_query_features(
        self, video: torch.Tensor, is_training: bool, query_points: torch.Tensor, feature_grids: FeatureGrids
    ) -> QueryFeatures:
        _require(query_points.dtype == torch.float32 and query_points.shape[::2] == (1, 3), "queries are (1, N, 3)")
        if video.shape[1] != feature_grids.lowres[0].shape[1]:
            raise ValueError("converting frame count is not supported.")
        self.asked = query_points[0]
        _require(video.shape[1] > 1, "at least two frames")
        _require(bool((self.asked[:, 0] < video.shape[1]).all()), "grid_sample would look at the last frame instead")
        return QueryFeatures(self.asked)

    def estimate_trajectories(
        self,
        video_size: tuple[int, int],
        is_training: bool,
        feature_grids: FeatureGrids,
        query_features: QueryFeatures,
        query_points_in_video: torch.Tensor | None,
        query_chunk_size: int | None = None,
    ) -> dict[str, list[torch.Tensor]]:
        if query_chunk_size is None:
            raise TypeError("'NoneType' object cannot be interpreted as an integer")
        self.order = torch.randperm(len(query_features.asked))  # in which the real one deals queries to its chunks
        out: dict[str, list[torch.Tensor]] = {"tracks": [], "occlusion": [], "expected_dist": []}
        levels = len(feature_grids.lowres) - 1
        for i in range(levels * self.num_pips_iter + 1):
            level, done = divmod(i, self.num_pips_iter)
            for key, value in self._level(feature_grids, query_features.asked, video_size, level).items():
                out[key].append(value if i and not done else torch.full_like(value, torch.nan))
        return out

    def _level(self, grids: FeatureGrids, asked: torch.Tensor, size: tuple[int, int], level: int) -> Any:
        pictures = grids.hires[level][0]
        scale = torch.tensor([pictures.shape[2] / size[1], pictures.shape[1] / size[0]])
        xy, seen = _followed(pictures, torch.cat([asked[:, :1], asked[:, 1:].flip(1) * scale - 0.5], 1))
        raster = xy.transpose(0, 1)[None] + 0.5
        raster += 2 * level - len(grids.lowres)  # so that the mean over levels is right, and none of them where two
        logits = torch.where(seen.T[None], -4.0, 4.0)
        return {"tracks": raster / scale * self.scale, "occlusion": logits, "expected_dist": logits / 2}


@dataclass
class TAPNextTrackingState:
    step: int
    query_points: torch.Tensor
    hidden_state: list[Any]


class TAPNext(nn.Module):
    """Positions are (y, x), as its queries, of a square of 256, whatever the size of the pictures."""

    def __init__(self, image_size: tuple[int, int]) -> None:
        super().__init__()
        _require(image_size == (256, 256), "all published weights have the position embedding of 32 by 32 patches")
        self.image_size = image_size
        self.scale = nn.Parameter(torch.zeros(1))

    def _video_pos_emb(self, h: int, w: int) -> None:
        _require(h == w, "pictures are squares")

    def forward(
        self,
        video: torch.Tensor,
        query_points: torch.Tensor | None = None,
        state: TAPNextTrackingState | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, TAPNextTrackingState]:
        _check_tapnet(video)
        self._video_pos_emb(*video.shape[2:4])
        self.side = video.shape[2]
        finer = self.side / 256
        _require(video.shape[:2] == (1, 1), "the stand-in takes one frame at a time")
        if state is None:
            assert query_points is not None
            state = TAPNextTrackingState(0, query_points, [])
        _require(state.query_points.dtype == torch.float32, "queries are float32")
        self.asked = state.query_points[0]
        pictures = torch.stack([*state.hidden_state, (video[0, 0] + 1) / 2])
        known = self.asked[:, 0] <= state.step
        asked = torch.cat([self.asked[known, :1], self.asked[known, 1:].flip(1) * finer - 0.5], 1)
        yx, seen = torch.zeros(len(known), 2), torch.zeros(len(known), dtype=torch.bool)
        if known.any():
            xy, visible = _followed(pictures, asked)
            yx[known], seen[known] = (xy[-1].flip(1) + 0.5) / finer * self.scale, visible[-1]
        bins = [one_hot(yx[:, k].long().clamp(0, 255), 256) for k in (0, 1)]
        logits = torch.where(seen, 3.0, -3.0)[None, None, :, None]
        after = TAPNextTrackingState(state.step + 1, state.query_points, list(pictures))
        return yx[None, None], 6.0 * torch.cat(bins, -1)[None, None], logits, after


def restore_model_from_jax_checkpoint(model: nn.Module, ckpt_path: str) -> nn.Module:
    model.scale.data.copy_(torch.from_numpy(np.load(ckpt_path)["scale"]))
    return model


def tracker_certainty(coord_yx: torch.Tensor, track_logits: torch.Tensor, radius: int = 8) -> torch.Tensor:
    """Share of the probability that lies near the position: (..., 2) and (..., 512) give (..., 1)."""
    _require(coord_yx.shape[-1] == 2 and track_logits.shape == (*coord_yx.shape[:-1], 512), "(..., 2), (..., 512)")
    near = [
        ((torch.arange(256) + 0.5 - coord_yx[..., k, None]).abs() <= radius) * logits.softmax(-1)
        for k, logits in enumerate(track_logits.chunk(2, -1))
    ]
    return (near[0].sum(-1) * near[1].sum(-1))[..., None]


def write_tapnet(folder: Path) -> Path:
    """The package, to be put on ``sys.path``."""
    modules = {
        "torch/tapir_model.py": "TAPIR",
        "tapnext/tapnext_torch.py": "TAPNext",
        "tapnext/tapnext_torch_utils.py": "restore_model_from_jax_checkpoint, tracker_certainty",
    }
    for name, content in modules.items():
        module = folder / "tapnet" / name
        module.parent.mkdir(parents=True, exist_ok=True)
        (module.parent / "__init__.py").touch()
        module.write_text(f"from fake_networks import {content}\n")
    (folder / "tapnet" / "__init__.py").touch()
    return folder
