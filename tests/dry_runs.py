"""What ``track-real --dry-run`` says of a recording, for tests."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from synthetic import call_cli


@dataclass(frozen=True)
class DryRun:
    """What came of looking at one recording."""

    code: int
    facts: dict[str, Any]
    """What is said in JSON; empty where there is none."""
    err: str

    @property
    def checks(self) -> dict[str, tuple[str, str]]:
        """Verdict and words, by what was looked at."""
        return {c["about"]: (c["verdict"], c["says"]) for c in self.facts.get("checks", [])}

    @property
    def problem(self) -> str:
        """Why it cannot be labeled; ``None`` where it can."""
        return str(self.facts.get("problem", self.err))


def dry_run(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> DryRun:
    """Look at a recording, through the command line."""
    code, out, err = call_cli(capsys, "track-real", path, "--dry-run", "--json", "--tracker", "lucas-kanade", *more)
    assert "Traceback" not in err
    return DryRun(code, json.loads(out)["recordings"][0] if out.startswith("{") else {}, err)
