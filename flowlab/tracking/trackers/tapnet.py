"""BootsTAPIR and TAPNext of DeepMind's ``tapnet`` package, in their PyTorch versions.

Both look at square pictures and speak of *raster* coordinates, in the order (t, y, x): (0, 0) is the upper left
corner of the first pixel, so the center of pixel i is i + 0.5. Pictures are resized without moving their borders
(``align_corners=False``), which scales raster coordinates and nothing else. With a picture W wide resized to S
(TAPNext's coordinates are those of S = 256, also where its pictures are larger):

    x_raster = (x + 0.5) * S / W        x = x_raster * W / S - 0.5

and the same for y with the height, where x is ours: integer pixel centers.
"""

import importlib
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32
from pydantic import Field

from flowlab.errors import MissingLibraryError
from flowlab.records import Clip, Tracks2D
from flowlab.tracking.base import Session
from flowlab.tracking.trackers.weights import (
    PretrainedSession,
    PretrainedTracker,
    brief,
    import_advice,
    read_weights,
    torch_command,
)

_PUBLISHED = "https://storage.googleapis.com/dm-tapnet"
_NATIVE = 256
"""Side of the pictures that both networks were trained on."""
_FINE = "tapnextpp_512.ckpt"
"""The published weights of TAPNext++ that were trained on larger pictures; nothing in them says so but the name."""
_TAPNET = "'tapnet @ git+https://github.com/google-deepmind/tapnet.git'"
_TAPNET_NEEDS = "einops einshape dm-tree dm-haiku chex jax jaxline optax matplotlib mediapy tqdm"
"""What the package imports: less than it asks for, which would bring another OpenCV and another torch."""
_DISTRIBUTIONS = {"tree": "dm-tree", "haiku": "dm-haiku", "sklearn": "scikit-learn", "cv2": "opencv-python-headless"}
"""Packages whose name differs from that of their module."""


class _Tapnet(PretrainedTracker):
    """What both trackers share."""

    license: ClassVar[str] = "Apache-2.0 (code and weights)"

    def code(self, module: str) -> Any:
        """A module of the package. Raises :class:`MissingLibraryError` where it or what it needs is missing."""
        try:
            return importlib.import_module(f"tapnet.{module}")
        except (ImportError, OSError, RuntimeError, AttributeError) as error:  # RuntimeError: an unfit torchvision
            raise MissingLibraryError(
                f"tracker '{self.name}' needs the Python package tapnet, and importing tapnet.{module} failed "
                f"({brief(error)}); {import_advice(error) or _advice(error)}"
            ) from error


def _advice(error: Exception) -> str:
    """What to type where the package or something it imports is missing."""
    missing = str(error.name).partition(".")[0] if isinstance(error, ModuleNotFoundError) else "tapnet"
    if missing != "tapnet":
        return f"type: pip install {_DISTRIBUTIONS.get(missing, missing)}"
    return f"type: {torch_command('torchvision')} && pip install --no-deps {_TAPNET} && pip install {_TAPNET_NEEDS}"


class BootsTapir(_Tapnet):
    """BootsTAPIR: matches a point in every frame by itself, then refines the path through the whole chunk.

    The features of a frame are computed once, as long as the next chunk begins within the one before.
    """

    name: ClassVar[str] = "bootstapir"
    size: int = Field(default=_NATIVE, ge=_NATIVE, multiple_of=8)
    """Side [px] of the square that pictures are resized to. Above 256 paths are refined at that size too, which
    costs time and memory by its square."""

    @property
    def weights_url(self) -> str:
        """Where the published weights are."""
        return f"{_PUBLISHED}/bootstap/bootstapir_checkpoint_v2.pt"

    def build(self) -> Any:
        """The network, as the published weights need it."""
        return self.code("torch.tapir_model").TAPIR(pyramid_level=1)

    def restore(self, network: Any, file: Path) -> None:
        """Load a state dict."""
        network.load_state_dict(read_weights(file))

    def session(self, network: Any, clip: Clip, device: str) -> Session:
        """A session that keeps the features of the latest chunk."""
        return _Tapir(network, clip, device, self.size)


