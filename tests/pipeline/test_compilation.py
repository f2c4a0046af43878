"""Who labels for the first time on a machine is told that it compiles; nobody else is."""

import os
from pathlib import Path

import numba
import numpy as np
import pytest
from conftest import Cli
from synthetic_clip import record

from flowlab.pipeline import compilation
from flowlab.pipeline.compilation import NOTICE, will_compile
from flowlab.pipeline.labeling import labeling_recipe
from flowlab.tracking.trackers import rigid_bodies

SETTINGS = ("observer.points=64", "queries.points=8", "quality.min_sure_share=0", "quality.max_median_sigma_m=9")
SMALL = ("--tracker", "lucas-kanade", *(word for change in SETTINGS for word in ("--set", change)))


def test_a_kernel_is_compiled_once_until_its_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "kernels_of_a_test.py"
    source.write_text("import numba\n\n\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(tmp_path)
    import kernels_of_a_test  # type: ignore[import-not-found]

    twice = kernels_of_a_test.twice
    assert isinstance(twice, numba.core.registry.CPUDispatcher)
    assert not compilation._is_cached(twice)
    assert twice(3) == 6
    assert compilation._is_cached(twice)
    later = source.stat().st_mtime + 10
    os.utime(source, (later, later))
    assert not compilation._is_cached(twice)
    assert compilation._is_cached(np.sin), "what is not compiled needs no wait"


@pytest.mark.parametrize("tracker", ["rigid-bodies", "lucas-kanade"])
def test_the_kernels_that_are_asked_for_are_there(tracker: str) -> None:
    kernels = list(compilation._kernels(labeling_recipe("real", tracker=tracker)))
    assert all(isinstance(kernel, numba.core.registry.CPUDispatcher) for kernel in kernels)
    asked = {Path(kernel.py_func.__code__.co_filename) for kernel in kernels}
    compiled = {f for f in Path(rigid_bodies.__file__).parent.glob("_*.py") if "@numba.njit" in f.read_text("utf-8")}
    # One is within others, the other is called where things may slip.
    not_always = {f for f in compiled if f.stem in ("_readings", "_slipping")}
    assert asked & compiled == (compiled - not_always if tracker == "rigid-bodies" else set())
    assert len(asked - compiled) == 3


@pytest.mark.slow
def test_only_the_first_labeling_says_that_it_compiles(tmp_path: Path, flowlab: Cli) -> None:
    recording, cache = record(tmp_path / "slide" / "1", 4), {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for k, expected in enumerate((1, 0)):
        result = flowlab("track-real", recording, "--out", tmp_path / f"d{k}", "--workers", 1, *SMALL, env=cache)
        assert (result.returncode, result.stderr.count(NOTICE)) == (0, expected), result.stderr
    assert isinstance(will_compile(labeling_recipe("real")), bool)
