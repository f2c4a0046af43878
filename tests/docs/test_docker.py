"""What the Dockerfiles name is there; they are not built by the tests, which need no Docker."""

import re
import tomllib
from pathlib import Path

import pytest
from test_docs import ROOT

INSTRUCTIONS = {"FROM", "ARG", "ENV", "RUN", "WORKDIR", "COPY", "ENTRYPOINT", "CMD"}


@pytest.mark.parametrize("file", sorted((ROOT / "docker").glob("Dockerfile.*")), ids=lambda f: f.name)
def test_a_dockerfile_names_what_is_there(file: Path) -> None:
    text = re.sub(r"^#.*\n", "", file.read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    lines = [line.split() for line in text.splitlines() if line.strip()]
    assert {words[0] for words in lines} <= INSTRUCTIONS
    copied = [source for words in lines if words[0] == "COPY" for source in words[1:-1]]
    assert {"flowlab", "pipelines", "pyproject.toml"} <= set(copied)
    assert all((ROOT / source).exists() for source in copied)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (asked,) = re.findall(r'"\.\[([\w,]+)\]"', text)
    assert set(asked.split(",")) <= set(extras)


def test_the_install_page_names_every_extra() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    page = (ROOT / "docs" / "install.md").read_text()
    assert set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == set(extras)
