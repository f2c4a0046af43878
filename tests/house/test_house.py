"""The house stays in order: short files and functions, one meaning for a name, everything said, one spelling."""

from pathlib import Path

import pytest
from house import House, british, percentile

HOUSE = House()


def shown(found: list[str]) -> str:
    return "\n".join(found)


def test_there_is_something_to_count() -> None:
    assert len(HOUSE.sources) > 150
    assert len(HOUSE.functions) > 1000
    assert "Policy" in HOUSE.exported()


def test_files_are_short() -> None:
    longest = sorted(HOUSE.sources, key=lambda s: -s.lines)[: len(HOUSE.sources) // 10]
    assert percentile([s.lines for s in HOUSE.sources], 0.9) <= 225, shown([f"{s.where()} {s.lines}" for s in longest])


def test_no_file_is_long() -> None:
    long = [f"{s.where()} has {s.lines} lines" for s in HOUSE.sources if s.lines > 350]
    assert not long, shown(long)


def test_functions_are_short() -> None:
    longest = sorted(HOUSE.functions, key=lambda f: -f.lines)[:40]
    lines = [f.lines for f in HOUSE.functions]
    assert percentile(lines, 0.9) <= 20, shown([f"{f.where} {f.name} {f.lines}" for f in longest])


def test_no_module_needs_itself_to_be_imported() -> None:
    assert not HOUSE.circles(), shown(HOUSE.circles())


def test_a_public_class_name_stands_for_one_class() -> None:
    assert not HOUSE.twice(), shown(HOUSE.twice())


def test_everything_public_has_a_docstring() -> None:
    assert not HOUSE.undocumented(), shown(HOUSE.undocumented())


def test_every_function_says_what_it_returns() -> None:
    assert not HOUSE.unannotated(), shown(HOUSE.unannotated())


def test_what_is_exported_says_what_it_takes_gives_and_raises() -> None:
    assert not HOUSE.untold(), shown(HOUSE.untold())


def test_spelling_is_american() -> None:
    found = british()
    assert not found, shown(found)


DISORDER = {
    "flowlab/__init__.py": '"""The house."""\n\n_LAZY = {"work": "flowlab.a"}\n',
    "flowlab/a.py": '"""A."""\n\nfrom flowlab import b\n\n\nclass Twin:\n    """One."""\n\n\n'
    'def work(x: int) -> int:\n    """Does."""\n    if x:\n        raise ValueError("x")\n    return x\n',
    "flowlab/b.py": "from flowlab.c import work\n\n\n"
    "class Twin:\n    def silent(self):\n        def inner() -> None: ...\n",
    "flowlab/c.py": '"""C."""\n\nfrom typing import TYPE_CHECKING\n\nfrom flowlab.a import work\n\n'
    "if TYPE_CHECKING:\n    from flowlab.d import nothing\n",
    "flowlab/d.py": '"""D."""\n\nfrom flowlab import c\n\n\n'
    'def nothing() -> None:\n    """Colours, `neighbours` and "optimiser"."""\n',
}


@pytest.fixture
def disorder(tmp_path: Path) -> House:
    """A house with one fault of each kind."""
    for name, text in DISORDER.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return House(tmp_path)


def test_each_fault_is_found_where_it_is(disorder: House) -> None:
    assert disorder.circles() == ["flowlab.a -> flowlab.b -> flowlab.c -> flowlab.a"], "d is only for type checkers"
    assert disorder.twice() == ["Twin: flowlab/a.py:6, flowlab/b.py:4"]
    bare = ["flowlab/b.py:1", "flowlab/b.py:4 class Twin", "flowlab/b.py:5 Twin.silent"]
    assert disorder.undocumented() == bare, "nested functions need no docstring"
    assert disorder.unannotated() == ["flowlab/b.py:5 Twin.silent"]
    assert disorder.untold() == [f"flowlab/a.py:10 work has no {s}" for s in ("Args:", "Returns:", "Raises:")]
    assert british(disorder.root) == ["flowlab/d.py:7 Colours"], "quoted words are names"


def test_the_percentile_is_one_of_the_numbers() -> None:
    assert percentile(range(1, 11), 0.9) == 9
    assert percentile([5], 0.5) == 5
