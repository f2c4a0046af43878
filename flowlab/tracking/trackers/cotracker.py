"""CoTracker (Karaev et al.), versions 3 and 2, through the predictors of its public code."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32
from pydantic import ValidationInfo, field_validator

from flowlab.errors import MissingLibraryError
from flowlab.records import Clip, Tracks2D
from flowlab.tracking.base import Session
from flowlab.tracking.trackers.weights import (
    PretrainedSession,
    PretrainedTracker,
    brief,
    import_advice,
    read_weights,
)

Mode = Literal["offline", "online"]
_GITHUB = "facebookresearch/co-tracker"
_PUBLISHED = "https://huggingface.co/facebook"


class _Release(NamedTuple):
    """What a version and mode is called in the public code, and what its weights were trained with."""

    entry: str
    window: int
    file: str


class CoTracker(PretrainedTracker):
    """What both versions share.

    A predictor of either version takes pictures, not features, and gives positions and yes-or-no visibility. So
    the feature network runs again for every chunk a frame is in (length / stride times; ``online``: twice as
    often, since its windows overlap by half), and confidence is 0 or 1. The pictures are made a tensor once a clip.
    """

    license: ClassVar[str] = "CC-BY-NC 4.0 (code and weights; not for commercial use)"
    _v2: ClassVar[bool]
    _releases: ClassVar[dict[Mode, _Release]]

    mode: Mode = "offline"
    """``offline`` sees a whole chunk at once; ``online`` slides a short window over it, in memory that does not
    grow with the chunk."""
    support_grid: bool = False
    """Mode ``online``: follow a 6×6 grid along with the points. (``offline`` always does; its code leaves no choice.)
    """
    repo: str | None = None
    """Where the code is from: a GitHub repository as torch.hub names it, or the folder of a checkout. Without it an
    installed package ``cotracker``, else facebookresearch/co-tracker."""

    @field_validator("support_grid")
    @classmethod
    def _has_a_choice(cls, value: bool, info: ValidationInfo) -> bool:
        """Refuse a grid where the mode has its own."""
        if value and info.data.get("mode") != "online":
            raise ValueError("is for mode 'online'; 'offline' always has its grid")
        return value

    @property
    def weights_url(self) -> str:
        """Where the published weights for the mode are."""
        return f"{_PUBLISHED}/{self._releases[self.mode].file}"

    def build(self) -> Any:
        """The predictor, from the installed package or through torch.hub."""
        if self.repo is None and importlib.util.find_spec("cotracker") is not None:
            return self._from_package()
        return self._from_hub(self.repo or _GITHUB)

    def restore(self, network: Any, file: Path) -> None:
        """Load a state dict into the predictor's model."""
        network.model.load_state_dict(read_weights(file))

    def session(self, network: Any, clip: Clip, device: str) -> Session:
        """A session of the mode."""
        if self.mode == "online":
            return _Online(network, clip, device, self.support_grid)
        return _Offline(network, clip, device)

    def _from_package(self) -> Any:
        """The predictor of an installed package."""
        try:
            code = importlib.import_module("cotracker.predictor")
            predictor = code.CoTrackerOnlinePredictor if self.mode == "online" else code.CoTrackerPredictor
            return predictor(checkpoint=None, v2=self._v2, window_len=self._releases[self.mode].window)
        except (ImportError, OSError, RuntimeError, AttributeError, TypeError) as error:
            advice = import_advice(error) or f"type: pip install -U git+https://github.com/{_GITHUB}"
            raise MissingLibraryError(
                f"tracker '{self.name}': the installed Python package cotracker cannot be used ({brief(error)}); "
                f"{advice}"
            ) from error

    def _from_hub(self, repo: str) -> Any:
        """The predictor through torch.hub."""
        import torch

        hub: Any = torch.hub
        entry, source = self._releases[self.mode].entry, "local" if Path(repo).is_dir() else "github"
        try:
            return hub.load(repo, entry, source=source, trust_repo=True, verbose=False, pretrained=False)
        except ModuleNotFoundError as error:
            raise MissingLibraryError(
                f"tracker '{self.name}': CoTracker's code from {repo} needs the Python package {error.name}; "
                + (import_advice(error) or f"type: pip install {error.name}")
            ) from error
        except (OSError, RuntimeError, ValueError, ImportError) as error:
            if advice := import_advice(error):
                raise MissingLibraryError(
                    f"tracker '{self.name}': CoTracker's code from {repo} cannot be imported ({brief(error)}); {advice}"
                ) from error
            raise MissingLibraryError(
                f"tracker '{self.name}': CoTracker's code cannot be had from {repo} ({error}); delete an outdated copy "
                f"in {hub.get_dir()} if there is one, or where there is a network type: git clone "
                f"https://github.com/{_GITHUB}, and set the tracker's option repo to that folder "
                "(--set track.options.repo=FOLDER)"
            ) from error


