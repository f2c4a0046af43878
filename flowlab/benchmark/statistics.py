"""What counts of successes are worth."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

from scipy.stats import binomtest

CONFIDENCE = 0.95
DIGITS = 6
"""After the point, of what is kept: more would differ between machines."""


@dataclass(frozen=True, slots=True)
class Proportion:
    """How many of how many, and between which limits the true share lies with 95 % confidence."""

    successes: int
    n: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """What was seen."""
        return self.successes / self.n


def wilson(successes: int, n: int) -> Proportion:
    """Wilson's interval. Source: scipy's ``binomtest``."""
    interval = binomtest(successes, n).proportion_ci(CONFIDENCE, method="wilson")
    return Proportion(successes, n, float(interval.low), float(interval.high))


def share_of(solved: Iterable[bool]) -> Proportion:
    """Wilson's interval of some outcomes, rounded so that it is the same on every machine."""
    values = list(solved)
    share = wilson(sum(values), len(values))
    return replace(share, low=round(share.low, DIGITS), high=round(share.high, DIGITS))


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Two policies tried on the same episodes."""

    both: int
    first_only: int
    second_only: int
    neither: int
    p_value: float
    """McNemar's, exact and two-sided: how likely episodes that only one solves are split so unevenly by chance."""

    @property
    def n(self) -> int:
        """Episodes."""
        return self.both + self.first_only + self.second_only + self.neither


def mcnemar(pairs: Iterable[tuple[bool, bool]]) -> PairedComparison:
    """Compare successes on the same episodes, pair by pair."""
    count = Counter((bool(a), bool(b)) for a, b in pairs)
    first, second = count[True, False], count[False, True]
    p = float(binomtest(first, first + second).pvalue) if first + second else 1.0
    return PairedComparison(count[True, True], first, second, count[False, False], p)


def compare_pairs(pairs: Iterable[tuple[bool, bool]]) -> PairedComparison:
    """McNemar's test, rounded so that it is the same on every machine."""
    paired = mcnemar(pairs)
    return replace(paired, p_value=round(paired.p_value, DIGITS + 4))
