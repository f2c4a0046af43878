"""A Ray cluster of two machines, one of which is killed: ``make ray``, for Ray is large and cannot start everywhere."""

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Cli

from flowlab.engines.ray_cluster import _run_unit, _Setting
from flowlab.errors import DataError, FlowlabError
from flowlab.storage.dataset import open_dataset
from flowlab.storage.validation import validate
from flowlab.version import __version__

RAY = importlib.util.find_spec("ray") is not None
needs_ray = pytest.mark.skipif(
    not RAY or os.environ.get("FLOWLAB_RAY") != "1", reason="make ray installs what this needs"
)
MACHINE: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 80_000_000}


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two machines of one core each, both this one."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    two = Cluster(initialize_head=True, head_node_args={**MACHINE, "include_dashboard": False})
    two.add_node(**MACHINE)
    monkeypatch.setenv("RAY_ADDRESS", two.address)
    yield two
    two.shutdown()


def extraction(out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "flowlab", "extract-sim", "reach", "push", *options, "--out", str(out)]


def shards(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted((folder / "shards").rglob("*")) if p.is_file()}


@needs_ray
def test_a_cluster_makes_the_bytes_that_this_machine_makes(cluster: Any, tmp_path: Path) -> None:
    for engine in "ray", "local":
        done = subprocess.run(
            extraction(tmp_path / engine, "--episodes", "4", "--engine", engine, "--json"),
            cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        json.loads(done.stdout)
    assert shards(tmp_path / "ray") == shards(tmp_path / "local") != {}


@needs_ray
def test_a_cluster_grades_as_this_machine_does(cluster: Any, tmp_path: Path) -> None:
    found = []
    for engine in "ray", "local":
        asked = ["--scenes", "thin,plain", "--size", "96x72", "--tracker", "lucas-kanade", "--engine", engine, "--json"]
        done = subprocess.run(
            [sys.executable, "-m", "flowlab", "grade", *asked, "--out", str(tmp_path / engine)],
            cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        found.append([(r["recording"], r["metrics"]) for r in json.loads(done.stdout)["trackers"][0]["recordings"]])
    assert found[0] == found[1]
    assert [name for name, _ in found[0]] == ["thin-0", "plain-0"]


@needs_ray
def test_a_machine_that_is_killed_costs_no_episode(cluster: Any, tmp_path: Path) -> None:
    out = tmp_path / "data"
    with subprocess.Popen(extraction(out, "--episodes", "40", "--engine", "ray"), cwd=tmp_path) as running:
        deadline = time.monotonic() + 120
        while len(list(out.glob("receipts/*.json"))) < 4 and time.monotonic() < deadline:
            time.sleep(0.2)
        other = next(node for node in cluster.list_all_nodes() if node is not cluster.head_node)
        cluster.remove_node(other, allow_graceful=False)
        assert len(list(out.glob("receipts/*.json"))) < 20
        assert running.wait(300) == 0
    assert len(open_dataset(out)) == 80
    assert not list(validate(out))


@needs_ray
def test_without_a_cluster_it_is_told_how_to_start_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    done = subprocess.run(
        extraction(tmp_path / "data", "--episodes", "1", "--engine", "ray"), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "--engine ray finds no Ray cluster" in done.stderr
    assert "ray start --head" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "data").exists()


@pytest.mark.skipif(RAY, reason="Ray is installed")
def test_without_the_library_it_is_told_how_to_install_it(flowlab: Cli, tmp_path: Path) -> None:
    done = flowlab("extract-sim", "reach", "--engine", "ray", "--out", tmp_path / "data")
    assert done.returncode == 1
    assert "pip install 'flowlab[ray]'" in done.stderr


def place(folder: Path, version: str = __version__) -> _Setting:
    return _Setting(version, folder, ("json",))


def test_a_worker_works_in_the_folder_of_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    assert _run_unit(place(tmp_path), lambda unit: f"{unit} in {Path.cwd()}", "a").receipt == f"a in {tmp_path}"


def test_a_machine_that_is_set_up_otherwise_ends_the_run(tmp_path: Path) -> None:
    other = _run_unit(place(tmp_path, "0.0.0"), str, "a").fatal
    assert isinstance(other, FlowlabError)
    assert f"has flowlab {__version__}, expected 0.0.0" in str(other)
    apart = _run_unit(place(tmp_path / "elsewhere"), str, "a").fatal
    assert isinstance(apart, FlowlabError)
    assert f"has no folder {tmp_path / 'elsewhere'}" in str(apart)


def test_what_a_unit_cannot_help_ends_the_run_and_what_it_can_its_own(tmp_path: Path) -> None:
    def wrong_data(unit: str) -> None:
        raise DataError(f"{unit}: not as it should be")

    def wrong(unit: str) -> None:
        raise ValueError(f"{unit}: the tide is too high")

    assert isinstance(_run_unit(place(tmp_path), wrong_data, "a").fatal, DataError)
    failed = _run_unit(place(tmp_path), wrong, "a")
    assert failed.fatal is None
    assert "the tide is too high" in failed.failure