class CoTracker3(CoTracker):
    """CoTracker3, trained on synthetic and on real videos."""

    name: ClassVar[str] = "cotracker3"
    _v2: ClassVar[bool] = False
    _releases: ClassVar[dict[Mode, _Release]] = {
        "offline": _Release("cotracker3_offline", 60, "cotracker3/resolve/main/scaled_offline.pth"),
        "online": _Release("cotracker3_online", 16, "cotracker3/resolve/main/scaled_online.pth"),
    }


class CoTracker2(CoTracker):
    """CoTracker2, the version before: windows of 8 frames, either mode with the same weights."""

    name: ClassVar[str] = "cotracker2"
    _v2: ClassVar[bool] = True
    _releases: ClassVar[dict[Mode, _Release]] = {
        "offline": _Release("cotracker2", 8, "cotracker/resolve/main/cotracker2.pth"),
        "online": _Release("cotracker2_online", 8, "cotracker/resolve/main/cotracker2.pth"),
    }


class _Offline(PretrainedSession):
    """One call a chunk. CoTracker's own coordinates are ours: (t, x, y), integer pixel centers."""

    def __init__(self, predictor: Any, clip: Clip, device: str) -> None:
        import torch

        self._predictor, self._device = predictor, device
        self._video = torch.tensor(clip.rgb).permute(0, 3, 1, 2)[None]  # (1, T, 3, H, W) uint8

    def follow(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """The predictor's answer to one chunk."""
        return self._tracks(*self._predictor(self._frames(start, stop), queries=self._queries(queries_txy)))

    def _frames(self, start: int, stop: int) -> Any:
        """Float, still 0 to 255: torch cannot resize bytes on every device."""
        return self._video[:, start:stop].to(self._device).float()

    def _queries(self, queries_txy: np.ndarray) -> Any:
        """Queries as a tensor."""
        import torch

        return torch.from_numpy(queries_txy)[None].to(self._device)

    @staticmethod
    def _tracks(xy: Any, visible: Any) -> Tracks2D:
        """Tracks of the tensors that a predictor gives."""
        seen = visible[0].cpu().numpy()
        return Tracks2D(xy[0].float().cpu().numpy(), seen, seen.astype(np.float32))


class _Online(_Offline):
    """Windows of two steps, each a step further; every answer covers all frames so far."""

    def __init__(self, predictor: Any, clip: Clip, device: str, support_grid: bool) -> None:
        super().__init__(predictor, clip, device)
        self._grid = support_grid

    def follow(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """The predictor's answer after the last window of a chunk."""
        step, queries = self._predictor.step, self._queries(queries_txy)
        first = self._frames(start, min(start + 2 * step, stop))  # tells size and device, tracks nothing yet
        self._predictor(video_chunk=first, is_first_step=True, queries=queries, add_support_grid=self._grid)
        for a in range(start, max(stop - step, start + 1), step):  # one window even where a step covers the chunk
            xy, visible = self._predictor(video_chunk=self._frames(a, min(a + 2 * step, stop)))
        return self._tracks(xy[:, :, : len(queries_txy)], visible[:, :, : len(queries_txy)])  # less the grid's
