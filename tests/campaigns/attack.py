"""Give every command what a stranger could have prepared, and see that nothing of it runs and nothing else is touched.

    python -m tests.campaigns.attack

Every case works in a folder beside a sentinel tree, whose files are hashed before and after, and names a marker that
anything executed would leave. A case is held when commands end by themselves, without a traceback, a raw escape on the
terminal, a marker, or a change outside.
"""

import hashlib
import json
import os
import pickle
import re
import socket
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from tests.campaigns import faults
from tests.campaigns.campaign import Campaign, options
from tests.campaigns.engine import NAME as ENGINE
from tests.campaigns.sandbox import HUNG, Ended, call, warm_up
from tests.campaigns.scenes import SCENES, Workplace

OUTCOMES = ("held", "executed", "touched", "traceback", "hung", "escape", "believed")
NAMES = ("../x", "/abs", "[/red]", "a|b`c`", "n" * 300, "\x1b[31mred\x1b[0m", "nul\0", "=cmd|' /C calc'!A0",
         "$\\frac{", "<script>alert(1)</script>", "line\nbreak", "\u202egnp.exe", ".hidden", "~", "-rf",
         "CON", ":smile:")  # fmt: skip
MODULES = ("json", "yaml", "torch", "numpy", "sitecustomize", "usercustomize", "zarr", "rich", "click", "pickle",
           "flowlab", "synthetic", "cv2", "av", "rerun", "matplotlib", "ctypes", "random", "string")  # fmt: skip


@dataclass
class Arena:
    """Where a case happens."""

    top: Path
    here: Path
    """The current folder of its commands."""
    ended: list[Ended] = field(default_factory=list)
    believed: str = ""
    """What a case found wrong by itself."""

    @property
    def outside(self) -> Path:
        return self.top / "outside"

    @property
    def marker(self) -> Path:
        return self.top / "markers"

    def run(self, *arguments: str | Path, before: Callable[[], None] = lambda: None) -> Ended:
        self.ended.append(call(arguments, self.here, before=before, limit=180))
        return self.ended[-1]

    def run_program(self, *arguments: str | Path, **environment: str) -> Ended:
        """The installed command, in a Python of its own."""
        script = self.top / "bin" / "flowlab"
        script.parent.mkdir(exist_ok=True)
        script.write_text(
            "import sys\nfrom flowlab.cli import main\n\nif __name__ == '__main__':\n    sys.exit(main())\n"
        )
        clean = {k: v for k, v in os.environ.items() if k not in ("LD_PRELOAD", "PYTHONPATH")} | environment
        command = [sys.executable, str(script), *map(str, arguments)]
        try:
            done = subprocess.run(command, cwd=self.here, env=clean, capture_output=True, timeout=120, check=False)
        except subprocess.TimeoutExpired:
            self.ended.append(Ended(HUNG, "", "", 120))
        else:
            out, err = (x.decode(errors="backslashreplace") for x in (done.stdout, done.stderr))
            self.ended.append(Ended(done.returncode, out, err, 0))
        return self.ended[-1]

    def evil_code(self, name: str) -> str:
        """A module that leaves a marker."""
        folder, file = str(self.marker), str(self.marker / name)
        return f"import os\nos.makedirs({folder!r}, exist_ok=True)\nopen({file!r}, 'w').close()\n"

    def evil_pickle(self, name: str) -> bytes:
        return pickle.dumps(_Evil(f"mkdir -p {self.marker} && touch {self.marker / name}"))


class _Evil:
    def __init__(self, command: str) -> None:
        self._command = command

    def __reduce__(self) -> Any:
        return os.system, (self._command,)


Case = tuple[tuple[str, ...], Callable[[Arena], None]]
CASES: dict[str, Case] = {}


def case(name: str, *needs: str) -> Callable[[Callable[[Arena], None]], Callable[[Arena], None]]:
    def keep(function: Callable[[Arena], None]) -> Callable[[Arena], None]:
        CASES[name] = needs, function
        return function

    return keep


@options(count=10_000)
def main(seed: int, count: int, budget: float, only: tuple[str, ...], keep: Path) -> None:
    faults.begin_with_faults()
    warm_up()
    campaign = Campaign("attack", OUTCOMES, ("held",), keep)
    place = Workplace(campaign.folder)
    chosen = [name for name in CASES if not only or any(fnmatchcase(name, asked) for asked in only)]
    for number in campaign.trials(0, min(count, len(chosen)), budget):
        name = chosen[(seed + number) % len(chosen)]
        needs, attack = CASES[name]
        folder = place.trial(needs)
        arena = _arena(campaign.folder / f"arena-{number}", folder)
        before = _hashes(arena)
        attack(arena)
        for outcome, about in _judge(arena, before):
            campaign.add(name, outcome, about)
        subprocess.run(["rm", "-rf", arena.top], check=True)
    campaign.finish()


