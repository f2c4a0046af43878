"""What was looked at in a recording, and what came of it: said in the dry run, stored with the episode."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from flowlab.errors import DataError

CHECKS = "checks"
"""Where an episode's extras have them."""


class Verdict(StrEnum):
    """What came of looking at something, the best first."""

    OK = "ok"
    """It is stated, and the evidence agrees; or it was looked at, and nothing is wrong."""
    ASSUMED = "assumed"
    """Nothing states it, and what is customary was taken."""
    DOUBTFUL = "doubtful"
    """Something speaks against it, too little to refuse the recording."""
    REFUSED = "refused"
    """It cannot be as it is said, or is not known and must be: the recording is not used."""

    @property
    def severity(self) -> int:
        """From 0 on, the more the worse."""
        return list(Verdict).index(self)


@dataclass(frozen=True, slots=True)
class Check:
    """What came of looking at one thing."""

    about: str
    """What was looked at, in a word or two: ``clock``, ``depth unit``."""
    verdict: Verdict
    says: str
    """What was found, and by what evidence; of what is refused also what to write, and where."""

    def to_json(self) -> dict[str, str]:
        """JSON values."""
        return {"about": self.about, "verdict": self.verdict.value, "says": self.says}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Check":
        """The inverse of :meth:`to_json`."""
        return cls(str(values["about"]), Verdict(values["verdict"]), str(values["says"]))


def stored_checks(extras: Mapping[str, Any]) -> tuple[Check, ...] | None:
    """The checks that an episode was stored with.

    Args:
        extras: Of the episode.

    Returns:
        The checks in the order in which they were made; None where there are none, as in episodes of simulation and
        of an earlier flowlab: these were not checked, which is not the same as ``ok``.
    """
    try:
        return tuple(map(Check.from_json, extras[CHECKS]))
    except (KeyError, TypeError, ValueError):
        return None


def worst_first(checks: Iterable[Check]) -> list[Check]:
    """The checks, those with the worst verdicts first."""
    return sorted(checks, key=lambda check: -check.verdict.severity)


def raise_refused(path: object, checks: Iterable[Check]) -> None:
    """Raise :class:`DataError` with everything that is refused, if anything is."""
    refused = [f"{f.about}: {f.says}" for f in checks if f.verdict is Verdict.REFUSED]
    if refused:
        raise DataError(f"{path}: {'; '.join(refused)}")
