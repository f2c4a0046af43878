"""Which seeds a dataset gets does not depend on who did what when, or how often the run was cut off."""

import random
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import THOROUGH, examples

from flowlab.engines.base import UnitResult
from flowlab.errors import UsageError
from flowlab.pipeline import filling
from flowlab.pipeline.filling import run_all
from flowlab.pipeline.scheduling import ExtractionProgress, RecordingScheduler, SeedScheduler, next_units, unit_size
from flowlab.pipeline.units import JobShard, WorkUnit
from flowlab.storage.receipts import Receipt, Reject, keep_receipt, read_receipts
from flowlab.storage.recorded import Recorded
from flowlab.storage.stats import merge

TASKS = ("push", "roll")

NO_STATS = merge([])


class CutOff(Exception):
    """The run was ended from outside."""


@dataclass
class World:
    """Which seeds succeed, who tried what, and the dice that decide on order and accidents."""

    folder: Path
    solved: Callable[[str, int], bool]
    dice: random.Random
    tried: list[tuple[int, str, int]] = field(default_factory=list)
    """Share, task and seed of every try that was brought to its end."""

    def do(self, share: int, unit: WorkUnit) -> Receipt:
        accepted = tuple(s for s in unit.seeds if self.solved(unit.task, s))
        self.tried += [(share, unit.task, s) for s in unit.seeds]
        receipt = Receipt(
            unit=unit.name, task=unit.task, seeds=unit.seeds, accepted=accepted,
            frames=(1,) * len(accepted), digests=("",) * len(accepted), stats=NO_STATS,
        )  # fmt: skip
        keep_receipt(self.folder, receipt)
        return receipt


class RandomEngine:
    """Brings units to their end in random order; at ``cut_off`` of them the run dies, some of its units done."""

    workers = 1

    def __init__(self, world: World, share: int, pause: Callable[[], None], cut_off: int | None) -> None:
        self.world, self.share, self.pause, self.left = world, share, pause, cut_off
        self.under_way: list[WorkUnit] = []

    def submit(self, unit: WorkUnit) -> None:
        self.under_way.append(unit)

    def next_result(self) -> UnitResult:
        self.pause()
        if self.left == 0:
            for unit in self.under_way:
                if self.world.dice.random() < 0.3:
                    self.world.do(self.share, unit)
            raise CutOff
        self.left = None if self.left is None else self.left - 1
        unit = self.under_way.pop(self.world.dice.randrange(len(self.under_way)))
        return UnitResult(unit, self.world.do(self.share, unit))


def run_shares(world: World, wanted: dict[str, int], first_seed: int, shares: int, cut_off: dict[int, int]) -> None:
    """All shares at once; at any moment one of them goes on, and the dice say which."""
    turn = [threading.Semaphore(0) for _ in range(shares)]
    back = threading.Semaphore(0)
    errors: list[BaseException] = []
    running = set(range(shares))

    def pause(k: int) -> Callable[[], None]:
        def wait() -> None:
            back.release()
            turn[k].acquire()

        return wait

    def share(k: int) -> None:
        turn[k].acquire()
        engine = RandomEngine(world, k, pause(k), cut_off.get(k))
        try:
            assert (
                run_all(engine, SeedScheduler(wanted, first_seed), world.folder, JobShard(k, shares), lambda _: None)
                == []
            )
        except CutOff:
            pass
        except BaseException as error:
            errors.append(error)
        running.discard(k)
        back.release()

    threads = [threading.Thread(target=share, args=[k], daemon=True) for k in running]
    for thread in threads:
        thread.start()
    while running:
        turn[world.dice.choice(sorted(running))].release()
        back.acquire()
    if errors:
        raise errors[0]


def check_seeds(world: World, wanted: dict[str, int], first_seed: int) -> None:
    """The first ``wanted`` successes in seed order, and no seed tried beyond what that takes."""
    receipts = read_receipts(world.folder)
    for task, n in wanted.items():
        needed, successes, seed = [], [], first_seed
        while len(successes) < n:
            needed.append(seed)
            successes += [seed] if world.solved(task, seed) else []
            seed += 1
        beyond = max(needed[-1], first_seed + n - 1)
        mine = [r for r in receipts if r.task == task]
        assert sorted(s for r in mine for s in r.accepted) == successes
        assert sorted(s for r in mine for s in r.seeds) == list(range(first_seed, beyond + 1))