class TapNext(_Tapnet):
    """TAPNext: a recurrent network that is given frame after frame, each once a chunk.

    Its authors know it to drift after some 150 frames; the chunks start it afresh.
    """

    name: ClassVar[str] = "tapnext"
    size: int | None = Field(default=None, ge=_NATIVE, multiple_of=8)
    """Side [px] of the square that pictures are resized to: 256, or 512 with the weights ``tapnextpp_512.ckpt``, which
    were trained on such pictures. Without it the name of the weights' file decides."""

    @property
    def side(self) -> int:
        """The size that is used."""
        return self.size or (2 * _NATIVE if self.weights and self.weights.name == _FINE else _NATIVE)

    def describe(self) -> dict[str, Any]:
        """As for every tracker with weights, with the size that is used."""
        told = super().describe()
        return {**told, "options": {**told["options"], "size": self.side}}

    @property
    def weights_url(self) -> str:
        """Where the published weights are (BootsTAPNext)."""
        return f"{_PUBLISHED}/tapnext/bootstapnext_ckpt.npz"

    def build(self) -> Any:
        """The network, as the published weights need it."""
        network = self.code("tapnext.tapnext_torch").TAPNext(image_size=(_NATIVE, _NATIVE))
        if self.side != _NATIVE and not hasattr(network, "_video_pos_emb"):
            raise MissingLibraryError(
                f"tracker '{self.name}': pictures of size {self.side} need a newer package tapnet, which interpolates "
                f"its position embedding; type: pip install --no-deps --force-reinstall {_TAPNET}, or set option size "
                f"to {_NATIVE} (--set track.options.size={_NATIVE})"
            )
        return network

    def restore(self, network: Any, file: Path) -> None:
        """Load weights of either kind that is published: JAX's (``.npz``), or torch's, as of TAPNext++."""
        if file.suffix == ".npz":
            self.code("tapnext.tapnext_torch_utils").restore_model_from_jax_checkpoint(network, str(file))
        else:
            network.load_state_dict({k.removeprefix("tapnext."): v for k, v in read_weights(file).items()})

    def session(self, network: Any, clip: Clip, device: str) -> Session:
        """A session; every chunk starts with no memory."""
        certainty = self.code("tapnext.tapnext_torch_utils").tracker_certainty
        return _TapNext(network, clip, device, self.side, certainty)


class _Square(PretrainedSession):
    """The clip in squares, resized once, and the way there and back for coordinates."""

    def __init__(self, network: Any, clip: Clip, device: str, size: int, units: int | None = None) -> None:
        """``units``: the side of the square in the network's coordinates, where it is not its side in pixels."""
        import torch
        from torch.nn.functional import interpolate

        self._network, self._device, self._size = network, device, size
        height, width = clip.rgb.shape[1:3]
        self._scale = (units or size) / np.array([width, height], np.float32)
        self._video = torch.empty((1, len(clip), size, size, 3), dtype=torch.uint8)
        for t, rgb in enumerate(clip.rgb):
            whole = torch.tensor(rgb).permute(2, 0, 1)[None].float()
            square = interpolate(whole, (size, size), mode="bilinear", align_corners=False, antialias=True)
            self._video[0, t] = square[0].permute(1, 2, 0).round().clamp(0, 255)

    def _frames(self, start: int, stop: int) -> Any:
        """(1, T, S, S, 3), -1 to 1."""
        return self._video[:, start:stop].to(self._device).float() / 127.5 - 1

    def _queries_tyx(self, queries_txy: np.ndarray) -> Any:
        """Queries in raster coordinates, as a tensor."""
        import torch

        raster_xy = (queries_txy[:, 1:] + 0.5) * self._scale
        tyx = np.concatenate([queries_txy[:, :1], raster_xy[:, ::-1]], 1)
        return torch.from_numpy(tyx.astype(np.float32))[None].to(self._device)

    def _tracks(self, raster_xy: Any, visible: Any, confidence: Any) -> Tracks2D:
        """From (T, M, 2) and (T, M) tensors."""
        xy = raster_xy.float().cpu().numpy() / self._scale - 0.5
        return Tracks2D(xy.astype(np.float32), visible.cpu().numpy(), confidence.float().cpu().numpy())


