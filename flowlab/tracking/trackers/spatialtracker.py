"""SpatialTracker (Xiao et al., 2024) and SpatialTrackerV2 (2025), through the predictors of their public code."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from flowlab.errors import UsageError
from flowlab.records import Clip
from flowlab.tracking.base import Session
from flowlab.tracking.trackers.rgbd import Network, Positions, RgbdSession, RgbdTracker, without_holes
from flowlab.tracking.trackers.weights import downloaded, read_weights
from flowlab.untrusted import read_json

_SIZE = (384, 512)
"""Height and width that SpatialTracker resizes to."""
_WINDOW = 12
_VISIBLE = 0.5
"""Of what SpatialTrackerV2 says: its training counts as visible what is above."""
_BIAS = 0.2
"""What SpatialTrackerV2 adds to its own visibility."""


class SpatialTracker(RgbdTracker):
    """SpatialTracker: pixels with depth, followed by features on three planes.

    Contract, as read in ``models/spatracker/predictor.py`` and ``demo.py``: ``predictor(video, video_depth=…,
    queries=…, wind_length=12)`` takes a video (1, T, 3, H, W) of 0 to 255, depth (T, 1, H, W) and queries (1, N, 3) as
    (t, x, y), and gives (1, T, N, 3) as (x, y, depth) and yes-or-no visibility (above 0.9). It multiplies pixel
    coordinates by the ratio of sizes, while its pictures are resized from border to border. A half window of frames
    or fewer gives zeros. No intrinsics are asked for.
    """

    name: ClassVar[str] = "spatialtracker"
    license: ClassVar[str] = "CC-BY-NC 4.0 (code; weights are not mentioned; not for commercial use)"
    github: ClassVar[str] = "henry123-boy/SpaTracker"
    modules: ClassVar[tuple[str, ...]] = ("models.spatracker.predictor",)

    @property
    def weights_url(self) -> str:
        """Where the published weights are: a folder on Google Drive."""
        return "https://drive.google.com/drive/folders/1UtzUJLPhJdUg2XvemXXz1oe6KUQKVjsZ (spaT_final.pth)"

    def restore(self, network: Network, file: Path) -> None:
        """Build the predictor, which opens the file itself but minds no missing weights."""
        weights = read_weights(file)
        code = network.modules["models.spatracker.predictor"]
        with network.code:
            network.model = code.SpaTrackerPredictor(str(file), interp_shape=_SIZE, seq_length=_WINDOW)
        inner = network.model.model
        inner.load_state_dict({k: weights[k] for k in inner.state_dict() if k in weights}, strict=True)

    def session(self, network: Network, clip: Clip, device: str) -> Session:
        """A session."""
        return _First(self, network, clip, device, _WINDOW)

    def _file(self) -> Path:
        """The file of weights, which nothing can download."""
        if self.weights is None:
            raise UsageError(
                f"tracker '{self.name}' needs its weights: download {self.weights_url}, and type --weights FILE"
            )
        return self.weights


class _First(RgbdSession):
    """One call for all frames."""

    def positions(self, clip: Clip, queries_txy: np.ndarray, z: np.ndarray) -> Positions:
        """The predictor's answer: pixels with depth."""
        import torch

        size = np.array([clip.camera.width, clip.camera.height])
        shift = 0.5 - 0.5 * size / _SIZE[::-1]  # from what multiplying does to pixel centers to what resizing does
        video = torch.tensor(clip.rgb).permute(0, 3, 1, 2)[None].to(self._device).float()
        depth = torch.from_numpy(without_holes(clip.depth))[:, None].to(self._device)
        queries = torch.from_numpy((queries_txy + np.array([0, *shift])).astype(np.float32))[None].to(self._device)
        found, visible, _ = self._network.model(video, video_depth=depth, queries=queries, wind_length=_WINDOW)
        xyd, seen = found[0].float().cpu().numpy().astype(float), visible[0].cpu().numpy()
        xyz = clip.camera.at(np.eye(4)).unproject(xyd[..., :2] - shift, xyd[..., 2])
        return Positions(xyz, seen, seen.astype(np.float32))


