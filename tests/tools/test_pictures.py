"""Every picture of the documentation is made by a target, from what is there today, and is shown somewhere."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "tools" / "pictures"


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The program, as a module."""
    monkeypatch.syspath_prepend(str(PICTURES))
    spec = importlib.util.spec_from_file_location("pictures_program", PICTURES / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "pictures_program", module)
    spec.loader.exec_module(module)
    return module


def test_every_picture_has_a_maker_and_is_shown(pictures: ModuleType) -> None:
    there = {path.name for path in (ROOT / "docs" / "images").iterdir()}
    assert there == {*pictures.MAKERS}
    texts = [path.read_text() for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]]
    shown = {name for text in texts for name in re.findall(r"!\[[^\]]*\]\((?:docs/)?images/([\w.-]+)\)", text)}
    assert shown == there
    assert "$(BIN)/python tools/pictures" in (ROOT / "Makefile").read_text()


def test_the_architecture_is_that_of_today(pictures: ModuleType, tmp_path: Path) -> None:
    pictures.draw_architecture(tmp_path / "a.svg", tmp_path)
    drawn = (tmp_path / "a.svg").read_text()
    assert drawn == (ROOT / "docs" / "images" / "architecture.svg").read_text()
    rooms = [room for text in re.findall(r'class="room">([^<]+)<', drawn) for room in text.split(", ")]
    assert rooms
    missing = [r for r in rooms if not any((ROOT / "flowlab" / f"{r}{end}").exists() for end in ("", ".py"))]
    assert missing == []


def test_a_picture_that_is_not_known_is_told(
    pictures: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pictures", "hamer"])
    with pytest.raises(SystemExit):
        pictures.main()
    assert "no picture is called hamer; there are: architecture, hammer" in capsys.readouterr().err
