"""What other packages offer, through the command line: listed, used, and left out where it is broken."""

import json
from pathlib import Path

import pytest
import synthetic_clip
from conftest import Cli
from plugin_packages import environment, install
from real_recordings import write_folder
from synthetic import make_dataset, make_episode

from flowlab.storage.dataset import open_dataset

TRACKER = """
from flowlab.tracking.trackers.lucas_kanade import LucasKanade

class Followed(LucasKanade):
    name = "followed"
    license = "nobody's"
"""
READER = """
from dataclasses import replace
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.readers.plain import PlainReader

class BoxReader(PlainReader):
    name = "box"
    expects = "a folder called *.box"
    fallback = False

    def probe(self, path):
        return path.suffix == ".box" and path.is_dir()
"""
EXPORTER = """
from flowlab.storage.exporters.base import Exporter, select_episodes

class Counts(Exporter):
    name = "counts"
    writes = "a line for every episode"
    prefix: str = ""

    def export(self, dataset, path, task=None):
        chosen = select_episodes(dataset, path, task)
        path.write_text("".join(f"{self.prefix}{ref.task} {ref.frames}\\n" for ref in chosen))
        return len(chosen)
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Where packages with a tracker, a reader and an exporter are installed, and one that is broken."""
    folder = install(tmp_path / "site", "follow", TRACKER, trackers="followed = follow:Followed")
    install(folder, "boxes", READER, readers="box = boxes:BoxReader")
    install(folder, "counting", EXPORTER, exporters="counts = counting:Counts")
    broken = "raise RuntimeError('no such\\nthing')"
    return install(folder, "shards", broken, readers="shard = shards:Reader", trackers="shard = shards:Tracker")


def test_everything_installed_is_listed_with_its_package(site: Path, flowlab: Cli) -> None:
    result = flowlab("plugins", env=environment(site))
    assert result.returncode == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    assert ["followed", "follow:Followed", "(follow", "1.2)"] in lines
    assert ["counts", "counting:Counts", "(counting", "1.2)"] in lines
    assert any(line[:2] == ["plain", "flowlab.recordings.readers.plain:PlainReader"] for line in lines)
    assert [line[0] for line in lines if line[0].endswith(":") and len(line) == 1] == [
        "trackers:", "readers:", "stages:", "policies:", "exporters:", "engines:", "loggers:",
    ]  # fmt: skip
    assert result.stdout.splitlines()[-2:] == [
        f"{kind} 'shard' of shards 1.2: cannot be imported (no such)" for kind in ("tracker", "reader")
    ]


def test_one_family_is_listed_as_json(site: Path, flowlab: Cli) -> None:
    rows = json.loads(flowlab("plugins", "readers", "--json", env=environment(site)).stdout)
    assert {row["family"] for row in rows} == {"readers"}
    by_name = {row["name"]: row for row in rows}
    assert by_name["box"] == {
        "family": "readers", "name": "box", "place": "boxes:BoxReader", "package": "boxes 1.2", "problem": "",
    }  # fmt: skip
    assert "cannot be imported" in by_name["shard"]["problem"]
    assert by_name["tum"]["package"].startswith("flowlab ")


def test_a_family_that_does_not_exist(flowlab: Cli) -> None:
    result = flowlab("plugins", "tracker")
    assert result.returncode == 2
    assert result.stderr == "flowlab: no family of plug-ins is called 'tracker'; did you mean trackers?\n"


def test_a_broken_reader_of_others_is_left_out_and_named(site: Path, tmp_path: Path, flowlab: Cli) -> None:
    write_folder(tmp_path / "rec")
    result = flowlab("track-real", tmp_path / "rec", "--dry-run", env=environment(site))
    assert "read as a plain recording" in result.stdout
    said = "flowlab: reader 'shard' of shards 1.2: cannot be imported (no such); it is left out\n"
    assert said in result.stderr
    assert "Traceback" not in result.stderr


def test_a_broken_reader_that_is_asked_for_is_refused(site: Path, tmp_path: Path, flowlab: Cli) -> None:
    write_folder(tmp_path / "rec")
    result = flowlab("track-real", tmp_path / "rec", "--dry-run", "--reader", "shard", env=environment(site))
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1].startswith("flowlab: reader 'shard' of shards 1.2: cannot be imported")


@pytest.mark.parametrize("reader", ["box", "boxes:BoxReader"])
def test_a_reader_of_others_is_asked_for(reader: str, site: Path, tmp_path: Path, flowlab: Cli) -> None:
    write_folder(tmp_path / "rec.box")
    result = flowlab("track-real", tmp_path / "rec.box", "--dry-run", "--reader", reader, env=environment(site))
    assert "read as a box recording" in result.stdout, result.stderr


def test_recordings_in_a_layout_of_others_are_labeled_by_a_tracker_of_others(
    site: Path, tmp_path: Path, flowlab: Cli
) -> None:
    synthetic_clip.record(tmp_path / "rec.box", frames=8)
    options = ("--tracker", "followed", "--set", "track.options.window=15", "--set", "queries.points=20")
    out = tmp_path / "data"
    result = flowlab(
        "track-real", tmp_path / "rec.box", "--out", out, *options, "--workers", 1, "--json",
        env=environment(site),
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    extras = open_dataset(out)[0].extras
    assert extras["reader"] == "box"
    assert '"tracker": "followed"' in json.dumps(extras)
    assert '"window": 15' in json.dumps(extras)


def test_an_exporter_of_others_is_found_and_takes_options(site: Path, tmp_path: Path, flowlab: Cli) -> None:
    make_dataset(tmp_path / "d", [[make_episode(0), make_episode(1, steps=7)]])
    arguments = ("export", tmp_path / "d", "--to", "counts", "--out", tmp_path / "n.txt")
    result = flowlab(*arguments, "--set", "prefix=run-", env=environment(site))
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "n.txt").read_text().splitlines()[1] == "run-roll 7"
    result = flowlab(*arguments, "--set", "prefx=1", env=environment(site))
    assert result.returncode == 2
    assert "no setting is called 'prefx'; did you mean prefix?" in result.stderr


def test_a_tool_that_no_exporter_knows(tmp_path: Path, flowlab: Cli) -> None:
    make_dataset(tmp_path / "d", [[make_episode(0)]])
    result = flowlab("export", tmp_path / "d", "--to", "dp4", "--out", tmp_path / "s")
    assert result.returncode == 2
    assert result.stderr == "flowlab: no exporter is called 'dp4'; did you mean dp3?\n"
