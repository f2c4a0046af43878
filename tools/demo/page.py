"""What ``make demo`` shows: one page, whose numbers are read from the files that the commands wrote."""

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from flowlab import open_dataset
from flowlab.viz.stated_error import SIGMA_NAMES, SIGMA_RGB, percent, shares_below, stated_sigma

MINUTES = 1
"""Of CPU time that the policy trains for."""
_HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Cost:
    """One command that ran."""

    part: str
    """Of the page, which it made something for."""
    command: str
    """As it would be typed."""
    wall_s: float
    """How long it took by the clock [s]."""


@dataclass(frozen=True, slots=True)
class Failure(Exception):
    """A command that failed, or a result that is not what the demo promises."""

    part: str
    """Of the page, which misses something therefore."""
    command: str
    """The command, if it was one."""
    reason: str
    """One sentence."""

    def __str__(self) -> str:
        """The sentence, after the command."""
        return f"{self.command}: {self.reason}" if self.command else self.reason


def outcomes(folder: Path) -> list[dict[str, Any]]:
    """Every episode that the policy tried, in order; none where it was not evaluated."""
    lines = [line for f in (folder / "run" / "evaluation").glob("*/episodes.jsonl") for line in f.open()]
    return sorted((json.loads(line) for line in lines), key=lambda o: (o["seed"], o["episode"]))


def solved(folder: Path) -> tuple[int, int] | None:
    """How many episodes the policy solved, of how many; None where it was not evaluated."""
    tried = outcomes(folder)
    return (sum(o["success"] for o in tried), len(tried)) if tried else None


def first_solved(folder: Path) -> int | None:
    """Number of the first episode that was solved; None where none was."""
    return next((o["episode"] for o in outcomes(folder) if o["success"]), None)


def object_within(folder: Path) -> dict[str, float]:
    """Of the object's positions in sight, the share of each tracker within 20 mm; empty where nothing was graded."""
    graded = _read(folder / "graded" / "grade.json") or {"trackers": []}
    return {t["tracker"]: t["mean"]["object"]["within_20mm"] for t in graded["trackers"] if "object" in t["mean"]}


def facts(folder: Path) -> dict[str, Any]:
    """What the page says, from the files in the folder; a part whose files are not there is None."""
    return {
        "data": _read(folder / "data.json"),
        "train": _training(folder / "run"),
        "eval": _evaluation(folder),
        "labels": _labels(folder / "real"),
        "grade": _grade(folder / "graded" / "grade.json"),
    }


def _read(path: Path) -> Any:
    return json.loads(path.read_text()) if path.exists() else None


def _training(run: Path) -> dict[str, Any] | None:
    """The last look at the demonstration that was held out, and what the run was."""
    if not (run / "metrics.jsonl").exists():
        return None
    lines = [json.loads(line) for line in (run / "metrics.jsonl").open()]
    looks = [line for line in lines if line["kind"] == "validation"]
    return {**_read(run / "run.json"), "last": looks[-1], "cpu_s": lines[-1]["cpu_s"]} if looks else None


def _evaluation(folder: Path) -> dict[str, Any] | None:
    """How many episodes were solved, which one is shown, how far predicted flow was from what happened."""
    summary = (_read(folder / "report" / "report.json") or {}).get("summary")
    if not summary:
        return None
    return {
        "success": summary["successes"][0]["success"],
        "shown": next((o for o in outcomes(folder) if o["success"]), None),
        "flow": next((f["error"] for f in summary["flow"] if f["over"] == "all"), None),
    }


def _labels(real: Path) -> list[dict[str, Any]] | None:
    """The classes of stated errors: name, color, and the share of the labeled positions below its end."""
    if not (real / "flowlab.json").exists():
        return None
    sigma = stated_sigma(open_dataset(real).episode(0))
    assert sigma is not None
    named = zip(SIGMA_NAMES, SIGMA_RGB, shares_below(sigma), strict=True)
    return [
        {"name": name, "color": "#{:02x}{:02x}{:02x}".format(*rgb), "share": percent(share)}
        for name, rgb, share in named
    ]


def _grade(path: Path) -> dict[str, Any] | None:
    """The errors of each tracker, by the name of the group of points."""
    graded = _read(path)
    if graded is None:
        return None
    groups = {"all": "in sight", "moving": "have moved", "object": "on the object", "occluded": "out of sight"}
    return {
        "groups": groups,
        "trackers": {t["tracker"]: t["mean"] for t in graded["trackers"]},
        "recording": graded["trackers"][0]["recordings"][0],
    }


def write_page(folder: Path, costs: Sequence[Cost], failures: Sequence[Failure], wall_s: float) -> Path:
    """Write ``index.html``; pictures and films are linked beside it, so the folder can be moved as a whole.

    Args:
        folder: what the commands wrote into.
        costs: every command that ran.
        failures: what went wrong; said on the page where it belongs.
        wall_s: how long all of it took by the clock [s].

    Returns:
        The page.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((_HERE / "page.html.j2").read_text())
    page = folder / "index.html"
    page.write_text(
        template.render(
            facts(folder),
            costs=costs,
            failures=failures,
            wall_s=wall_s,
            minutes=MINUTES,
            processor=processor(),
            exists=lambda name: (folder / name).exists(),
        )
    )
    return page


def processor() -> str:
    """The machine's processor, as it names itself."""
    listed = Path("/proc/cpuinfo")
    names = [x for x in listed.read_text().splitlines() if x.startswith("model name")] if listed.exists() else []
    return names[0].split(":", 1)[1].strip() if names else platform.processor() or platform.machine()
