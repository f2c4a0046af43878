"""Damage one file of a dataset, run, evaluation, experiment or cache, and see that whoever reads it says so.

    python -m tests.campaigns.flip --seed 0 --count 2000

One bit is flipped, the end cut off, 4 kB zeroed, the file swapped with another of its kind, or gone. Then everything
that reads such a file is run. Each command must say so, by an exit code of 1 to 4 and a sentence or by a warning, or
its results and every number that it shows must be what they are without the damage. Anything else is a finding.
"""

import json
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import click

from tests.campaigns import compare, faults
from tests.campaigns.campaign import Campaign, options
from tests.campaigns.engine import NAME as ENGINE
from tests.campaigns.sandbox import CACHE, HUNG, Ended, call, warm_up
from tests.campaigns.scenes import SCENES, Workplace

OUTCOMES = ("found", "harmless", "SILENT", "traceback", "hung")


@dataclass(frozen=True)
class Reader:
    """A command that reads files, and what it makes of them."""

    command: tuple[str, ...]
    makes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kind:
    """Files of one kind, and what reads them."""

    needs: tuple[str, ...]
    files: tuple[str, ...]
    """Globs from the trial's folder."""
    readers: tuple[Reader, ...]


def _of(scene: str, *more: str) -> Reader:
    return Reader((*SCENES[scene].command, *more), SCENES[scene].makes)


def _dataset(name: str, *more: Reader) -> tuple[Reader, ...]:
    return Reader(("validate", name)), Reader(("info", name, "--json")), *more


_DATASET = _dataset("data", _of("train"), _of("export"))
_REAL = _dataset("real", Reader(("viz", "real", "--png", "a.png"), ("a.png",)))
_REJECTED = _dataset("rejected", Reader(("viz", "rejected", "--rejects", "--png", "a.png"), ("a.png",)))
_EVAL = ("eval", "run", "--episodes", "1", "--seeds", "0", "--engine", ENGINE, "--workers", "1", "--json")
_RUN = (Reader(("validate", "run")), Reader(_EVAL), Reader(("eval", "run", "--offline", "--json")))
_STOPPED = (Reader(("validate", "stopped")), _of("resume"))
_TRIED = (Reader(("validate", "tried")), Reader(("report", "tried", "--out", "report", "--json"), ("report",)))
_BENCH = (Reader(("validate", "bench")), Reader(("report", "bench", "--json")), _of("bench", "--json"))
KINDS = {
    "manifest": Kind(("data",), ("data/flowlab.json",), _DATASET),
    "receipts": Kind(("data",), ("data/receipts/*",), _DATASET),
    "shards": Kind(("data",), ("data/shards/**/*",), _DATASET),
    "shards of recordings": Kind(("real",), ("real/shards/**/*",), _REAL),
    "rejects": Kind(("rejected",), ("rejected/rejects*", "rejected/rejects/**/*"), _REJECTED),
    "summaries": Kind(("data",), ("data/stats.json", "data/rejects.jsonl", "data/README.md"), _DATASET),
    "cache": Kind(("data", CACHE), (f"{CACHE}/**/*",), (_of("train"),)),
    "policy.json": Kind(("data", "run"), ("run/policy.json",), _RUN),
    "run.json": Kind(("data", "run"), ("run/run.json",), _RUN),
    "checkpoints": Kind(("data", "run"), ("run/*/*.safetensors",), _RUN),
    "metrics": Kind(("data", "stopped"), ("stopped/metrics.jsonl",), _STOPPED),
    "resume": Kind(("data", "stopped"), ("stopped/resume*",), _STOPPED),
    "episodes": Kind(("data", "tried"), ("tried/**/episodes*",), _TRIED),
    "experiment": Kind(("bench", "bench.yaml"), ("bench/units/**/*",), _BENCH),
}
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
    known: dict[str, list[Read]] = {}
    names = list(kinds)
    for number in campaign.trials(seed, count, budget):
        name = names[number % len(names)]
        if name not in known:
            known[name] = list(_read(kinds[name], place.trial(kinds[name].needs)))
            _check_readable(name, known[name])
        chance = random.Random(number)
        folder = place.trial(kinds[name].needs)
        damage = _damage(kinds[name], folder, chance)
        outcome, about = _judge(_read(kinds[name], folder), known[name])
        campaign.add(name, outcome, f"seed {number}: {damage}: {about}", folder)
    campaign.finish()


