"""What the documentation names is there: files, modules, and what is in them."""

import re
from importlib import import_module

import pytest
from test_docs import PAGES, ROOT

PATH = re.compile(r"`((?:flowlab|pipelines|tests|examples|tools|benchmarks|docs)/[\w./-]+)`")
NAME = re.compile(r"(?<![\w/-])(flowlab(?:\.\w+)+)")
NOT_MODULES = {"flowlab.json"}
ENTRY_POINTS = re.compile(r"flowlab\.(trackers|readers|stages|policies|exporters|engines|loggers)$")


def found(pattern: re.Pattern[str]) -> list[tuple[str, str]]:
    """Page and name, each once."""
    return sorted({(page.name, name) for page in PAGES for name in pattern.findall(page.read_text())})


def is_there(name: str) -> bool:
    """Whether a dotted name can be imported, or is an attribute or field of what can."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            thing = import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            fields = {**getattr(thing, "__dataclass_fields__", {}), **getattr(thing, "model_fields", {})}
            if not hasattr(thing, part) and part not in fields:
                return False
            thing = getattr(thing, part, None)
        return True
    return False


@pytest.mark.parametrize(("page", "path"), found(PATH))
def test_every_path_exists(page: str, path: str) -> None:
    assert (ROOT / path).exists(), f"{page} names {path}"


@pytest.mark.parametrize(("page", "name"), found(NAME))
def test_every_name_exists(page: str, name: str) -> None:
    if name not in NOT_MODULES and not ENTRY_POINTS.match(name):
        assert is_there(name), f"{page} names {name}"


def test_names_and_paths_are_found_at_all() -> None:
    assert len(found(PATH)) > 50
    assert len(found(NAME)) > 50


def test_a_name_that_is_not_there_is_noticed() -> None:
    assert is_there("flowlab.records.Episode.flow")
    assert not is_there("flowlab.records.Episode.flaw")
    assert not is_there("flowlab.recrods")


def test_every_example_is_listed_and_shown() -> None:
    listed, shown = (ROOT / "examples" / "README.md").read_text(), (ROOT / "docs" / "examples.md").read_text()
    for example in (ROOT / "examples").glob("[0-9]*"):
        assert f"({example.name}" in listed
        assert f"examples/{example.name}" in shown


def test_what_the_pages_show_of_examples_is_there() -> None:
    for target in re.findall(r'--8<-- "([^"]+)"', (ROOT / "docs" / "examples.md").read_text()):
        assert (ROOT / target).is_file(), target