class _Tapir(_Square):
    """Features of the frames of the latest chunk are kept; a chunk that goes on from it adds the rest."""

    def __init__(self, network: Any, clip: Clip, device: str, size: int) -> None:
        super().__init__(network, clip, device, size)
        self._grids: Any = None
        self._kept = range(0)

    def follow(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """The steps of the network's own ``forward``, with features that may be there already."""
        import torch

        grids, queries = self._features(start, stop), self._queries_tyx(queries_txy)
        shape_only = torch.empty(1, device=self._device).expand(1, stop - start, self._size, self._size, 3)
        features = self._network.get_query_features(
            shape_only, is_training=False, query_points=queries, feature_grids=grids
        )
        levels = self._network.estimate_trajectories(
            (self._size, self._size),
            is_training=False,
            feature_grids=grids,
            query_features=features,
            query_points_in_video=queries,
            query_chunk_size=64,
        )
        each = self._network.num_pips_iter  # every so often a resolution is done with; forward takes their mean
        xy, occluded, far = (
            torch.stack(levels[k][each::each]).mean(0)[0].transpose(0, 1)
            for k in ("tracks", "occlusion", "expected_dist")
        )
        confidence = torch.sigmoid(-occluded) * torch.sigmoid(-far)
        return self._tracks(xy, confidence > 0.5, confidence)

    def _features(self, start: int, stop: int) -> Any:
        """Feature grids of frames ``start`` to ``stop - 1``."""
        import torch

        kept = self._kept
        if not kept.start <= start < kept.stop:
            self._grids, kept = self._encoded(start, stop), range(start, stop)
        elif stop > kept.stop:
            old, new = self._sliced(start - kept.start, None), self._encoded(kept.stop, stop)
            joined = {k: tuple(map(lambda *g: torch.cat(g, 1), getattr(old, k), getattr(new, k))) for k in _GRIDS}
            self._grids, kept = new._replace(**joined), range(start, stop)
        self._kept = kept
        return self._sliced(start - kept.start, stop - kept.start)

    def _encoded(self, start: int, stop: int) -> Any:
        """Feature grids, computed."""
        return self._network.get_feature_grids(self._frames(start, stop), is_training=False)

    def _sliced(self, a: int, b: int | None) -> Any:
        """Some frames of the feature grids that are kept."""
        return self._grids._replace(**{k: tuple(g[:, a:b] for g in getattr(self._grids, k)) for k in _GRIDS})


_GRIDS = ("lowres", "hires")


class _TapNext(_Square):
    """A state goes from frame to frame. The network's own positions are (y, x), like its queries.

    Its coordinates are of a square of 256, whatever the size of the pictures.
    """

    def __init__(self, network: Any, clip: Clip, device: str, size: int, certainty: Any) -> None:
        super().__init__(network, clip, device, size, _NATIVE)
        self._certainty = certainty

    def follow(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """Frame by frame; a query is put to the first frame already, and taken up at its own."""
        import torch

        frames, state = [], None
        for t in range(start, stop):
            queries = self._queries_tyx(queries_txy) if state is None else None
            yx, logits, visible, state = self._network(self._frames(t, t + 1), query_points=queries, state=state)
            frames.append((yx[0, 0], logits[0, 0], visible[0, 0]))
        yx, logits, visible = (torch.stack(values) for values in zip(*frames, strict=True))
        confidence = torch.sigmoid(visible) * self._certainty(yx, logits)
        return self._tracks(yx.flip(-1), visible[..., 0] > 0, confidence[..., 0])
