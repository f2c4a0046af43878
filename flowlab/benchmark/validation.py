"""Everything that would spoil the use of an experiment, found before it does."""

from collections.abc import Iterator
from pathlib import Path

from flowlab.benchmark.expert_results import EXPERT, read_expert
from flowlab.benchmark.results import UNITS, read_result
from flowlab.errors import DataError
from flowlab.evaluation.validation import validate_run
from flowlab.policies.trained import POLICY
from flowlab.storage.manifest import MANIFEST
from flowlab.storage.validation import Finding, finding_of, validate

_BESIDE = ((POLICY, validate_run), (MANIFEST, validate))
"""What an experiment keeps beside its results, by the file that tells it: runs and datasets."""


def validate_experiment(path: Path) -> Iterator[Finding]:
    """Every finding about an experiment: its results, and the runs and datasets that are still there."""
    for folder, read in ((UNITS, read_result), (EXPERT, read_expert)):
        for kept in sorted((path / folder).glob("*.json")):
            try:
                read(kept)
            except DataError as error:
                yield finding_of(kept, error)
    for name, check in _BESIDE:
        for found in sorted(path.glob(f"*/*/{name}")):
            yield from check(found.parent)
