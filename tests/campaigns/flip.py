"""Damage one file of a dataset, run, evaluation, experiment or cache, and see that whoever reads it says so.

    python -m tests.campaigns.flip --seed 0 --count 2000

One bit is flipped, the end cut off, 4 kB zeroed, the file swapped with another of its kind, or gone. Then everything
that reads such a file is run. A damage is found when a command says so and ends with an exit code of 1 to 4, or says
that it mends it; harmless when all results and every number shown are what they are without it. Anything else is a
finding: a result that changed without a word, or a traceback.
"""

import random
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import click

from tests.campaigns import compare, faults
from tests.campaigns.campaign import Campaign, options
from tests.campaigns.engine import NAME as ENGINE
from tests.campaigns.sandbox import HUNG, Ended, call, warm_up
from tests.campaigns.scenes import SCENES, Workplace

OUTCOMES = ("found", "harmless", "SILENT", "traceback", "hung")


@dataclass(frozen=True)
class Kind:
    """Files of one kind, and what reads them."""

    needs: tuple[str, ...]
    files: str
    """A glob from the trial's folder."""
    readers: tuple[tuple[str, ...], ...]
    makes: tuple[str, ...] = ()
    """What readers make, which must be the same."""


_DATASET = (("validate", "data"), ("info", "data", "--json"), SCENES["train"].command, SCENES["export"].command)
_REAL = (("validate", "real"), ("info", "real", "--json"), ("viz", "real", "--png", "a.png"))
_REJECT = (("validate", "real"), ("info", "real", "--json"), ("viz", "real", "--rejects", "--png", "a.png"))
_EVAL = ("eval", "run", "--episodes", "1", "--seeds", "0", "--engine", ENGINE, "--workers", "1", "--json")
_RUN = (("validate", "run"), _EVAL, ("eval", "run", "--offline", "--json"))
_TRIED = (("report", "tried", "--out", "report", "--json"),)
_BENCH = (("report", "bench", "--json"), (*SCENES["bench"].command, "--json"))
KINDS = {
    "manifest": Kind(("data",), "data/flowlab.json", _DATASET, ("run", "store")),
    "receipts": Kind(("data",), "data/receipts/*", _DATASET, ("run", "store")),
    "shards": Kind(("data",), "data/shards/**/*", _DATASET, ("run", "store")),
    "shards of recordings": Kind(("real",), "real/shards/**/*", _REAL, ("a.png",)),
    "rejects": Kind(("real",), "real/rejects*/**/*", _REJECT, ("a.png",)),
    "summaries": Kind(("data",), "data/[srR][teE][ajA][tD]*", _DATASET, ("run", "store")),
    "cache": Kind(("cached",), "cached/cache/**/*", (("train", "cached", *SCENES["train"].command[2:]),), ("run",)),
    "policy.json": Kind(("data", "run"), "run/policy.json", _RUN),
    "run.json": Kind(("data", "run"), "run/run.json", _RUN),
    "checkpoints": Kind(("data", "run"), "run/*/*.safetensors", _RUN),
    "metrics": Kind(("data", "stopped"), "stopped/metrics.jsonl", (SCENES["resume"].command,), ("stopped",)),
    "resume": Kind(("data", "stopped"), "stopped/resume*", (SCENES["resume"].command,), ("stopped",)),
    "episodes": Kind(("data", "tried"), "tried/**/episodes*", _TRIED, ("report",)),
    "experiment": Kind(("bench", "bench.yaml"), "bench/units/**/*", _BENCH),
}  # fmt: skip
"""Recordings are the user's own, and what they hold is not checked against anything. An exported store is for other
tools: `export` promises that it is whole, and nothing of flowlab reads it but `train`, which checks its form."""


def _flip(file: Path, chance: random.Random) -> str:
    content = bytearray(file.read_bytes())
    bit = chance.randrange(8 * len(content))
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)
    return f"bit {bit}"


def _cut(file: Path, chance: random.Random) -> str:
    size = chance.randrange(file.stat().st_size)
    with file.open("r+b") as opened:
        opened.truncate(size)
    return f"cut off at byte {size}"


def _zero(file: Path, chance: random.Random) -> str:
    content = bytearray(file.read_bytes())
    start = chance.randrange(0, len(content), 4096)
    content[start : start + 4096] = bytes(len(content[start : start + 4096]))
    file.write_bytes(content)
    return f"4 kB of zeros at {start}"


def _drop(file: Path, chance: random.Random) -> str:
    file.unlink()
    return "gone"