@dataclass(frozen=True)
class Read:
    """What came of a reader."""

    reader: Reader
    ended: Ended
    made: dict[str, str]


def _read(kind: Kind, folder: Path) -> Iterator[Read]:
    for reader in kind.readers:
        ended = call(reader.command, folder)
        yield Read(reader, ended, compare.state(folder, reader.makes))


def _check_readable(name: str, reads: list[Read]) -> None:
    """Every reader of a kind can read undamaged files, or it would find all damages."""
    for read in reads:
        if read.ended.code:
            words = " ".join(read.reader.command)
            raise click.ClickException(f"{name}: undamaged files fail: flowlab {words}: {read.ended.err[-2000:]}")


def _damage(kind: Kind, folder: Path, chance: random.Random) -> str:
    """Damage one file."""
    found = {p for pattern in kind.files for p in folder.glob(pattern)}
    files = sorted(p for p in found if p.is_file() and p.stat().st_size)
    file = chance.choice(files)
    others = [p for p in files if p != file and p.suffix == file.suffix and p.read_bytes() != file.read_bytes()]
    where = file.relative_to(folder)
    if others and chance.random() < 0.15:
        return f"{where} {_swap(file, chance.choice(others))}"
    return f"{where} {chance.choice(_DAMAGES)(file, chance)}"


def _judge(reads: Iterator[Read], known: list[Read]) -> tuple[str, str]:
    """Each reader by itself: that one finds a damage does not excuse another that is wrong in silence."""
    told = ""
    for read, before in zip(reads, known, strict=True):
        ended, words = read.ended, " ".join(read.reader.command)
        if ended.code == HUNG:
            return "hung", words
        if ended.traceback or not 0 <= ended.code <= 4 or (ended.code and not ended.err.strip()):
            return "traceback", f"{words}: exit code {ended.code}: {ended.err[-2500:]}"
        if ended.code or _new_words(ended.err, before.ended.err) or _is_missing(ended.out):
            told = told or ended.last_line
        elif _still(ended.out) != _still(before.ended.out):
            return "SILENT", f"{words} says otherwise: {_first_difference(ended.out, before.ended.out)}"
        elif changed := list(compare.differences(read.made, before.made)):
            return "SILENT", f"{words} makes other {', '.join(changed[:5])}"
    return ("found", told) if told else ("harmless", "")


def _still(text: str) -> str:
    """What a command prints, without what it measured."""
    try:
        values = compare.still(json.loads(text))
        if isinstance(values, dict):
            values.pop("megabytes", None)  # of whatever files there are
        return json.dumps(values, indent=1)
    except ValueError:
        return re.sub(r"\d[\d.,]* (s|s left|windows/s)\b", "", text)


def _is_missing(text: str) -> bool:
    """Whether `info` says that episodes are missing."""
    try:
        return bool(json.loads(text).get("missing"))
    except (ValueError, AttributeError):
        return False


def _first_difference(text: str, before: str) -> str:
    lines = zip(_still(text).splitlines(), _still(before).splitlines(), strict=False)
    return next((f"{x[:200]}, not {y[:200]}" for x, y in lines if x != y), "more or less of it")


def _new_words(text: str, before: str) -> bool:
    """Whether a command says what it did not say of undamaged files."""

    def lines(of: str) -> set[str]:
        return {re.sub(r"[\d.,]+", "", line) for line in of.splitlines()}

    return bool(lines(text) - lines(before))


if __name__ == "__main__":
    main()