def _arena(top: Path, inputs: Path) -> Arena:
    (top / "outside" / "photos").mkdir(parents=True)
    for name in ("victim.txt", "victim.json", "photos/a.jpg"):
        (top / "outside" / name).write_text("dear to somebody")
    inputs.rename(top / "here")
    for run in (top / "here").glob("*/run.json"):  # which tells where its dataset is
        run.write_text(run.read_text().replace(str(inputs), str(top / "here")))
    return Arena(top, top / "here")


def _hashes(arena: Arena) -> dict[str, str]:
    """Everything in the arena but what is in the current folder and logs."""
    known = {}
    for path in sorted(arena.top.rglob("*")):
        name = path.relative_to(arena.top).as_posix()
        if name.split("/")[0] not in ("here", "here.log", "markers", "bin"):
            known[name] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    for absolute in ("/abs", "/x"):
        known[absolute] = str(os.path.lexists(absolute) or bool(list(Path("/").glob(f"{absolute[1:]}*.rrd"))))
    return known


def _judge(arena: Arena, before: dict[str, str]) -> Iterator[tuple[str, str]]:
    found = False
    if arena.marker.exists():
        found = True
        yield "executed", ", ".join(p.name for p in arena.marker.iterdir())
    if changed := sorted(k for k in {*before, *_hashes(arena)} if before.get(k) != _hashes(arena).get(k)):
        found = True
        yield "touched", ", ".join(changed)
    for e in arena.ended:
        if e.code == HUNG or e.traceback or "\x1b" in e.out + e.err:
            found = True
            yield (
                ("hung" if e.code == HUNG else "traceback" if e.traceback else "escape"),
                e.err[-6000:] or e.out[-300:],
            )
    if arena.believed:
        found = True
        yield "believed", arena.believed
    if not found:
        yield "held", ""


def _replaced(folder: Path, old: str, new: str) -> None:
    """Have all JSON below a folder say another text."""
    for file in folder.rglob("*.json*"):
        if file.is_file():
            file.write_text(file.read_text().replace(json.dumps(old)[1:-1], json.dumps(new)[1:-1]))


def _look_at(arena: Arena, dataset: str) -> None:
    """Every command that reads a dataset."""
    arena.run("info", dataset)
    arena.run("info", dataset, "--json")
    arena.run("validate", dataset)
    arena.run("viz", dataset)
    arena.run("viz", dataset, "--png", "a.png", "--mp4", "a.mp4", "--save", "a.rrd")
    arena.run("viz", dataset, "--rejects", "--png", "b.png")
    arena.run("export", dataset, "--to", "dp3", "--out", "out-store")
    arena.run("train", dataset, *SCENES["train"].command[2:], "--set", "run.steps=1")


def _look_at_run(arena: Arena, run: str) -> None:
    """Every command that reads a run."""
    for command in (("report", run, "--out", "out-report"), ("train", run, "--resume"), ("validate", run),
                    ("eval", run, "--episodes", "1", "--seeds", "0", "--engine", ENGINE, "--workers", "1"),
                    ("eval", run, "--offline"), ("viz", run, "--png", "c.png")):  # fmt: skip
        arena.run(*command)


def _names() -> None:
    for k, name in enumerate(NAMES):

        def on_dataset(arena: Arena, name: str = name) -> None:
            _replaced(arena.here / "data", "drawer-open", name)
            _look_at(arena, "data")

        def on_recordings(arena: Arena, name: str = name) -> None:
            for file in (arena.here / "rec").rglob("recording.yaml"):
                file.write_text(file.read_text() + f"task: {json.dumps(name)}\n")
            arena.run(*SCENES["track"].command)
            arena.run("track-real", "rec", "--dry-run")
            if (arena.here / "real").exists():
                _look_at(arena, "real")

        def on_run(arena: Arena, name: str = name) -> None:
            _replaced(arena.here / "tried", "drawer-open", name)
            _look_at_run(arena, "tried")
            _check_page(arena, arena.here / "out-report")

        def as_folder(arena: Arena, name: str = name) -> None:
            plain = name.replace("/", "_").replace("\0", "_")[:200]
            (arena.here / "data").rename(arena.here / plain)
            _look_at(arena, f"./{plain}")

        CASES[f"task of a dataset: name {k}"] = ("data",), on_dataset
        CASES[f"task of recordings: name {k}"] = ("rec",), on_recordings
        CASES[f"task of a run: name {k}"] = ("data", "tried"), on_run
        CASES[f"folder: name {k}"] = ("data",), as_folder


