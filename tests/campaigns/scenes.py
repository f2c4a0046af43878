"""What campaigns disturb: small inputs, made once, and a command for everything that writes."""

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.campaigns.engine import NAME as ENGINE
from tests.campaigns.sandbox import CACHE, Ended, call

_TESTS = Path(__file__).parents[1]
_PROFILE = str(_TESTS / "profiles/small.yaml")
_SIM = ("observer.points=64", "queries.points=8", "expert.hold=5")
_REAL = ("observer.points=64", "queries.points=40", "quality.min_sure_share=0", "quality.max_median_sigma_m=9",
         "write.depth=true")  # fmt: skip
_BENCH = f"""name: tiny
tasks: [drawer-open]
policies: [dp3]
demonstrations: 1
recipe: metaworld
query_points: 8
profile: {_PROFILE}
minutes: 1
set: [run.minutes=null, run.steps=4, run.validations=1]
seeds: [0]
episodes: 1
curve_episodes: 0
"""


def _options(*changes: str) -> list[str]:
    return [word for change in changes for word in ("--set", change)]


@dataclass(frozen=True)
class Scene:
    """A command, what it needs, and what it makes."""

    name: str
    needs: tuple[str, ...]
    """Inputs that are copied into the folder it runs in."""
    command: tuple[str, ...]
    makes: tuple[str, ...]
    checks: tuple[str, ...] = ()
    """Datasets and runs to be validated after a kill."""
    resumes: tuple[str, ...] = ()
    """What a person may type instead, if the same command says so."""
    once: bool = False
    """Whether it refuses to replace what it made: whole, then, as the comparison with an undisturbed run sees."""


_TRAIN = ("--policy", "dp3", "--out", "run", "--profile", _PROFILE, "--threads", "1", "--device", "cpu",
          *_options("run.steps=6", "run.validations=2"))  # fmt: skip
_LOCAL = ("--engine", ENGINE, "--workers", "1")
_EVAL = ("--episodes", "1", "--seeds", "0", *_LOCAL)
SCENES = {
    scene.name: scene
    for scene in (
        Scene("extract", (), ("extract-sim", "drawer-open", "--episodes", "3", "--out", "data", *_LOCAL,
                              *_options(*_SIM)), ("data",), ("data",)),
        Scene("track", ("rec",), ("track-real", "rec", "--out", "real", "--tracker", "lucas-kanade", *_LOCAL,
                                  *_options(*_REAL)), ("real",), ("real",)),
        Scene("train", ("data",), ("train", "data", *_TRAIN), ("run",), ("run",), ("train", "run", "--resume")),
        Scene("resume", ("data", "stopped"), ("train", "stopped", "--resume"), ("stopped",), ("stopped",)),
        Scene("eval", ("data", "run"), ("eval", "run", *_EVAL, "--out", "report"), ("run", "report"), ("run",)),
        Scene("bench", ("bench.yaml",), ("bench", "--recipe", "bench.yaml", "--out", "bench", *_LOCAL), ("bench",)),
        Scene("export", ("data",), ("export", "data", "--to", "dp3", "--out", "store"), ("store",), once=True),
        Scene("viz", ("real",), ("viz", "real", "--png", "a.png", "--mp4", "a.mp4", "--save", "a.rrd"),
              ("a.png", "a.mp4", "a.rrd")),
        Scene("grade", ("slide",), ("grade", "slide", "--tracker", "lucas-kanade", "--out", "graded"), ("graded",)),
        Scene("report", ("data", "tried"), ("report", "tried", "--out", "report"), ("report",)),
    )
}  # fmt: skip


class Workplace:
    """A folder with the inputs, and a fresh folder below it for every trial."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._trial = folder, folder / "trial"
        self.inputs = folder / "inputs"
        self.inputs.mkdir(parents=True, exist_ok=True)

    def trial(self, needs: tuple[str, ...]) -> Path:
        """An empty folder but for copies of these inputs; always of the same name, which some files hold."""
        for name in needs:
            self._have(name)
        shutil.rmtree(self._trial, ignore_errors=True)
        self._trial.mkdir()
        for name in needs:
            source = self.inputs / name
            copy: Callable[..., object] = shutil.copytree if source.is_dir() else shutil.copy2
            copy(source, self._trial / name)
        return self._trial

    def _have(self, name: str) -> None:
        if not (self.inputs / name).exists():
            _MAKERS[name](self)

    def make(self, scene: str, *names: tuple[str, str]) -> None:
        """Run a scene's command and keep what it made under other names."""
        of = SCENES[scene]
        folder = self.trial(of.needs)
        succeed(of.command, folder)
        for made, name in names:
            shutil.copytree(folder / made, self.inputs / name)


