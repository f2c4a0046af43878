"""Pictures whose files are not in the order in which they were taken, though their times rise."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from dry_runs import dry_run
from test_situations_repeats import film, write

from flowlab.recordings.picture_order import ABOUT

FRAMES = 48
IN_ORDER = list(range(FRAMES))
AT_RANDOM = np.random.default_rng(0).permutation(FRAMES).tolist()
THERE_AND_BACK = [abs((5 * k) % 78 - 39) for k in IN_ORDER]


def as_text(first: int = 0, step: int = 1) -> list[int]:
    return sorted(IN_ORDER, key=lambda k: str(first + step * k))


@pytest.mark.parametrize(
    ("color", "depth", "verdict", "says"),
    [
        (IN_ORDER, IN_ORDER, "ok", "not as numbers sorted as text"),
        (THERE_AND_BACK, THERE_AND_BACK, "ok", "not as numbers sorted"),
        (
            as_text(),
            as_text(),
            "refused",
            r"color: .* numbers as text \(0, 1, 10, 11, ...\).*depth: .*sort in the order",
        ),
        (as_text(1), as_text(1), "refused", r"numbers as text \(1, 10, 11, 12, ...\)"),
        (as_text(0, 5), as_text(0, 5), "refused", r"numbers as text \(0, 10, 100, 105, ...\)"),
        (IN_ORDER, as_text(), "refused", "^depth: the pictures seem"),
        (AT_RANDOM, AT_RANDOM, "doubtful", "the pictures seem to be in no order: the next"),
    ],
    ids=["in order", "there and back", "as text", "from 1", "by fives", "depth alone", "at random"],
)
def test_pictures_out_of_order_are_told(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, color: Sequence[int], depth: Sequence[int],
    verdict: str, says: str,
) -> None:  # fmt: skip
    pan = 0.5 if color == as_text(1) else 0.0  # a camera that moves
    frames = [(film(c, pan=pan)[0], film(d, pan=pan)[1]) for c, d in zip(color, depth, strict=True)]
    run = dry_run(capsys, write(tmp_path / "r", frames))
    found, words = run.checks[ABOUT]
    assert found == verdict, words
    assert re.search(says, words), words


def test_few_rows_do_not_tell_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = dry_run(capsys, write(tmp_path / "r", [film(t) for t in range(12)]))
    assert run.checks[ABOUT] == ("assumed", "12 rows are too few to tell it, so it is taken as it is")


FLASH = {17: 60.0}
LAMP = {t: 4.0 * np.random.default_rng(t).normal() for t in range(FRAMES)}


@pytest.mark.parametrize("light", [FLASH, LAMP], ids=["a flash", "a lamp that flickers"])
def test_light_that_changes_at_once_is_no_order(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, light: dict[int, float]
) -> None:
    """Before a scene that stands still only the light changes, and any picture may look like any other."""
    frames = []
    for t in IN_ORDER:
        rgb, depth = film(9, noise=0.0 if light is FLASH else 2.0, seed=t)
        brighter = np.clip(rgb + light.get(t, 0.0), 0, 255).astype(np.uint8)
        frames.append((brighter, depth))
    assert dry_run(capsys, write(tmp_path / "r", frames)).checks[ABOUT][0] in ("ok", "assumed")