_names()


def _check_page(arena: Arena, report: Path) -> None:
    page = report / "report.html"
    if page.exists() and re.search(r"<script>alert|\x1b|\u202e", page.read_text()):
        arena.believed = "markup of a name is in the page"
    for file in report.glob("*.csv"):
        if re.search(r"(^|,)\"?[=@]", file.read_text(), re.MULTILINE):
            arena.believed = "a name is a formula in a CSV"


@case("folder that is no text", "data")
def _(arena: Arena) -> None:
    odd = os.fsdecode(b"d\xff\xfe\x1b[31m")
    (arena.here / "data").rename(arena.here / odd)
    _look_at(arena, odd)


def _modules() -> None:
    for scene in ("extract", "track", "train", "resume", "eval", "export", "viz", "grade", "report", "bench"):

        def attack(arena: Arena, scene: str = scene) -> None:
            for name in MODULES:
                (arena.here / f"{name}.py").write_text(arena.evil_code(name))
            command = ["local" if word == ENGINE else word for word in SCENES[scene].command]
            if arena.run_program(*command).code:
                arena.believed = f"did not do its work: {arena.ended[-1].last_line}"

        CASES[f"modules in the current folder: {scene}"] = SCENES[scene].needs, attack


_modules()


@case("settings of libraries in the current folder", "data")
def _(arena: Arena) -> None:
    for name, text in ((".numba_config.yaml", "cache_dir: ./evil\n"), ("matplotlibrc", "text.usetex: True\n")):
        (arena.here / name).write_text(text)
        if arena.run_program("viz", "data", "--png", "a.png").code != 2:
            arena.believed = f"{name} is taken"
        (arena.here / name).unlink()
    os.mkfifo(arena.here / "matplotlibrc")
    arena.run_program("viz", "data", "--png", "a.png")


@case("a log of MuJoCo that is a link")
def _(arena: Arena) -> None:
    (arena.here / "MUJOCO_LOG.TXT").symlink_to(arena.outside / "victim.txt")
    (arena.here / "unstable.py").write_text(
        "from flowlab.sim.simulation import Simulation\nimport mujoco\n"
        'model = mujoco.MjModel.from_xml_string(\'<mujoco><worldbody><body><freejoint/><geom size=".1"/></body>'
        "</worldbody></mujoco>')\ndata = mujoco.MjData(model)\ndata.qvel[:] = float('nan')\n"
        "mujoco.mj_step(model, data)\n"
    )
    subprocess.run([sys.executable, "unstable.py"], cwd=arena.here, check=True, capture_output=True)


@case("a cache that is a link", "data")
def _(arena: Arena) -> None:
    for name in ("cache", "figures"):
        subprocess.run(["rm", "-rf", arena.here / "data" / name], check=True)
        (arena.here / "data" / name).symlink_to(arena.outside, target_is_directory=True)
    _look_at(arena, "data")


@case("a run's folders are links", "data", "tried")
def _(arena: Arena) -> None:
    for name in ("cache", "films", "evaluations", "tensorboard"):
        subprocess.run(["rm", "-rf", arena.here / "tried" / name], check=True)
        (arena.here / "tried" / name).symlink_to(arena.outside, target_is_directory=True)
    _look_at_run(arena, "tried")