@pytest.fixture(autouse=True, scope="module")
def _no_summaries() -> Iterator[None]:
    """Nothing but receipts is in these folders, and on a slow machine a summary would be due."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(filling, "_SECONDS_BETWEEN_SUMMARIES", float("inf"))
        yield


MANY = (40, 70) if THOROUGH else (32,)


def first_round_names(task: str, wanted: int, first_seed: int) -> set[str]:
    """Units of the first round by the rule that ``docs/dataset.md`` gives, written down once more."""
    size = max(2, min(16, wanted // 16))
    names = set()
    for start in range(0, wanted, size):
        first, last = first_seed + start, first_seed + min(start + size, wanted) - 1
        names.add(f"{task}-{first:06d}" + ("" if first == last else f"-{last:06d}"))
    return names


@settings(max_examples=examples(50), deadline=None)
@given(
    wanted=st.fixed_dictionaries({t: st.integers(1, 12) | st.sampled_from(MANY) for t in TASKS}),
    first_seed=st.integers(0, 50),
    solved_share=st.sampled_from([0.2, 0.5, 0.9, 1.0]),
    shares=st.integers(1, 4),
    together=st.booleans(),
    cut_offs=st.lists(st.dictionaries(st.integers(0, 3), st.integers(0, 12), max_size=4), max_size=3),
    seed=st.integers(0, 2**31),
)
def test_any_way_to_run_gives_the_first_successes_in_seed_order(
    tmp_path_factory: pytest.TempPathFactory,
    wanted: dict[str, int],
    first_seed: int,
    solved_share: float,
    shares: int,
    together: bool,
    cut_offs: list[dict[int, int]],
    seed: int,
) -> None:
    folder = tmp_path_factory.mktemp("units")
    (folder / "receipts").mkdir()
    world = World(folder, lambda t, s: random.Random(f"{t} {s} {seed}").random() < solved_share, random.Random(seed))

    def run(cut_off: dict[int, int]) -> None:
        if together:
            run_shares(world, wanted, first_seed, shares, cut_off)
            return
        for k in range(shares):
            engine = RandomEngine(world, k, lambda: None, cut_off.get(k))
            try:
                run_all(engine, SeedScheduler(wanted, first_seed), folder, JobShard(k, shares), lambda _: None)
            except CutOff:
                return

    for cut_off in cut_offs:
        run(cut_off)
    run({})
    check_seeds(world, wanted, first_seed)
    by_share = Counter(world.tried)
    assert max(by_share.values()) == 1, "one share tried a seed twice"
    if not (together and shares > 1):
        assert len({(t, s) for _, t, s in world.tried}) == len(world.tried), (
            "two shares tried a seed, one after the other"
        )
    names = {r.unit for r in read_receipts(folder)}
    for task, n in wanted.items():
        assert first_round_names(task, n, first_seed) <= names


@settings(max_examples=examples(30), deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=4), st.integers(0, 2**31))
def test_extending_a_dataset_step_by_step_gives_the_same_seeds(
    tmp_path_factory: pytest.TempPathFactory, requests: list[int], seed: int
) -> None:
    folder = tmp_path_factory.mktemp("units")
    (folder / "receipts").mkdir()
    world = World(folder, lambda _, s: random.Random(f"{s} {seed}").random() < 0.6, random.Random(seed))
    for n in sorted(requests):
        before = read_receipts(folder)
        run_all(
            RandomEngine(world, 0, lambda: None, None),
            SeedScheduler({"push": n}, 0),
            folder,
            JobShard(),
            lambda _: None,
        )
        check_seeds(world, {"push": n}, 0)
        assert all(r in read_receipts(folder) for r in before)
    assert max(Counter(world.tried).values()) == 1


def test_units_given_up_are_not_tried_again_in_the_same_run(tmp_path: Path) -> None:
    """Their seeds are left to the next run, which needs no others."""
    (tmp_path / "receipts").mkdir()
    world = World(tmp_path, lambda _, s: s != 1, random.Random(0))

    class Failing(RandomEngine):
        def next_result(self) -> UnitResult:
            unit = self.under_way.pop(0)
            return UnitResult(unit, None, "died") if 2 in unit.seeds else UnitResult(unit, self.world.do(0, unit))

    engine = Failing(world, 0, lambda: None, None)
    failures = run_all(engine, SeedScheduler({"push": 5}, 0), tmp_path, JobShard(), lambda _: None)
    assert [f.unit.seeds for f in failures] == [(2, 3)]
    assert sorted(s for _, _, s in world.tried) == [0, 1, 4, 5]
    engine = RandomEngine(world, 0, lambda: None, None)
    assert run_all(engine, SeedScheduler({"push": 5}, 0), tmp_path, JobShard(), lambda _: None) == []
    check_seeds(world, {"push": 5}, 0)


def test_a_plan_is_not_asked_again_while_enough_is_under_way(tmp_path: Path) -> None:
    """Or planning, which looks at all that is done, would take the square of the time."""
    (tmp_path / "receipts").mkdir()
    world = World(tmp_path, lambda _, s: s % 7 > 0, random.Random(0))
    asked = []

    class Plan(SeedScheduler):
        def next_units(self, *args: object) -> Iterable[WorkUnit]:
            asked.append(1)
            return super().next_units(*args)

    engine = RandomEngine(world, 0, lambda: None, None)
    assert run_all(engine, Plan({"push": 400}, 0), tmp_path, JobShard(), lambda _: None) == []
    check_seeds(world, {"push": 400}, 0)
    assert len(world.tried) > 400
    assert len(asked) < 20


def test_the_first_round_is_cut_the_same_for_every_share() -> None:
    shares = [next_units("push", 11, 3, (), 0, JobShard(k, 3)) for k in range(3)]
    assert [[u.seeds for u in units] for units in shares] == [
        [(3, 4), (9, 10)],
        [(5, 6), (11, 12)],
        [(7, 8), (13,)],
    ]
    assert shares[0][0].name == "push-000003-000004"
    assert shares[2][1].name == "push-000013"


def recordings(n: int) -> list[Recorded]:
    """Numbered through, in two tasks."""
    return [Recorded(task=TASKS[k % 2], name=f"take {k}", seed=k, source=f"/rec/{k}") for k in range(n)]


@settings(max_examples=examples(40), deadline=None)
@given(
    counts=st.lists(st.integers(0, 12), min_size=1, max_size=3),
    shares=st.integers(1, 4),
    cut_offs=st.lists(st.dictionaries(st.integers(0, 3), st.integers(0, 6), max_size=4), max_size=3),
    seed=st.integers(0, 2**31),
)
def test_any_way_to_run_does_every_recording_once(
    tmp_path_factory: pytest.TempPathFactory,
    counts: list[int],
    shares: int,
    cut_offs: list[dict[int, int]],
    seed: int,
) -> None:
    """Rejected ones too, and whatever was added later."""
    folder = tmp_path_factory.mktemp("units")
    (folder / "receipts").mkdir()
    world = World(folder, lambda t, s: random.Random(f"{t} {s} {seed}").random() < 0.5, random.Random(seed))
    for count in sorted(counts):
        plan = RecordingScheduler(recordings(count))
        for cut_off in [*cut_offs, {}]:
            for k in range(shares):
                engine = RandomEngine(world, k, lambda: None, cut_off.get(k))
                with suppress(CutOff):
                    run_all(engine, plan, folder, JobShard(k, shares), lambda _: None)
    asked = [(r.task, r.seed) for r in recordings(max(counts))]
    assert sorted((t, s) for _, t, s in world.tried) == sorted(asked), "left out, or tried again"
    assert all(share == s % shares for share, _, s in world.tried)


def test_a_recording_is_a_unit_that_says_where_it_lies() -> None:
    done = Receipt(unit="push-000000", task="push", seeds=(0,), accepted=(), frames=(), digests=())
    under_way = WorkUnit(task="roll", seeds=(1,), sources=("/rec/1",))
    units = list(RecordingScheduler(recordings(5)).next_units([done], [under_way], JobShard(0, 2)))
    assert units == [
        WorkUnit(task="push", seeds=(2,), sources=("/rec/2",), contents=("",)),
        WorkUnit(task="push", seeds=(4,), sources=("/rec/4",), contents=("",)),
    ]
    (request,) = units[0].requests
    assert (request.task, request.seed, request.source) == ("push", 2, "/rec/2")
    assert [r.source for r in WorkUnit(task="push", seeds=(2, 3)).requests] == ["", ""]


def test_progress_is_that_of_the_recordings_of_this_run() -> None:
    poor = Reject(task="roll", seed=1, stage="quality", reason="poor")
    receipts = [
        Receipt(unit="push-000000", task="push", seeds=(0,), accepted=(0,), frames=(1,), digests=("",), stats=NO_STATS),
        Receipt(unit="roll-000001", task="roll", seeds=(1,), accepted=(), frames=(), digests=(), rejects=(poor,)),
        Receipt(unit="roll-000003", task="roll", seeds=(3,), accepted=(3,), frames=(1,), digests=("",), stats=NO_STATS),
    ]
    assert RecordingScheduler(recordings(3)).progress(receipts) == ExtractionProgress(1, 3, 1)


@pytest.mark.parametrize(("episodes", "size"), [(1, 2), (10, 2), (47, 2), (48, 3), (160, 10), (256, 16), (10_000, 16)])
def test_unit_size_follows_from_the_request_alone(episodes: int, size: int) -> None:
    assert unit_size(episodes) == size


@pytest.mark.parametrize("text", ["5/3", "3/3", "-1/3", "1", "a/b", "0/0", "1/", "/3", "0.5/3", ""])
def test_a_share_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be i/n with i from 0 to n-1, as in --shard 0/4"):
        JobShard.parse(text)


def test_a_share_is_parsed() -> None:
    assert JobShard.parse("2/5") == JobShard(2, 5)
