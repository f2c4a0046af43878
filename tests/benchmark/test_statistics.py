"""What counts are worth, against the formulas in textbooks."""

from math import comb, isclose, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowlab.benchmark.statistics import mcnemar, wilson

Z = 1.959963984540054
"""Of a standard normal variable, 95 % lies between -Z and Z."""


@given(st.integers(1, 5000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_limits_are_wilsons(counts: tuple[int, int]) -> None:
    successes, n = counts
    p = successes / n
    center = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z / (1 + Z**2 / n) * sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    found = wilson(successes, n)
    assert (found.successes, found.n, found.share) == (successes, n, p)
    assert found.low == pytest.approx(max(center - half, 0), abs=1e-9)
    assert found.high == pytest.approx(min(center + half, 1), abs=1e-9)
    assert 0 <= found.low <= p <= found.high <= 1


def test_a_published_interval() -> None:
    """Newcombe (1998), Statistics in Medicine 17, table I, method 3: 81 of 263, 15 of 148, 0 of 20, 1 of 29."""
    for (successes, n), low, high in (
        ((81, 263), 0.2553, 0.3662),
        ((15, 148), 0.0624, 0.1605),
        ((0, 20), 0.0, 0.1611),
        ((1, 29), 0.0061, 0.1718),
    ):
        found = wilson(successes, n)
        assert (round(found.low, 4), round(found.high, 4)) == (low, high)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=200))
def test_mcnemar_is_a_fair_coins_sum(pairs: list[tuple[bool, bool]]) -> None:
    found = mcnemar(iter(pairs))
    b, c = pairs.count((True, False)), pairs.count((False, True))
    assert (found.first_only, found.second_only) == (b, c)
    assert (found.both, found.neither) == (pairs.count((True, True)), pairs.count((False, False)))
    assert found.n == len(pairs)
    tail = sum(comb(b + c, k) for k in range(min(b, c) + 1)) / 2 ** (b + c)
    assert isclose(found.p_value, min(1.0, 2 * tail), rel_tol=1e-9)


def test_which_of_the_two_comes_first_matters_to_the_counts_only() -> None:
    pairs = [(True, False)] * 7 + [(False, True)] + [(True, True)] * 5
    one, other = mcnemar(pairs), mcnemar((b, a) for a, b in pairs)
    assert (one.first_only, one.second_only) == (other.second_only, other.first_only) == (7, 1)
    assert one.p_value == other.p_value == 2 * (1 + 8) / 2**8
