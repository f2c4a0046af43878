"""What trackers with trained weights share: where weights come from, their license, and how one chunk is answered."""

import hashlib
import http.client
import logging
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32
from pydantic import FilePath

from flowlab.errors import FlowlabError, MissingLibraryError
from flowlab.limits import MAX_WEIGHTS_BYTES
from flowlab.records import Clip, Tracks2D
from flowlab.text import cut
from flowlab.tracking.base import Session, Tracker
from flowlab.untrusted import check_regular

_LOG = logging.getLogger(__name__)
SLOW_S = 10.0
"""Who waits longer than this [s] for a network is told for what."""


class PretrainedTracker(Tracker):
    """A tracker that is a network of somebody else's; torch and its code are imported when the first clip is opened.

    The network is kept for the next clip. Its license is logged as a warning when it is first loaded. Whatever
    cannot be had (a package, a network, a file) is a :class:`FlowlabError` that says what to type.
    """

    weights: FilePath | None = None
    """File of weights. Without it the published ones are used; torch.hub's cache keeps them after one download."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What the network runs on; ``auto`` is CUDA where torch has it."""

    @property
    @abstractmethod
    def weights_url(self) -> str:
        """Where the published weights are."""

    @abstractmethod
    def build(self) -> Any:
        """The network without its weights, a ``torch.nn.Module``."""

    @abstractmethod
    def restore(self, network: Any, file: Path) -> None:
        """Give the network its weights. May raise anything where the file holds something else."""

    @abstractmethod
    def session(self, network: Any, clip: Clip, device: str) -> Session:
        """Get ready to track points of a clip with the network, which is on the device."""

    def open(self, clip: Clip) -> Session:
        """Get ready to track points of a clip; the first time this loads the network."""
        return self.session(_loaded(self), clip, self._device())

    def describe(self) -> dict[str, Any]:
        """As for every tracker, with source and SHA-256 of the weights, which are downloaded if need be."""
        source = str(self.weights or self.weights_url)
        return {**super().describe(), "weights": {"source": source, "sha256": _sha256(self._file())}}

    def _file(self) -> Path:
        """The file of weights, downloaded if need be."""
        return self.weights or downloaded(self.name, self.weights_url)

    def _device(self) -> str:
        """The device that the options ask for."""
        import torch

        if self.device == "cuda" and not torch.cuda.is_available():
            raise MissingLibraryError(
                f"tracker '{self.name}': option device is 'cuda', and torch {torch.__version__} finds no CUDA here; "
                "use 'auto' or 'cpu', or install a torch that fits this machine's driver (https://pytorch.org)"
            )
        return "cuda" if self.device != "cpu" and torch.cuda.is_available() else "cpu"


