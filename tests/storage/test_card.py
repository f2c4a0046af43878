"""The dataset card: it lists what is there, and is found damaged or stale, but not where only its words are old."""

import re
from pathlib import Path

import pytest
from synthetic import make_dataset, make_episode

from flowlab.storage.card import schema_table, without_mark
from flowlab.storage.dataset import Dataset, summarize
from flowlab.storage.shard import Shard
from flowlab.storage.validation import validate


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return make_dataset(tmp_path / "d", [[make_episode(1, depth=True)]]).path


def problems(data: Path) -> list[str]:
    return [f"{Path(f.place).name}: {f.problem}" for f in validate(data)]


def change(data: Path, before: str, after: str) -> None:
    card = (data / "README.md").read_text()
    assert before in card
    (data / "README.md").write_text(card.replace(before, after))


@pytest.mark.parametrize("pictures", [{}, {"depth": True}, {"depth": True, "rgb": True}, {"object_pose": False}])
def test_the_card_lists_the_arrays_that_are_there_and_no_others(pictures: dict[str, bool], tmp_path: Path) -> None:
    data = make_dataset(tmp_path / "d", [[make_episode(1, **pictures)]])
    there = {a.path for a in Shard(data.path / data.receipts[0].shard).describe()} - {"meta/episode_ends"}
    card = (data.path / "README.md").read_text()
    assert {*re.findall(r"\| `([\w/]+)` \|", card)} == there
    assert "optional" not in card
    assert "\n1 episode, 12 frames, made by flowlab" in card
    assert problems(data.path) == []


def test_a_card_of_the_flowlab_before_is_sound(data: Path) -> None:
    card = without_mark((data / "README.md").read_text()).replace("1 episode,", "1 episodes,")
    head = card.partition("| array |")[0]
    (data / "README.md").write_text(f"{head}{schema_table()}\n")
    assert problems(data) == []
    change(data, "| roll | 1 | 12 |", "| roll | 1 | 13 |")
    assert problems(data) != []


def test_a_card_in_other_words_is_sound_until_its_text_or_what_it_counts_changes(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flowlab.storage.card._CARD", "# Another {recipe}: {held}\n{tasks}\n{arrays}\n")
    summarize(data)
    monkeypatch.undo()
    assert "Another" in (data / "README.md").read_text()
    assert problems(data) == []
    change(data, "Another", "Anothor")
    (found,) = problems(data)
    assert found.startswith("README.md: does not say what the receipts say")
    change(data, "Anothor", "Another")
    change(data, "counted: ", "counted: 0" if "counted: 1" in (data / "README.md").read_text() else "counted: 1")
    assert len(problems(data)) == 1


def test_a_card_of_fewer_episodes_is_stale(data: Path, tmp_path: Path) -> None:
    more = make_dataset(tmp_path / "e", [[make_episode(1, depth=True)], [make_episode(2, depth=True)]]).path
    (more / "README.md").write_text((data / "README.md").read_text())
    (found,) = problems(more)
    assert "does not say what the receipts say" in found
    assert Dataset(more).arrays == Dataset(data).arrays