def _special_files() -> None:
    def fifo(path: Path) -> None:
        os.mkfifo(path)

    def unix_socket(path: Path) -> None:
        here = os.getcwd()
        os.chdir(path.parent)  # names of sockets are short
        with socket.socket(socket.AF_UNIX) as opened, suppress(OSError):
            opened.bind(path.name)
        os.chdir(here)

    makers: dict[str, Callable[[Path], None]] = {
        "a FIFO": fifo,
        "a socket": unix_socket,
        "a device": lambda path: path.symlink_to("/dev/zero"),
        "a circle of links": lambda path: path.symlink_to(path.name),
        "a folder": lambda path: path.mkdir(),
    }
    files = {
        "data": ("data/flowlab.json", "data/stats.json", "data/README.md", "data/receipts/*", "data/shards/*"),
        "real": ("real/rejects.jsonl", "real/rejects/*"),
        "tried": ("tried/policy.json", "tried/run.json", "tried/metrics.jsonl", "tried/*/*.safetensors",
                  "tried/resume*", "tried/**/episodes*"),
        "rec": ("rec/*/recording.yaml", "rec/*/times.txt", "rec/*/color/000003.png", "rec/*/state.npy"),
    }  # fmt: skip
    for top, patterns in files.items():
        for pattern in patterns:
            for what, make in makers.items():

                def attack(arena: Arena, top: str = top, pattern: str = pattern, make: Any = make) -> None:
                    for file in list(arena.here.glob(pattern))[:1]:
                        subprocess.run(["rm", "-rf", file], check=True)
                        make(file)
                    if top == "rec":
                        arena.run("track-real", "rec", "--dry-run")
                        arena.run(*SCENES["track"].command)
                    else:
                        (_look_at_run if top == "tried" else _look_at)(arena, top)

                CASES[f"{what} as {pattern}"] = ("data", "tried") if top == "tried" else (top,), attack


_special_files()


def _temporary_names() -> None:
    for scene in SCENES.values():

        def attack(arena: Arena, scene: Any = scene) -> None:
            def prepare() -> None:
                names = {p.name for p in arena.here.rglob("*")} | {
                    "flowlab.json", "stats.json", "README.md", "rejects.jsonl", "policy.json", "run.json", "store",
                    "resume.safetensors", "grade.json", "grade.png", "report.html", "report.json", "report.csv",
                    "a.png", "episodes.csv", "a.mp4", "a.rrd", "training.png", "curve.png", "metrics.jsonl",
                }  # fmt: skip
                folders = {arena.here, *(p for p in arena.here.rglob("*") if p.is_dir())}
                for folder in [*folders, *(arena.here / made for made in scene.makes if "." not in made)]:
                    folder.mkdir(exist_ok=True) if folder.suffix == "" and folder.name != "store" else None
                    for name in names if folder.is_dir() else ():
                        link = folder / f".tmp-{socket.gethostname()}+{os.getpid()}+{name}"
                        with suppress(FileExistsError):
                            link.symlink_to(arena.outside / f"new-{name}")

            arena.run(*scene.command, before=prepare)

        CASES[f"links at temporary names: {scene.name}"] = scene.needs, attack


_temporary_names()


@case("a receipt whose unit leads outside", "real", "rec")
def _(arena: Arena) -> None:
    for file in (arena.here / "real" / "receipts").glob("*.json"):
        values = json.loads(file.read_text())
        reject = {"task": "slide", "seed": 1, "stage": "recording", "reason": "x", "retry": True}
        for unit in ("../../../outside/victim", f"{arena.outside}/victim"):
            values |= {"unit": unit, "accepted": [], "frames": [], "digests": [], "rejects": [reject]}
            file.write_text(json.dumps(values))
            arena.run(*SCENES["track"].command)
            _look_at(arena, "real")


@case("shards that lead outside", "data")
def _(arena: Arena) -> None:
    for k, shard in enumerate(sorted((arena.here / "data" / "shards").iterdir())):
        if zipfile.is_zipfile(shard):
            with zipfile.ZipFile(shard, "a") as archive:
                archive.writestr("../../../outside/victim.txt", "gone")
                archive.writestr(f"{arena.outside}/new{k}.txt", "new")
        else:
            subprocess.run(["rm", "-rf", shard], check=True)
            shard.symlink_to(arena.outside, target_is_directory=shard.suffix == ".zarr")
    _look_at(arena, "data")
    arena.run(*SCENES["extract"].command)


PLACES = (
    "antigravity:x",
    "os:system",
    "this:x",
    "evil:Policy",
    "builtins:exec",
    "../evil:X",
    "here.evil:X",
    "",
    ":",
    "evil",
)


def _policies() -> None:
    for k, place in enumerate(PLACES):

        def attack(arena: Arena, place: str = place) -> None:
            for folder in (arena.here, arena.here / "tried", arena.here / "data"):
                (folder / "evil.py").write_text(arena.evil_code("evil"))
            for name in ("policy.json", "run.json"):
                file = arena.here / "tried" / name
                if file.exists():
                    file.write_text(file.read_text().replace('"dp3"', json.dumps(place)))
            _look_at_run(arena, "tried")
            if any(name in e.out + e.err for e in arena.ended for name in ("xkcd", "Zen of Python")):
                arena.believed = "a module that a policy.json names was imported"

        CASES[f"policy of a stranger's run: {k}"] = ("data", "tried"), attack