class PretrainedSession(ABC):
    """Answers chunks as :class:`Session` asks, whatever a network says at and before a query's own frame."""

    @abstractmethod
    def follow(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """What the network says of at least two frames and one query; here t counts from ``start``."""

    def track(self, queries_txy: Float32[np.ndarray, "M 3"], start: int, stop: int) -> Tracks2D:
        """Follow points through frames ``start`` to ``stop - 1``; see :class:`Session`."""
        import torch

        length, count = stop - start, len(queries_txy)
        if length > 1 and count > 0:
            relative = (queries_txy - [start, 0, 0]).astype(np.float32)
            with torch.inference_mode(), _seeded():
                found = self.follow(relative, start, stop)
        else:  # nothing moves within one frame, and the networks want two
            nowhere = np.zeros((length, count, 2), np.float32)
            found = Tracks2D(nowhere, np.zeros((length, count), bool), nowhere[..., 0])
        return _from_query_on(queries_txy, start, found)


def _from_query_on(queries_txy: np.ndarray, start: int, found: Tracks2D) -> Tracks2D:
    """The tracks as found after each query's frame, as asked at it, held and not visible before it."""
    frame = start + np.arange(len(found.xy))[:, None]
    before, at = frame < queries_txy[:, 0], frame == queries_txy[:, 0]
    xy = np.where((before | at)[..., None], queries_txy[:, 1:], found.xy)
    confidence = np.where(at, 1, np.where(before, 0, found.confidence))
    xyz_cam = None if found.xyz_cam is None else found.xyz_cam * ~before[..., None]
    return replace(
        found,
        xy=xy.astype(np.float32),
        visible=(found.visible | at) & ~before,
        confidence=confidence.astype(np.float32),
        xyz_cam=xyz_cam,
    )


@contextmanager
def _seeded() -> Iterator[None]:
    """Random numbers that are the same every time, and nobody else's disturbed."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(0)
        yield


def read_weights(file: Path) -> Any:
    """The state dict in a file that torch wrote; one level of wrapping, as training scripts do, is taken off.

    The file cannot run code: it is read with ``weights_only``.
    """
    import torch

    check_regular(file, MAX_WEIGHTS_BYTES)
    values = torch.load(file, map_location="cpu", weights_only=True)
    if not isinstance(values, Mapping):
        raise ValueError(f"holds {type(values).__name__}, expected tensors by name")
    return values.get("model", values.get("state_dict", values))


@lru_cache(maxsize=1)
def _loaded(tracker: PretrainedTracker) -> Any:
    """The network, ready to use; kept because a dataset is many clips for one tracker."""
    device = tracker._device()
    with _seeded(), _told_when_slow(f"tracker '{tracker.name}': importing its code and building its network"):
        network = tracker.build()
    file = tracker._file()
    size = f"{file.stat().st_size / 1e6:.0f} MB"
    try:
        with _seeded(), _told_when_slow(f"tracker '{tracker.name}': reading its weights from {file} ({size})"):
            tracker.restore(network, file)
    except FlowlabError:
        raise
    except Exception as error:  # torch, numpy, pickle and zipfile each have their own for a file of something else
        raise FlowlabError(
            f"tracker '{tracker.name}': {file} does not hold weights that fit ({brief(error)}); expected a file like "
            f"{tracker.weights_url}, which --weights FILE can name"
        ) from error
    _show_license(tracker.name, tracker.license)
    return network.eval().to(device)


@contextmanager
def _told_when_slow(step: str) -> Iterator[None]:
    """Say what is being done where it takes long, as it does on a slow machine or disk."""
    timer = threading.Timer(SLOW_S, _LOG.warning, ("flowlab: %s; on a slow machine that takes minutes", step))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@cache
def _show_license(name: str, terms: str) -> None:
    """Log whose work a network is, the first time."""
    _LOG.warning("flowlab: tracker '%s' is the work of others, license: %s", name, terms)


def downloaded(name: str, url: str, folder: str = "") -> Path:
    """The file behind a URL, in the folder and under the name that torch.hub uses too, or in a folder there."""
    import torch

    file = Path(torch.hub.get_dir()) / "checkpoints" / folder / url.rpartition("/")[2]
    if not file.exists():
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(url, str(file), progress=sys.stderr.isatty())
        except (OSError, http.client.HTTPException) as error:
            raise FlowlabError(
                f"tracker '{name}': the weights could not be downloaded ({brief(error)}); fetch {url} where there is "
                f"a network and put it at {file}, or type --weights FILE"
            ) from error
    return file


@lru_cache(maxsize=4)
def _sha256(file: Path) -> str:
    """The SHA-256 of a file."""
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def torch_command(*packages: str) -> str:
    """What to type to install packages that fit the torch that is there, and leave it the build it is."""
    import torch

    version, _, build = str(torch.__version__).partition("+")
    index = f" --index-url https://download.pytorch.org/whl/{build}" if build else ""
    return f"pip install {' '.join([f'torch=={version}', *packages])}{index}"


def import_advice(error: Exception) -> str:
    """What to type where torchvision is missing, or is built for another torch, which is no ImportError; else empty."""
    if "torchvision" not in str(error):
        return ""
    return f"the installed torchvision is missing or does not fit torch; type: {torch_command('torchvision')}"


def brief(error: Exception) -> str:
    """The start of a message, on one line."""
    return cut(" ".join(str(error).split()), 160) or type(error).__name__
