"""``make demo``: a task from simulation to a policy that solves it, and to labels made from pictures alone.

Two chains of commands, one for each of two cores; each command is shown as it would be typed. What they wrote ends up
on one page, ``demo/index.html``. Whatever fails is said there and here, and so are a policy that solves less than half
of its episodes, and labels of which too few are near the truth, or fewer than a classic tracker's.
"""

import os
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from page import MINUTES, Cost, Failure, first_solved, object_within, solved, write_page

TASK = "plate-slide"
"""What is learned and labeled. Of the tasks that were tried (hammer, drawer-open, door-open, push, faucet-open), labels
from pictures are best here: what is shown has to be worth a look."""
LEAST_WITHIN = 0.6
"""The share of the object's positions within 20 mm from which on labels are good enough to be shown."""
EPISODES = 20
WORKSPACE = "{low: [-0.5, 0.25, 0.012], high: [0.5, 0.97, 0.8]}"
"""What is labeled: a box that ends just above the table, as a person would measure it [m]."""
SLOW = ("--fps", "15")
"""Five times slower than it happened, to be watched."""


@dataclass
class Commands:
    """Runs commands of flowlab, one after another, and keeps what each cost."""

    folder: Path
    costs: list[Cost] = field(default_factory=list)
    talking: threading.Lock = field(default_factory=threading.Lock)

    def run(self, part: str, *arguments: object, into: str | None = None) -> None:
        """Run ``flowlab ARGUMENTS``; ``into`` keeps its output as a file of that name.

        Raises :class:`Failure` with the command's own last words where it fails.
        """
        words = [str(a) for a in arguments]
        shown = f"flowlab {shlex.join(words)}" + (f" > {self.folder / into}" if into else "")
        self._say(f"$ {shown}")
        began = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "flowlab", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        output, errors = process.communicate()
        spent = time.perf_counter() - began
        self.costs.append(Cost(part, shown, spent))
        if process.returncode:
            last = (errors.strip() or output.strip()).splitlines() or [f"exit code {process.returncode}"]
            raise Failure(part, shown, last[-1])
        if into:
            (self.folder / into).write_text(output)
        self._say(f"{'' if into else output.rstrip()}\n({spent:.0f} s: flowlab {words[0]})")

    def _say(self, text: str) -> None:
        with self.talking:
            print(text.strip(), flush=True)


def learn(commands: Commands, task: str = TASK, training: tuple[str, ...] = ("--minutes", str(MINUTES))) -> None:
    """Demonstrations with exact flow, a policy trained on them, what it does in scenes it has not seen."""
    at = commands.folder
    run = commands.run
    run("data", "extract-sim", task, "--episodes", EPISODES, "--workers", 1, "--out", at / "data")
    run("data", "validate", at / "data")
    run("data", "info", at / "data", "--json", into="data.json")
    run("data", "viz", at / "data", "--episode", 0, "--png", at / "data.png", "--save", at / "data.rrd")
    small = ("--set", "batch.windows=32")  # many small steps: what matters where a minute has few
    run("train", "train", at / "data", "--policy", "fdp", *training, *small, "--out", at / "run")
    run("eval", "eval", at / "run", "--episodes", EPISODES, "--seeds", 0, "--workers", 1, "--out", at / "report")
    if (episode := first_solved(at)) is not None:
        looks = ("--png", at / "policy.png", "--mp4", at / "policy.mp4", "--save", at / "policy.rrd", *SLOW)
        run("eval", "viz", at / "run", "--seed", 0, "--episode", episode, *looks)


def label(commands: Commands, task: str = TASK) -> None:
    """What a depth camera would have seen, labeled from the pictures alone, and how good the labels are."""
    at = commands.folder
    trackers = ("--tracker", "rigid-bodies,lucas-kanade")
    commands.run("grade", "grade", "--tasks", task, *trackers, "--out", at / "graded")
    crop = ("--set", f"observer.crop={WORKSPACE}")
    commands.run("label", "track-real", at / "graded" / "recordings", *crop, "--workers", 1, "--out", at / "real")
    commands.run("label", "validate", at / "real")
    looks = ("--png", at / "real.png", "--mp4", at / "real.mp4", "--save", at / "real.rrd", *SLOW)
    commands.run("label", "viz", at / "real", *looks)


def main(folder: Path, *chains: Callable[[Commands], None]) -> int:
    """Run the chains side by side and write the page; the exit code."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    commands = Commands(folder)
    failures = []
    with ThreadPoolExecutor(len(chains)) as pool:
        for chain in [pool.submit(chain, commands) for chain in chains]:
            try:
                chain.result()
            except Failure as failure:
                failures.append(failure)
    share = solved(folder)
    if share is not None and 2 * share[0] < share[1]:
        failures.append(Failure("eval", "", f"the policy solved only {share[0]} of {share[1]} episodes"))
    within = object_within(folder)
    if within and within["rigid-bodies"] < max(LEAST_WITHIN, *within.values()):
        said = ", ".join(f"{share:.0%} by {name}" for name, share in within.items())
        failures.append(Failure("grade", "", f"of the object's positions are within 20 mm: {said}"))
    page = write_page(folder, commands.costs, failures, time.perf_counter() - began)
    for failure in failures:
        print(f"FAILED: {failure}", file=sys.stderr)
    print(f"\nOpen {page.resolve().as_uri()}")
    return 1 if failures else 0


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "100")
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo"), learn, label))