def _swap(file: Path, other: Path) -> str:
    aside = file.with_name(f"{file.name}.aside")
    file.rename(aside)
    other.rename(file)
    aside.rename(other)
    return f"swapped with {other.name}"


_DAMAGES: tuple[Callable[[Path, random.Random], str], ...] = (_flip, _flip, _flip, _cut, _zero, _drop)


@options(count=2000)
def main(seed: int, count: int, budget: float, only: tuple[str, ...], keep: Path) -> None:
    faults.begin_with_faults()
    warm_up()
    campaign = Campaign("flip", OUTCOMES, ("found", "harmless"), keep)
    kinds = {name: KINDS[name] for name in only or KINDS}
    place = Workplace(campaign.folder)
    known: dict[str, list[tuple[str, str]]] = {}
    names = list(kinds)
    for number in campaign.trials(seed, count, budget):
        name = names[number % len(names)]
        kind = kinds[name]
        if name not in known:
            kind = kinds[name] = _readable(name, kind, place)
            folder = place.trial(kind.needs)
            known[name] = [(e.out, e.err) for e in _read(kind, folder)[0]]
            known[name].append(("", repr(compare.state(folder, kind.makes))))
        chance = random.Random(number)
        folder = place.trial(kind.needs)
        if (damage := _damage(kind, folder, chance)) is None:
            continue
        outcome, about = _judge(kind, folder, known[name])
        campaign.add(name, outcome, f"seed {number}: {damage}: {about}", folder)
    campaign.finish()


def _readable(name: str, kind: Kind, place: Workplace) -> Kind:
    """The kind with those of its readers that can read undamaged files; which cannot is said."""
    ended, _ = _read(kind, place.trial(kind.needs))
    for command, of in zip(kind.readers, ended, strict=True):
        if of.code:
            click.echo(f"{name}: left out, since it reads none: flowlab {' '.join(command)}: {of.last_line}", err=True)
    return replace(kind, readers=tuple(c for c, of in zip(kind.readers, ended, strict=True) if not of.code))


def _damage(kind: Kind, folder: Path, chance: random.Random) -> str | None:
    """Damage one file; None where there is none of the kind."""
    files = sorted(p for p in folder.glob(kind.files) if p.is_file() and p.stat().st_size)
    if not files:
        return None
    file = chance.choice(files)
    others = [p for p in files if p != file and p.suffix == file.suffix and p.read_bytes() != file.read_bytes()]
    where = file.relative_to(folder)
    if others and chance.random() < 0.15:
        return f"{where} {_swap(file, chance.choice(others))}"
    return f"{where} {chance.choice(_DAMAGES)(file, chance)}"


def _read(kind: Kind, folder: Path, stop: bool = False) -> tuple[list[Ended], bool]:
    """Run what reads; with ``stop``, no further than the first that finds something."""
    ended = []
    for command in kind.readers:
        ended.append(call(command, folder))
        if stop and (ended[-1].code not in (0, 2) or ended[-1].traceback):
            return ended, True
    return ended, False


def _judge(kind: Kind, folder: Path, known: list[tuple[str, str]]) -> tuple[str, str]:
    ended, _ = _read(kind, folder, stop=True)
    last = ended[-1]
    if bad := next((e for e in ended if e.traceback), None):
        return "traceback", bad.err[-2500:]
    if last.code == HUNG:
        return "hung", ""
    if last.code not in (0, 2):
        return "found", last.last_line
    told = [e.last_line for e, (_, before) in zip(ended, known, strict=False) if _new_words(e.err, before)]
    if told:
        return "found", told[0]
    changed = [k for k, (e, (out, _)) in enumerate(zip(ended, known, strict=False)) if _still(e.out) != _still(out)]
    if changed:
        return "SILENT", f"{' '.join(kind.readers[changed[0]])} says: {ended[changed[0]].out[:1500]}"
    if repr(compare.state(folder, kind.makes)) != known[-1][1]:
        return "SILENT", f"another result in {', '.join(kind.makes)}"
    return "harmless", ""


_NUMBERS_OF_THE_MOMENT = re.compile(r"\d[\d.,]* (s|s left|windows/s)\b|\"[a-z_]*(_s|ms|memory_mb|cpu|wall)\": [-\d.e]+")


def _still(text: str) -> str:
    return _NUMBERS_OF_THE_MOMENT.sub("", text)


def _new_words(text: str, before: str) -> bool:
    """Whether a command says what it did not say of undamaged files."""

    def lines(of: str) -> set[str]:
        return {re.sub(r"[\d.,]+", "", line) for line in of.splitlines()}

    return bool(lines(text) - lines(before))


if __name__ == "__main__":
    main()
