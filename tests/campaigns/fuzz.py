"""Fuzzing: files of every kind made wrong, and whatever is not a value or a sentence told, by where it was raised.

``python -m tests.campaigns.fuzz --seed 0 --count 2000 --budget 3600``
"""

import faulthandler
import os

os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)  # which forks want
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path

import click
import cv2

from flowlab.errors import FlowlabError
from tests.campaigns.fuzz_kinds import KINDS, Kind, change, seal
from tests.campaigns.watch import Watch

_A_CHILD_DOES = 300
_SECONDS = 20
"""An input that takes longer hangs."""
_MEMORY = int(1.5 * (1 << 30))
_ROOT = Path(__file__).parents[2]
_SENTINEL = "sentinel_module.py"


@dataclass
class Tally:
    """What came of a kind's inputs."""

    done: int = 0
    values: int = 0
    sentences: int = 0
    peak_mb: float = 0.0
    seconds: float = 0.0
    slowest_s: float = 0.0
    nets: Counter[str] = field(default_factory=Counter)
    """Sentences that only the last net made of an error of a library, by where it was raised."""
    findings: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    """Inputs, by what was wrong."""


def case_rng(seed: int, kind: str, index: int) -> random.Random:
    """The random numbers of an input."""
    return random.Random(f"{seed} {kind} {index}")


def prepare(kind: Kind, sample: Path, seed: int, index: int, folder: Path) -> random.Random:
    """Make an input, with a module that must not run beside it, or one folder up where one beside it may."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sample, folder)
    sentinel = (folder.parent if kind.names_code else folder) / _SENTINEL
    sentinel.write_text("raise SystemExit('code of the recording ran')\n")
    rng = case_rng(seed, kind.name, index)
    change(folder, kind.of, rng)
    if kind.sealed and rng.random() < 0.5:
        seal(folder)
    return rng


def outcome(kind: Kind, folder: Path, rng: random.Random) -> str:
    """What comes of an input: ``value``, ``sentence``, ``net PLACE`` or ``bad WHAT``."""
    quiet = StringIO()
    try:
        with redirect_stdout(quiet), redirect_stderr(quiet):
            kind.run(folder, rng)
        return "value"
    except FlowlabError as error:
        text = str(error)
        if len(text) > 8_200 or (not text.isprintable() and "\n" not in text):
            return "bad a sentence that is too long or not printable"
        cause = error.__cause__
        if cause is not None and "the reader '" in text and not isinstance(cause, FlowlabError):
            return f"net {_place(cause)}"
        return "sentence"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return f"bad {_place(error)}"


def _place(error: BaseException) -> str:
    """Kind of an error, the last line of flowlab in its traceback, and where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if f"{_ROOT}/flowlab/" in f.filename]
    last = frames[-1] if frames else None
    where = f"{Path(own[-1].filename).relative_to(_ROOT)}:{own[-1].lineno}" if own else "outside of flowlab"
    raised = f" via {Path(last.filename).name}:{last.lineno}" if last and own and last is not own[-1] else ""
    return f"{where} {type(error).__name__}{raised}: {str(error)[:80]!r}"


def _child(kind: Kind, sample: Path, seed: int, indices: range, scratch: Path, pipe: int, end: float) -> None:
    """Do some inputs, and tell what came of each through a pipe."""
    watch = Watch(scratch)
    os.chdir(scratch)
    os.environ.update(HOME=str(scratch), FLOWLAB_CACHE=str(scratch / "cache"), TMPDIR=str(scratch))
    tempfile.tempdir = str(scratch)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for index in indices:
        if time.monotonic() > end:
            return
        os.write(pipe, f"{index} begin\n".encode())
        rng = prepare(kind, sample, seed, index, scratch / "case")
        start, watch.armed = time.perf_counter(), True
        found = outcome(kind, scratch / "case", rng)
        watch.armed = False
        took = time.perf_counter() - start
        for what in watch.seen:
            os.write(pipe, f"{index} bad {what!r}\n".encode()[:4000])
        watch.seen.clear()
        peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        os.write(pipe, f"{index} end {took:.3f} {peak:.0f} {found!a}\n".encode()[:4000])


