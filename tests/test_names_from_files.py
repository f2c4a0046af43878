"""A file that names ``module:Class`` has nothing imported but what the user has put on ``PYTHONPATH`` or named."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from synthetic import call_cli
from trained_runs import SMALL, make_rolls, make_run

from flowlab.checksums import with_checksum
from flowlab.errors import DataError, UsageError
from flowlab.policies.trained import FREE, read_trained
from flowlab.registry import REGISTRIES, Registry, names_from_file

Capture = pytest.CaptureFixture[str]
MODULE = "a_module_for_tests"
SOURCE = """
from pathlib import Path
Path(__file__).with_name("ran").write_text("")
from flowlab.policies.dp3 import DP3
class Mine(DP3):
    pass
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder whose modules can be imported, as those of installed packages can."""
    folder = tmp_path / "installed"
    folder.mkdir()
    (folder / f"{MODULE}.py").write_text(SOURCE)
    (folder / "a_package").mkdir()
    (folder / "a_package/__init__.py").write_text(SOURCE)
    (folder / "a_package/inner.py").write_text(SOURCE)
    (folder / "a_namespace").mkdir()
    (folder / "a_namespace/inner.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    yield folder
    for name in [n for n in sys.modules if n.partition(".")[0] in (MODULE, "a_package", "a_namespace")]:
        del sys.modules[name]


PLACES = (f"{MODULE}:Mine", "a_package:Mine", "a_package.inner:Mine", "a_namespace.inner:Mine")
HOSTILE = (*PLACES, "antigravity:x", "this:x", "idlelib.idle:main", "json.tool:main", "__hello__:main", "turtledemo:x")


@pytest.mark.parametrize("registry", REGISTRIES, ids=lambda r: r.family)
def test_nothing_that_is_installed_is_imported_for_a_file(registry: Registry[object], installed: Path) -> None:
    for place in HOSTILE:
        with pytest.raises(UsageError) as refused, names_from_file():
            registry.load(place)
        assert f"{registry.kind} '{place}': is named by a file, which may be a stranger's" in str(refused.value)
        assert "put the folder of its module on PYTHONPATH" in str(refused.value)
        assert place.partition(":")[0] not in sys.modules
    assert not [*installed.rglob("ran")]


@pytest.mark.parametrize("place", PLACES)
def test_what_the_user_put_on_pythonpath_is(place: str, installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(installed))
    (registry,) = (r for r in REGISTRIES if r.family == "policies")
    with names_from_file():
        assert registry.load(place).__name__ == "Mine"


def test_installed_packages_are_none_of_the_users_though_they_are_on_pythonpath(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As some clusters and robots have it."""
    folder = installed.rename(installed.with_name("site-packages"))
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", f"{folder}:{Path(json.__file__).parents[1]}:")
    (registry,) = (r for r in REGISTRIES if r.family == "policies")
    for place in HOSTILE:
        with pytest.raises(UsageError, match="named by a file"), names_from_file():
            registry.load(place)


def test_what_the_user_names_is_and_from_then_on_files_may_name_it(installed: Path) -> None:
    (registry,) = (r for r in REGISTRIES if r.family == "policies")
    with names_from_file(but=[PLACES[0]]):
        assert registry.load(PLACES[0]).__name__ == "Mine"
    with names_from_file():
        assert registry.load(PLACES[0]).__name__ == "Mine"
        with pytest.raises(UsageError, match="is not a subclass of"):
            registry.load("os:PathLike")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("named")
    return make_run(make_rolls(place / "d"), "--policy", "dp3", "--out", place / "run", *SMALL, "--set", "run.steps=1")


def test_a_strangers_run_imports_nothing(run: Path, installed: Path, tmp_path: Path, capsys: Capture) -> None:
    """Not for its policy, nor for its logs."""
    about, plan = (json.loads((run / name).read_text()) for name in ("policy.json", "run.json"))
    for values in (about, plan):
        values.pop("sha256")
    (tmp_path / "run").mkdir()
    plan["logs"] = [PLACES[0]]
    for policy in (PLACES[0], "dp3"):
        about["policy"]["settings"]["policy"] = policy
        (tmp_path / "run/policy.json").write_text(json.dumps(with_checksum(about)))
        (tmp_path / "run/run.json").write_text(json.dumps(with_checksum(plan, FREE)))
        for command in (
            ("train", tmp_path / "run", "--resume"),
            ("eval", tmp_path / "run"),
            ("validate", tmp_path / "run"),
        ):
            if policy == "dp3" and command[0] != "train":
                continue
            code, out, err = call_cli(capsys, *command)
            assert code in (2, 3)
            assert f"'{PLACES[0]}': is named by a file, which may be a stranger's" in out + err
            assert err.count("\n") == 1
    assert not [*installed.rglob("ran")]
    about["policy"]["settings"]["policy"] = "x" * 5000 + ":y"
    (tmp_path / "run/policy.json").write_text(json.dumps(with_checksum(about)))
    with pytest.raises(DataError):
        read_trained(tmp_path / "run")


def test_a_recipe_imports_nothing_that_is_installed(installed: Path, tmp_path: Path, capsys: Capture) -> None:
    """Of experiments and of datasets: for a stage, or for the tracker that a stage names."""
    recipes = {
        "stage": {"name": "x", "episodes": 1, "stages": [{"stage": PLACES[0]}]},
        "tracker": {"name": "x", "episodes": 1, "stages": [{"stage": "track", "tracker": PLACES[0]}]},
    }
    for name, recipe in recipes.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(recipe))
        command = ("extract-sim", "push", "--recipe", f"{tmp_path / name}.yaml", "--out", tmp_path / "d")
        code, _, err = call_cli(capsys, *command)
        assert code == 2, err
        assert f"'{PLACES[0]}': is named by a file" in err
    experiment = yaml.safe_load((Path(__file__).parents[1] / "pipelines/bench/paper.yaml").read_text())
    for change in (
        {"policies": [PLACES[0]]},
        {"variants": [{"name": "v", "tasks": ["push"], "set": [], "policy": PLACES[0]}]},
    ):
        (tmp_path / "e.yaml").write_text(yaml.safe_dump({**experiment, **change}))
        code, _, err = call_cli(capsys, "bench", "--recipe", tmp_path / "e.yaml", "--out", tmp_path / "e", "--dry-run")
        assert code == 2
        assert f"'{PLACES[0]}': is named by a file" in err
    assert not [*installed.rglob("ran")]