_policies()


@case("pickles as weights", "data", "tried", "rec")
def _(arena: Arena) -> None:
    for file in [*(arena.here / "tried").rglob("*.safetensors")]:
        file.write_bytes(arena.evil_pickle("checkpoint"))
    _look_at_run(arena, "tried")
    for tracker in ("cotracker3", "cotracker2", "bootstapir", "tapnext"):
        for suffix in ("pt", "pth", "npy", "npz", "safetensors"):
            (arena.here / f"w.{suffix}").write_bytes(arena.evil_pickle("weights"))
            arena.run("track-real", "rec", "--out", "d", "--tracker", tracker, "--weights", f"w.{suffix}", "--engine",
                      ENGINE, "--workers", "1")  # fmt: skip


@case("pickles in arrays", "rec", "slide", "data")
def _(arena: Arena) -> None:
    evil = np.array([_Evil(f"mkdir -p {arena.marker} && touch {arena.marker}/array")], dtype=object)
    for file in (*(arena.here / "rec").rglob("state.npy"), *(arena.here / "data").rglob("*.npy")):
        np.save(file, evil, allow_pickle=True)
    np.savez(arena.here / "slide" / "ground_truth.npz", query_px=evil, tracks_cam=evil, visible=evil)
    arena.run(*SCENES["track"].command)
    arena.run(*SCENES["grade"].command)
    _look_at(arena, "data")


@case("members of an .npz that lead outside", "slide")
def _(arena: Arena) -> None:
    with zipfile.ZipFile(arena.here / "slide" / "ground_truth.npz", "a") as archive:
        for name in ("../../outside/victim.txt", f"{arena.outside}/new.npy", "nul\0.npy"):
            with suppress(ValueError):
                archive.writestr(name, "x")
    arena.run(*SCENES["grade"].command)


BOMBS = {
    "aliases": "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(9)),
    "nesting": "[" * 100_000,
    "digits": "a: " + "9" * 5000,
    "python objects": "!!python/object/apply:os.system ['touch executed']",
}  # fmt: skip


def _bombs() -> None:
    for name, text in BOMBS.items():

        def attack(arena: Arena, text: str = text) -> None:
            bomb = arena.here / "bomb.yaml"
            bomb.write_text(text)
            arena.run("extract-sim", "drawer-open", "--recipe", "bomb.yaml", "--out", "d")
            arena.run("train", "data", "--policy", "dp3", "--profile", "bomb.yaml", "--out", "r")
            arena.run("bench", "--recipe", "bomb.yaml", "--out", "b")
            arena.run("track-real", "rec", "--calibration", "bomb.yaml", "--out", "d2")
            for file in (arena.here / "rec").rglob("recording.yaml"):
                file.write_text(text)
            arena.run("track-real", "rec", "--dry-run")
            for file in (*(arena.here / "data").rglob("*.json"), *(arena.here / "tried").rglob("*.json*")):
                file.write_text(text if text[0] == "[" else json.dumps({"a": 1})[:-1] + ', "b": ' + "9" * 5000 + "}")
            _look_at(arena, "data")
            _look_at_run(arena, "tried")
            if (arena.here / "executed").exists():
                arena.marker.mkdir()

        CASES[f"a bomb of {name}"] = ("data", "tried", "rec"), attack


_bombs()


@case("headers that claim too much", "rec")
def _(arena: Arena) -> None:
    for file in (arena.here / "rec").rglob("state.npy"):
        header = "{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000000000000, 2), }".ljust(117) + "\n"
        file.write_bytes(b"\x93NUMPY\x01\x00\x76\x00" + header.encode())
    arena.run(*SCENES["track"].command)


@case("a plug-in named like one of flowlab's", "data")
def _(arena: Arena) -> None:
    site = arena.top / "site"
    about = site / "evil-1.dist-info"
    about.mkdir(parents=True)
    (site / "evil_plugin.py").write_text("class X:\n    pass\n")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[flowlab.exporters]\ndp3 = evil_plugin:X\n")
    arena_before = arena.run_program("export", "data", "--to", "dp3", "--out", "store", PYTHONPATH=str(site))
    if arena_before.code != 2 or "offered by" not in arena_before.err:
        arena.believed = f"a plug-in took a name that is taken: {arena_before.err[-300:]}"
    subprocess.run(["rm", "-rf", site], check=True)


if __name__ == "__main__":
    main()
