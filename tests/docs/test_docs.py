"""What the documentation says is what the program does."""

import re
import shlex
from pathlib import Path

import click
import pytest
import yaml
from conftest import Cli

from flowlab.cli import cli
from flowlab.storage.card import schema_table

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "examples" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "api").glob("*.md")),
    *sorted((ROOT / "docs" / "howto").glob("*.md")),
]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


def commands() -> list[str]:
    lines = [line for page in PAGES for block in blocks(page, "bash") for line in block.splitlines()]
    return [line for line in lines if line.startswith("flowlab ")]


@pytest.mark.parametrize("line", commands())
def test_every_command_shown_exists_with_its_options(line: str) -> None:
    name, *arguments = shlex.split(line, comments=True)[1:]
    command = cli.get_command(click.Context(cli), name)
    assert command is not None, f"there is no command {name}"
    command.make_context(name, arguments)  # raises where an option or argument is wrong


def test_commands_are_found_at_all() -> None:
    assert len(commands()) > 8


def test_the_table_of_arrays_is_the_schema() -> None:
    assert schema_table() in (ROOT / "docs" / "dataset.md").read_text()


def test_the_stage_shown_works_in_the_recipe_shown(flowlab: Cli, tmp_path: Path) -> None:
    page = ROOT / "docs" / "stages.md"
    (tmp_path / "my_stages.py").write_text(next(b for b in blocks(page, "python") if "class InView" in b))
    whole, addition = blocks(page, "yaml")
    recipe = yaml.safe_load(whole)
    names = [s["stage"] for s in recipe["stages"]]
    recipe["stages"][names.index("rigid-flow") + 1 : names.index("rigid-flow") + 1] = yaml.safe_load(addition)
    recipe["stages"][-3]["min_share"] = 1.0
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(recipe))
    command = ["extract-sim", "drawer-open", "--recipe", "mine.yaml", "--episodes", 1, "--out", "data", "--dry-run"]
    result = flowlab(*command, cwd=tmp_path)
    assert "my_stages:InView (only" in result.stderr, "no episode keeps all of its points in view"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
