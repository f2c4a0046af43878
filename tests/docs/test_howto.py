"""The how-to pages are short, lead on to the whole, and their commands do what they say: as shown, only smaller."""

import re
import shlex
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from hdf5_files import POSE, filmed
from synthetic import call_cli, make_dataset, make_episode
from test_docs import ROOT, blocks
from trained_runs import SMALL, make_rolls

PAGES = sorted((ROOT / "docs" / "howto").glob("*.md"))
Capture = pytest.CaptureFixture[str]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_a_page_is_short_and_leads_on(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= 60
    assert text.startswith("# ")
    assert "\n## What can go wrong\n" in text
    assert re.search(r"\nAll .*\]\(\.\./[\w-]+\.md[#)]", text), "the page that has all of it"
    assert f"howto/{page.name}" in (ROOT / "mkdocs.yml").read_text()


def run(capsys: Capture, page: str, smaller: dict[str, str], leave_out: str = r"(?!)") -> list[str]:
    """The commands of a page, one after the other in the current folder; what each printed."""
    (place,) = [p for p in PAGES if p.stem == page]
    lines = [line for block in blocks(place, "bash") for line in block.splitlines() if line.startswith("flowlab ")]
    said = []
    for line in lines:
        if re.search(leave_out, line):
            continue
        short = line
        for shown, less in smaller.items():
            short = short.replace(shown, less)
        code, out, err = call_cli(capsys, *shlex.split(short, comments=True)[1:])
        assert code == 0, (short, err)
        said.append(out + err)
    return said


def log(path: Path) -> None:
    """A log in the layout that the page's map tells of, in a program's own words."""
    path.parent.mkdir(parents=True)
    with h5py.File(path, "w") as file:
        for k in range(2):
            seen, demo = filmed(k), file.create_group(f"demo_{k}")
            demo["front/rgb"], demo["front/depth"] = seen.rgb, seen.mm
            demo["robot/joints"], demo["robot/command"] = seen.state, seen.action


@pytest.mark.slow
def test_logs_of_a_robot(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    log(tmp_path / "logs/pour.hdf5")
    code, out, err = call_cli(capsys, "track-real", "logs", "--dry-run")
    assert (code, "of a layout that is not known, with demo_0/front/depth uint16" in out) == (3, True), err
    (shown,) = blocks(ROOT / "docs/howto/hdf5-logs.md", "yaml")
    said = yaml.safe_load(shown) | {"T_world_cam": POSE.tolist()}
    (tmp_path / "logs/pour.yaml").write_text(yaml.safe_dump(said))
    small = ("observer.points=256", "queries.points=40", "quality.min_sure_share=0", "quality.max_median_sigma_m=9")
    less = " ".join(("--workers 1 --tracker lucas-kanade", *(f"--set {change}" for change in small)))
    *_, labeled, sound = run(capsys, "hdf5-logs", {"--workers 4": less})
    assert "2 episodes" in labeled
    assert sound == "data/pour: sound\n"


@pytest.mark.slow
def test_several_datasets(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for day, first in (("monday", 0), ("tuesday", 50)):
        make_dataset(tmp_path / "data" / day, [[make_episode(first + k, steps=20) for k in range(3)]])
    less = {"--minutes 60": " ".join(SMALL)}
    *_, about, _, sound = run(capsys, "several-datasets", less, leave_out="--out runs/both$")
    assert "data/tuesday" in about
    assert "weight 0.3" in about
    assert sound == "data/both: sound\n"


def test_many_machines(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    less = {"--group hard --episodes 1000": "reach --episodes 3 --workers 1", "/shared/hard": str(tmp_path / "shared")}
    _, first, second, sound, about = run(capsys, "many-machines", less, leave_out="--engine ray")
    assert "the rest belongs to the other shards" in first
    assert "3 episodes" in second + about
    assert sound.endswith("sound\n")


def test_what_would_be_shared_is_listed(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_rolls(tmp_path / "data/pour")
    (listed,) = run(capsys, "share-on-the-hub", {}, leave_out=r"^(?!.*--dry-run)")
    assert "shards/" in listed
    assert "cc-by-4.0" in listed


@pytest.mark.slow
def test_films_without_actions(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = ["extract-sim", "push", "--workers", "1", "--episodes"]
    films = ["--set", "first_seed=100", "--without", "actions,state", "--out", "data/films"]
    assert call_cli(capsys, *made, "3", "--out", "data/pour")[0] == 0
    assert call_cli(capsys, *made, "1", *films)[0] == 0
    less = {"--policy fdp": " ".join(("--policy fdp", *SMALL))}
    _, about, *_, compared = run(capsys, "films-without-actions", less, leave_out="track-real")
    assert "inferred" in about
    assert "runs/pour-few" in compared


@pytest.mark.slow
def test_a_tracker_of_ones_own(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "examples")
    less = {"tabletop,hands --episodes 6": "thin --size 96x72", ",rigid-bodies": ",lucas-kanade"}
    (graded,) = run(capsys, "own-tracker", less, leave_out="track-real")
    assert "patches" in graded
    assert np.asarray((tmp_path / "graded/grade.png").stat().st_size) > 0
