"""Episodes have numbers that no demonstration has, and are the same for every policy."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowlab.errors import UsageError
from flowlab.evaluation.trials import (
    MOST_SEEDS,
    SCENES_PER_SEED,
    Trial,
    check_unseen,
    list_trials,
)

TRIALS = st.builds(
    Trial, st.just("hammer"), st.integers(0, MOST_SEEDS - 1), st.integers(0, SCENES_PER_SEED - 1)
)  # fmt: skip


@given(TRIALS, TRIALS)
def test_scenes_never_collide(a: Trial, b: Trial) -> None:
    """Not with each other, nor with demonstrations, which are numbered from 0; MetaWorld takes 32 bits."""
    assert (a.scene_seed == b.scene_seed) == (a == b)
    assert 1_000_000 <= a.scene_seed < 2**32


def test_numbers_that_are_promised() -> None:
    """Results that are published name them."""
    assert [Trial("push", s, e).scene_seed for s, e in ((0, 0), (0, 7), (2, 19))] == [1_000_000, 1_000_007, 3_000_019]


def test_every_policy_gets_the_same_trials_in_the_same_order() -> None:
    found = list_trials(["push", "hammer"], [2, 0, 2], 2)
    assert found == [Trial(task, seed, k) for task in ("push", "hammer") for seed in (2, 0) for k in (0, 1)]
    assert list_trials(["push"], [0], 5)[:3] == list_trials(["push"], [0], 3)


@pytest.mark.parametrize(
    ("seeds", "episodes", "sentence"),
    [
        ([0, -1], 1, "seed -1: evaluation seeds are from 0 to 3999"),
        ([4000], 1, "seed 4000: evaluation seeds are from 0 to 3999"),
        ([0], 0, "0 episodes: a seed has from 1 to 1,000,000"),
        ([0], 1_000_001, "1000001 episodes: a seed has from 1 to 1,000,000"),
    ],
)
def test_numbers_that_do_not_exist(seeds: list[int], episodes: int, sentence: str) -> None:
    with pytest.raises(UsageError) as raised:
        list_trials(["push"], seeds, episodes)
    assert str(raised.value) == sentence


def test_scenes_that_were_demonstrated_are_refused() -> None:
    wanted = list_trials(["hammer", "push"], [0, 1], 3)
    seen = {"hammer": (0, 1, 2, 1_000_003, 2_000_003), "push": (2_000_001,), "roll": (1_000_000,)}
    with pytest.raises(UsageError) as raised:
        check_unseen(wanted, seen, Path("runs/a"))
    assert str(raised.value) == (
        "runs/a: its dataset holds the scene 2000001 of push, which evaluation seed 1 would try; demonstrations "
        "belong below 1,000,000: make them with another first_seed, or evaluate other --seeds"
    )
    check_unseen([t for t in wanted if t.scene_seed != 2_000_001], seen, Path("runs/a"))
    check_unseen(wanted, {}, Path("runs/a"))
