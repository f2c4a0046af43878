"""What tests share: one real rollout and one small dataset, each made once."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

# Tests run side by side: more threads than cores wait for each other, and take five times the CPU time. Set before any
# library that has threads is imported.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import pytest
from hypothesis import settings
from thoroughness import examples

from flowlab.engines.local import LocalEngine
from flowlab.files import locked
from flowlab.pipeline.recipe import load_recipe
from flowlab.pipeline.stage import EpisodeRequest
from flowlab.records import Episode

settings.register_profile("flowlab", max_examples=examples(100), deadline=None)
settings.load_profile("flowlab")

_LONG = ("training", "pipeline", "tracking", "cli", "examples", "deployment", "evaluation", "grading", "sim", "storage")
"""Rooms of which some file takes long: they come first, so that no worker is left alone with one at the end."""


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels of the simulator once, where several workers are about to do it at the same time."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        from flowlab.pipeline.compilation import will_compile

        if will_compile(recipe := load_recipe("metaworld")):
            recipe.pipeline().run(EpisodeRequest(task="hammer", seed=0))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.parent.name not in _LONG)


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Decoded datasets of tests lie in a cache of their own, in other processes too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLOWLAB_CACHE", str(tmp_path_factory.mktemp("cache")))
        # Workers of all commands that run in this process are forked from one that has imported what any of them needs.
        with LocalEngine(len, workers=1, imports=["flowlab.pipeline.worker", "flowlab.benchmark.experiment"]):
            pass
        yield


Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def flowlab() -> Cli:
    """Runs the command line as a user does, in a process of its own."""

    def run(*args: str | Path, timeout: float = 240, **options: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "flowlab", *map(str, args)]
        return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, **options)  # type: ignore[call-overload,no-any-return]

    return run


@pytest.fixture(scope="session")
def hammer_episode() -> Episode:
    """A real episode with its depth pictures, straight from the pipeline."""
    pipeline = load_recipe("metaworld", ["write.depth=true"]).pipeline()
    return pipeline.run(EpisodeRequest(task="hammer", seed=0))


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory, flowlab: Cli) -> Path:
    """Two tasks, three episodes each, made through the command line, once for all test processes. Copy it before
    changing it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "small"
    with locked(folder.parent):
        if not folder.exists():
            made = tmp_path_factory.mktemp("data") / "small"
            result = flowlab("extract-sim", "drawer-open", "push-back", "--episodes", 3, "--out", made, "--workers", 2)
            assert result.returncode == 0, result.stderr
            made.rename(folder)
    return folder