class SpatialTracker2(RgbdTracker):
    """SpatialTrackerV2, offline, with the recording's own depth and camera in place of those it would estimate.

    Contract, as read in ``inference.py`` and, in forks of the repository, ``models/SpaTrackV2/models/predictor.py``,
    ``SpaTrack.py`` and ``TrackRefiner.py``: the video (T, 3, H, W) is 0 to 255; depth and ``unc_metric`` (1 where
    depth is to be relied on) (T, H, W), ``intrs`` (T, 3, 3), ``extrs`` (T, 4, 4) from camera to world and queries
    (N, 3) as (t, x, y) are numpy arrays. ``stage=1`` takes depth as it is, ``fixed_cam=True`` the camera; without
    ``full_point=True`` queries at unreliable depth are replaced by others. Of nine results the fifth is positions in
    each frame's camera, the seventh and eighth visibility and confidence. It needs three frames.
    """

    name: ClassVar[str] = "spatialtracker2"
    license: ClassVar[str] = (
        "not found for SpatialTrackerV2: see its repository; it holds parts of CoTracker's (CC-BY-NC 4.0, not for "
        "commercial use)"
    )
    github: ClassVar[str] = "henry123-boy/SpaTrackerV2"
    modules: ClassVar[tuple[str, ...]] = ("models.SpaTrackV2.models.predictor",)

    @property
    def weights_url(self) -> str:
        """Where the published weights are; their ``config.json`` must lie beside them."""
        return "https://huggingface.co/Yuxihenry/SpatialTrackerV2-Offline/resolve/main/model.safetensors"

    def restore(self, network: Network, file: Path) -> None:
        """Build the predictor of the settings beside the file, without the network for depth, which is not used."""
        from safetensors.torch import load_model

        settings = read_json(file.with_name("config.json"), f"download it from where {self.weights_url} is")["args"]
        track = {**settings["Track_cfg"], "base_ckpt": ""}
        settings = {**settings, "moge_as_base": False, "Track_cfg": track}
        with network.code:
            network.model = network.modules[self.modules[0]].Predictor(settings)
        missing, _ = load_model(network.model, file, strict=False)
        if lacking := set(missing) & {name for name, _ in network.model.named_parameters()}:
            raise ValueError(f"lacks {len(lacking)} weights, {min(lacking)} among them")

    def session(self, network: Network, clip: Clip, device: str) -> Session:
        """A session."""
        return _Second(self, network, clip, device, 3)

    def _file(self) -> Path:
        """The file of weights; those that are downloaded have a folder of their own, with their settings."""
        if self.weights is not None:
            return self.weights
        folder = "SpatialTrackerV2-Offline"
        downloaded(self.name, f"{self.weights_url.rpartition('/')[0]}/config.json", folder)
        return downloaded(self.name, self.weights_url, folder)


class _Second(RgbdSession):
    """One call for all frames."""

    def positions(self, clip: Clip, queries_txy: np.ndarray, z: np.ndarray) -> Positions:
        """The predictor's answer."""
        import torch

        video = torch.tensor(clip.rgb).permute(0, 3, 1, 2).to(self._device).float()
        with torch.autocast("cuda", dtype=torch.bfloat16, enabled=self._device == "cuda"):
            said: Any = self._network.model(
                video,
                depth=without_holes(clip.depth),
                unc_metric=(clip.depth > 0).astype(np.float32),
                intrs=np.repeat(clip.camera.K[None], len(clip), 0).astype(np.float32),
                extrs=clip.poses().astype(np.float32),
                queries=queries_txy,
                fps=1,
                full_point=True,
                iters_track=4,
                query_no_BA=True,
                fixed_cam=True,
                stage=1,
                support_frame=len(clip) - 1,
                replace_ratio=0.2,
            )
        xyz, visible, sure = (said[k].float().cpu().numpy() for k in (4, 6, 7))
        seen = visible[..., 0]
        return Positions(xyz[..., :3].astype(float), seen > _VISIBLE, (seen - _BIAS).clip(0, 1) * sure[..., 0])