def succeed(command: tuple[str, ...], folder: Path) -> Ended:
    """Run a command that must do its work."""
    ended = call(command, folder)
    if ended.code:
        raise RuntimeError(f"flowlab {' '.join(command)} ended with {ended.code}: {ended.err[-3000:]}")
    return ended


def _make_recordings(place: Workplace) -> None:
    from tests.campaigns.sandbox import in_child

    def write() -> None:
        sys.path.insert(0, str(_TESTS))
        from synthetic_clip import record

        for k in range(2):
            record(place.inputs / "rec" / f"take-{k}", frames=8, seed=k)

    in_child(write)


def _make_slide(place: Workplace) -> None:
    from tests.campaigns.sandbox import in_child

    def write() -> None:
        sys.path.insert(0, str(_TESTS))
        from synthetic_clip import CAMERA, record, truth

        query = np.random.default_rng(0).integers(20, 90, (20, 2)).astype(np.float32)
        depth = np.where((query[:, 0] > 26) & (query[:, 0] < 94) & (query[:, 1] > 31) & (query[:, 1] < 89), 0.75, 1.0)
        start = np.append((query - CAMERA.K[:2, 2]) / CAMERA.K[0, 0], np.ones((20, 1)), 1) * depth[:, None]
        tracks = truth(start, 8).astype(np.float32)
        record(place.inputs / "slide", frames=8, query_px=query, tracks_cam=tracks, visible=np.ones((8, 20), bool))

    in_child(write)


def _make_stopped(place: Workplace) -> None:
    """A run that was killed when about two thirds of its files were written."""
    from tests.campaigns import faults

    train = SCENES["train"]
    folder = place.trial(train.needs)
    whole = call(train.command, folder, before=lambda: faults.arm(folder, faults.COUNT))
    for share in (0.66, 0.75, 0.85, 0.5):
        folder = place.trial(train.needs)
        nth = int(share * whole.operations)
        call(train.command, folder, before=lambda f=folder, n=nth: faults.arm(f, faults.KILL, n))  # type: ignore[misc]
        shutil.copytree(folder / "run", place.inputs / "stopped", dirs_exist_ok=True)
        told = (folder / "run/metrics.jsonl").read_bytes() if (folder / "run/metrics.jsonl").exists() else b""
        if told and call(("train", "run", "--resume"), folder).code == 0:
            return
        shutil.rmtree(place.inputs / "stopped")
    raise RuntimeError("no killed run could be resumed")


def _make_cached(place: Workplace) -> None:
    """What was decoded of the dataset when it was trained on."""
    train = SCENES["train"]
    folder = place.trial(train.needs)
    succeed(train.command, folder)
    shutil.copytree(folder / CACHE, place.inputs / CACHE)


def _make_rejected(place: Workplace) -> None:
    """A dataset of recordings whose estimated tracks are too bad, and are kept to be looked at."""
    track = SCENES["track"]
    folder = place.trial(track.needs)
    command = tuple(word.replace("max_median_sigma_m=9", "max_median_sigma_m=0.00000001") for word in track.command)
    call(command, folder)
    shutil.copytree(folder / "real", place.inputs / "rejected")


_MAKERS: dict[str, Callable[[Workplace], None]] = {
    "rec": _make_recordings,
    "slide": _make_slide,
    "bench.yaml": lambda place: (place.inputs / "bench.yaml").write_text(_BENCH) and None,
    "data": lambda place: place.make("extract", ("data", "data")),
    "real": lambda place: place.make("track", ("real", "real")),
    "run": lambda place: place.make("train", ("run", "run")),
    "tried": lambda place: place.make("eval", ("run", "tried")),
    "store": lambda place: place.make("export", ("store", "store")),
    "bench": lambda place: place.make("bench", ("bench", "bench")),
    CACHE: _make_cached,
    "rejected": _make_rejected,
    "stopped": _make_stopped,
}