def _do(kind: Kind, sample: Path, seed: int, indices: range, scratch: Path, tally: Tally, end: float) -> int:
    """Fork a child for some inputs; the index after the last that was done."""
    read, write = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 70
        try:
            os.close(read)
            null = os.open(os.devnull, os.O_RDWR)
            for handle in (0, 1, 2):
                os.dup2(null, handle)
            faulthandler.enable(os.open(scratch / "fault.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC))
            _child(kind, sample, seed, indices, scratch, write, end)
            code = 0
        finally:
            os._exit(code)
    os.close(write)
    last = _listen(read, child, tally, indices)
    _, status = os.waitpid(child, 0)
    os.close(read)
    if status and last < indices.stop:
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) != signal.SIGALRM:
            name = signal.Signals(os.WTERMSIG(status)).name
            tally.findings[f"{'hangs' if name == 'SIGKILL' else f'crashes with {name}'}: {_fault(scratch)}"].append(
                last
            )
        elif not os.WIFSIGNALED(status):
            tally.findings[f"ends the program ({os.WEXITSTATUS(status)})"].append(last)
        return last + 1
    return indices.stop


def _fault(scratch: Path) -> str:
    lines = [x.strip() for x in (scratch / "fault.txt").read_text().splitlines() if "/flowlab/" in x]
    return lines[0].replace(str(_ROOT), "") if lines else "unknown place"


def _listen(pipe: int, child: int, tally: Tally, indices: range) -> int:
    """Take in what a child tells, and kill it where it tells nothing for too long; the last input it began."""
    last, rest = indices.start, b""
    while True:
        ready, _, _ = select.select([pipe], [], [], _SECONDS)
        if not ready:
            os.kill(child, signal.SIGKILL)
            return last
        more = os.read(pipe, 1 << 16)
        if not more:
            return last
        *lines, rest = (rest + more).split(b"\n")
        for line in lines:
            number, _, what = line.decode().partition(" ")
            last = int(number)
            _count(tally, last, what)


def _count(tally: Tally, index: int, what: str) -> None:
    if what.startswith("bad "):
        tally.findings[what[4:]].append(index)
    if not what.startswith("end "):
        return
    _, took, peak, found = what.split(" ", 3)
    found = found.strip("'\"")
    tally.done += 1
    tally.slowest_s = max(tally.slowest_s, float(took))
    tally.peak_mb = max(tally.peak_mb, float(peak))
    tally.values += found == "value"
    tally.sentences += found == "sentence" or found.startswith("net ")
    if found.startswith("net "):
        tally.nets[found[4:]] += 1
    if found.startswith("bad "):
        tally.findings[found[4:]].append(index)


def fuzz_kind(kind: Kind, seed: int, count: int, seconds: float, scratch: Path) -> Tally:
    """Do inputs of a kind until there are enough or the time is over."""
    tally, start, at = Tally(), time.monotonic(), 0
    sample = scratch / "sample"
    kind.make(sample)
    _warm_up(kind, sample, scratch)
    while at < count and time.monotonic() - start < seconds:
        at = _do(kind, sample, seed, range(at, min(count, at + _A_CHILD_DOES)), scratch, tally, start + seconds)
    tally.seconds = time.monotonic() - start
    return tally


def _warm_up(kind: Kind, sample: Path, scratch: Path) -> None:
    """Have everything imported and compiled before children are forked, and see that the sample is a good one."""
    import matplotlib.font_manager  # which looks for fonts by a program of its own

    from flowlab.pipeline.recipe import load_recipe

    assert matplotlib
    load_recipe("metaworld").pipeline().provenance("push")  # which opens the simulator, and its libraries
    shutil.copytree(sample, scratch / "case")
    for k in range(3):
        found = outcome(kind, scratch / "case", case_rng(0, kind.name, k))
        if found.startswith(("bad", "net")):
            raise click.ClickException(f"{kind.name}: the sample itself fails: {found}")


@click.command()
@click.option("--seed", default=0, show_default=True, help="Of the mutations.")
@click.option("--count", default=200, show_default=True, help="Inputs of each kind, times its share.")
@click.option("--budget", default=3600.0, show_default=True, help="Seconds, for all kinds together.")
@click.option("--kind", "kinds", multiple=True, type=click.Choice(sorted(KINDS)), help="Only these kinds.")
@click.option("--keep", type=click.Path(path_type=Path), default=Path("fuzz-findings"), help="Where inputs are kept.")
def main(seed: int, count: int, budget: float, kinds: tuple[str, ...], keep: Path) -> None:
    """Feed flowlab files that are wrong in every way; 1 where anything but a value or a sentence came of one."""
    cv2.setNumThreads(1)  # here, for forks have no threads
    chosen = [KINDS[name] for name in kinds or KINDS]
    end, bad, total = time.monotonic() + budget, 0, 0
    shares = sum(k.share for k in chosen)
    print(
        f"{'kind':<16}{'inputs':>8}{'values':>8}{'sentences':>10}{'findings':>9}{'MB':>6}{'slowest':>8}{'seconds':>8}"
    )
    for kind in chosen:
        left = (end - time.monotonic()) * kind.share / shares
        shares -= kind.share
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            tally = fuzz_kind(kind, seed, count * kind.share, left, Path(folder).resolve())
            _keep(kind, seed, tally, keep, Path(folder).resolve())
        total, bad = total + tally.done, bad + len(tally.findings)
        print(f"{kind.name:<16}{tally.done:>8}{tally.values:>8}{tally.sentences:>10}{len(tally.findings):>9}"
              f"{tally.peak_mb:>6.0f}{tally.slowest_s:>8.2f}{tally.seconds:>8.0f}", flush=True)  # fmt: skip
        for what, where in tally.findings.items():
            print(f"    {len(where)} x {what}  (e.g. --kind {kind.name}, input {where[0]})")
        for what, times in tally.nets.most_common(8):
            print(f"    told by the last net, {times} x {what}")
    print(f"{total} inputs, {bad} findings; seed {seed}")
    sys.exit(1 if bad else 0)


def _keep(kind: Kind, seed: int, tally: Tally, keep: Path, scratch: Path) -> None:
    """Keep an input of every finding."""
    for where in tally.findings.values():
        prepare(kind, scratch / "sample", seed, where[0], scratch / "case")
        target = keep / f"{kind.name}-{seed}-{where[0]}"
        if not target.exists():
            keep.mkdir(parents=True, exist_ok=True)
            shutil.copytree(scratch / "case", target, symlinks=True, ignore=lambda d, names: [
                n for n in names if not (Path(d, n).is_file() or Path(d, n).is_dir())])  # fmt: skip


if __name__ == "__main__":
    main()
