"""``make pictures``: draws every picture in ``docs/images`` anew, by today's code.

python tools/pictures [NAME ...]        # only these: hammer, predicted ...

What commands write on the way stays in ``pictures/``, so that a run that was ended goes on.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import architecture
import av

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
FRAME = 0.78
"""Which part of the film has gone by in the frame that is shown: the puck slides then."""
LEARNED, TRACKED = "hammer", "plate-slide"


def flowlab(*arguments: object) -> None:
    """Run a command of flowlab; ends the program where it fails."""
    words = [str(a) for a in arguments]
    print(f"$ flowlab {shlex.join(words)}", flush=True)
    subprocess.run([sys.executable, "-m", "flowlab", *words], check=True)


def draw_architecture(picture: Path, _: Path) -> None:
    """The rooms that an episode, a batch and an action go through."""
    picture.write_text(architecture.picture())


def draw_hammer(picture: Path, work: Path) -> None:
    """A demonstration with exact tracks."""
    flowlab("viz", demonstrations(work), "--episode", 0, "--png", picture)


def draw_predicted(picture: Path, work: Path) -> None:
    """What a policy predicts in the first episode that it solves."""
    run = work / "run"
    flowlab("train", demonstrations(work), "--policy", "fdp", "--minutes", 3, "--set", "batch.windows=32", "--out", run)
    flowlab("eval", run, "--episodes", 10, "--seeds", 0, "--workers", 1)
    lines = [line for log in (run / "evaluation").glob("*/episodes.jsonl") for line in log.open()]
    solved = sorted(tried["episode"] for tried in map(json.loads, lines) if tried["success"])
    if not solved:
        sys.exit(f"{run}: solves none of its episodes, so there is nothing to show")
    flowlab("viz", run, "--seed", 0, "--episode", solved[0], "--png", picture)


def draw_stated(picture: Path, work: Path) -> None:
    """Estimated tracks with their stated errors."""
    flowlab("viz", labels(work), "--png", picture)


def draw_film(picture: Path, work: Path) -> None:
    """A frame of the film of the same."""
    film = work / "film.mp4"
    flowlab("viz", labels(work), "--mp4", film)
    with av.open(film) as container:
        frames = [frame.to_image() for frame in container.decode(video=0)]
    frames[round(FRAME * len(frames))].save(picture, optimize=True)


def draw_grade(picture: Path, work: Path) -> None:
    """How far off labels are on films of all families that nothing was fitted on; what takes longest."""
    trackers = ("--tracker", "rigid-bodies,lucas-kanade")
    flowlab("grade", "--scenes", "all", "--episodes", 6, "--seed", 1000, *trackers, "--out", work / "grade")
    picture.write_bytes((work / "grade" / "grade.png").read_bytes())


def demonstrations(work: Path) -> Path:
    """A dataset of the task that is learned."""
    flowlab("extract-sim", LEARNED, "--episodes", 20, "--workers", 1, "--out", work / "data")
    return work / "data"


def labels(work: Path) -> Path:
    """A dataset of a recording by a simulated depth camera, labeled from the pictures alone, above the table."""
    crop = "observer.crop={low: [-0.5, 0.25, 0.012], high: [0.5, 0.97, 0.8]}"
    flowlab("grade", "--tasks", TRACKED, "--out", work / "graded")
    flowlab("track-real", work / "graded" / "recordings", "--set", crop, "--workers", 1, "--out", work / "real")
    return work / "real"


MAKERS: Mapping[str, Callable[[Path, Path], None]] = {
    "architecture.svg": draw_architecture,
    "hammer.png": draw_hammer,
    "predicted.png": draw_predicted,
    "stated.png": draw_stated,
    "film.png": draw_film,
    "grade.png": draw_grade,
}
"""What draws each picture, given where, and a folder to work in; what takes long comes last."""


def main() -> None:
    """Draw all, or those that are named."""
    parser = argparse.ArgumentParser(prog="tools/pictures")
    known = {Path(name).stem: name for name in MAKERS}
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)}; all by default")
    names = parser.parse_args().names
    if strange := {*names} - {*known}:
        parser.error(f"no picture is called {', '.join(sorted(strange))}; there are: {', '.join(known)}")
    for name in names or known:
        MAKERS[known[name]](IMAGES / known[name], ROOT / "pictures")
        print(f"{IMAGES / known[name]}", flush=True)


if __name__ == "__main__":
    main()
