"""What counts of successes are worth."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from scipy.stats import binomtest

CONFIDENCE = 0.95


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
