"""The pages of every command and every setting are what the code says."""

import importlib
import re
import sys

import pytest
from test_docs import ROOT

sys.path.insert(0, str(ROOT / "tools" / "reference"))
WRITERS = {"commands.md": "commands_page", "settings.md": "settings_page"}


@pytest.mark.parametrize("page", WRITERS)
def test_the_page_is_what_the_code_says(page: str) -> None:
    write = getattr(importlib.import_module(WRITERS[page]), WRITERS[page])
    assert (ROOT / "docs" / page).read_text() == write(), f"docs/{page} is not up to date; run make reference"


def test_tables_of_settings_are_what_is_stacked_on_phones() -> None:
    (around,) = re.findall(
        r'<div class="(\w+)" markdown>\n\n.*\n</div>\n', (ROOT / "docs/settings.md").read_text(), re.DOTALL
    )
    on_phones = (ROOT / "docs/style.css").read_text().partition("@media screen and (max-width:")[2]
    assert f".md-typeset .{around} :is(tbody, tr, td) {{ display: block; }}" in on_phones


@pytest.mark.parametrize("page", WRITERS)
def test_everything_is_explained(page: str) -> None:
    unexplained = re.findall(r"^\| (`[^|]+) .*\|  \|$", (ROOT / "docs" / page).read_text(), re.MULTILINE)
    assert not unexplained, "write a docstring below the field, or the option's help, and run make reference"


def test_settings_are_found_at_every_depth() -> None:
    page = (ROOT / "docs" / "settings.md").read_text()
    assert "| `motion.denoiser.widths` | list of whole number > 0, ≤ 100000 | `[128, 128, 128]` |" in page
    assert "| `expert.scene.renderer` | `zbuffer` or `gl` | `zbuffer` |" in page
    assert "| `track.options.window` | whole number ≥ 3 | `21` |" in page
