"""What is fuzzed: samples of every kind of file that somebody else may have made, and what flowlab does with each."""

import io
import json
import random
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.campaigns.mutations import mutate, mutate_file, nasty_text

TESTS = Path(__file__).parents[1]
OLD = TESTS / "fixtures/old"
sys.path[1:1] = [str(TESTS / name) for name in ("", "recordings", "storage", "policies")]

Change = Callable[[Path, random.Random], None]


@dataclass(frozen=True)
class Kind:
    """A kind of input."""

    name: str
    make: Callable[[Path], None]
    """Fills a folder with a sample that is right."""
    run: Callable[[Path, random.Random], None]
    """What flowlab does with it, and everything that the commands do with the result."""
    of: str = "**/*"
    """Which of the files are made wrong."""
    share: int = 1
    """How often, beside the others."""
    sealed: bool = False
    """Whether half of the inputs get right checksums again, so that what is behind them is reached."""
    names_code: bool = False
    """Whether such a file may name a module that lies beside it, as SECURITY.md says of recipes."""


def change(folder: Path, of: str, rng: random.Random) -> None:
    """Make one or two of the files wrong."""
    files = sorted(f for f in folder.glob(of) if f.is_file() and not f.is_symlink() and f.stat().st_mode & 0o400)
    for file in rng.sample(files, min(len(files), rng.choice((1, 1, 1, 2)))):
        mutate_file(file, rng)


def seal(folder: Path) -> None:
    """Have every checksum of a dataset or a run be right, as somebody would who makes a wrong one."""
    from flowlab.benchmark.episode_columns import columns_path
    from flowlab.checksums import CHECKSUM, json_checksum, sha256_of

    shards = {p.name.removesuffix(".zarr.zip"): p for p in folder.rglob("*.zarr.zip") if p.is_file()}
    for file in (p for p in folder.rglob("*.json*") if p.is_file()):
        with suppress(Exception):  # what is no JSON any more has no checksum
            lines = file.read_text().split("\n") if file.suffix == ".jsonl" else [file.read_text()]
            sealed = []
            for line in lines:
                values = json.loads(line) if line else None
                if isinstance(values, dict) and CHECKSUM in values:
                    if file.parent.name == "receipts" and file.stem in shards and values.get("shard_sha256"):
                        values["shard_sha256"] = sha256_of(shards[file.stem])
                    if "episodes_sha256" in values and (columns := columns_path(file)).is_file():
                        values["episodes_sha256"] = sha256_of(columns)
                    line = json.dumps(values | {CHECKSUM: json_checksum(values)})
                sealed.append(line)
            file.write_text("\n".join(sealed))
    for file in (p for p in folder.rglob("*.safetensors") if p.is_file()):
        with suppress(Exception):
            _seal_tensors(file)


def _seal_tensors(file: Path) -> None:
    import safetensors
    from safetensors.torch import load_file

    from flowlab.policies.tensor_files import write_tensors
    from flowlab.policies.trained import POLICY, RUN, identity_in

    with safetensors.safe_open(file, "pt") as opened:
        about = json.loads(opened.metadata()["flowlab"])
    tensors = load_file(file)
    run = file.parent if (file.parent / POLICY).exists() else file.parents[1]
    for name, other in (("policy", POLICY), ("run", RUN)):
        if name in about:
            about[name] = identity_in(run / other)
    write_tensors(file, tensors, {k: v for k, v in about.items() if k not in ("tensors", "sha256")})


def command(*arguments: Any) -> None:
    """The command line, whose errors are let through; no worker is started."""
    import click

    from flowlab.cli import cli

    with suppress(click.ClickException, click.exceptions.Exit):
        cli.main([str(a) for a in arguments], prog_name="flowlab", standalone_mode=False)


# Recordings


def _open(folder: Path, **settings: Any) -> None:
    from flowlab.errors import FlowlabError
    from flowlab.recordings.recording import RecordingSettings, describe, find_recordings, open_recording

    every = RecordingSettings(max_bad_share=1.0, max_width=16, **settings)
    for path in find_recordings([folder / "r"]):
        with suppress(FlowlabError):
            describe(path, every)
        recording = open_recording(path, every, task="pour", seed=0)
        for t in range(len(recording)):
            recording.frame(t)
        json.dumps(recording.extras)
        repr(recording)


def _recording(folder: Path, rng: random.Random) -> None:
    _open(folder)


def _plain(folder: Path) -> None:
    from real_recordings import INTRINSICS, write_folder

    write_folder(
        folder / "r/a", steps=3, state="state.npy", action="action.csv", action_times="t.txt", task="pour",
        T_world_cam=np.eye(4).tolist(), intrinsics={**INTRINSICS, "distortion": [0.1, 0, 0, 0, 0]},
    )  # fmt: skip
    np.save(folder / "r/a/state.npy", np.arange(21.0).reshape(3, 7))
    (folder / "r/a/action.csv").write_text("x,y\n" + "".join(f"{k}.5,{k}\n" for k in range(3)))
    (folder / "r/a/t.txt").write_text("0.0\n0.1\n0.2\n")


def _plain_arrays(folder: Path) -> None:
    """Depth as arrays, times in files, depth of a camera of its own, calibration as Open3D writes it."""
    from real_recordings import INTRINSICS, counts, write_folder

    path = write_folder(folder / "r/a", steps=3, fps=None, intrinsics=None, times="t.npy", depth_times="d.txt",
                        depth_intrinsics=INTRINSICS, T_color_depth=np.eye(4).tolist())  # fmt: skip
    for t in range(3):
        (path / f"depth/{t:04d}.png").unlink()
    np.save(path / "depth/0000.npy", counts(3)[0])
    np.savez_compressed(path / "depth/0001.npz", depth=counts(3)[1])
    np.save(path / "depth/0002.npy", counts(3)[2].astype(np.float32))
    np.save(path / "t.npy", np.arange(3) / 10)
    (path / "d.txt").write_text("0.0\n0.1\n0.2\n")
    about = {"width": 32, "height": 24, "intrinsic_matrix": [30.0, 0, 0, 0, 31.0, 0, 15.2, 11.7, 1],
             "depth_scale": 1000.0,
             "fps": 10.0, "stream_length_usec": 300_000}  # fmt: skip
    (path / "intrinsic.json").write_text(json.dumps(about))


def _jpeg(folder: Path) -> None:
    from real_recordings import colors

    _plain(folder)
    for t in range(3):
        (folder / f"r/a/color/{t:04d}.png").unlink()
        options = [cv2.IMWRITE_JPEG_PROGRESSIVE, t % 2]
        (folder / f"r/a/color/{t:04d}.jpg").write_bytes(cv2.imencode(".jpg", colors(3)[t], options)[1].tobytes())


def _tum(folder: Path) -> None:
    from real_recordings import INTRINSICS, write_yaml
    from test_tum_reader import write_sequence

    for name, lists in (("a", True), ("b", False)):
        path = write_sequence(folder / "r" / name, lists=lists)
        write_yaml(path / "recording.yaml", intrinsics=INTRINSICS)


def _npz(folder: Path) -> None:
    from test_arrays_reader import write_npz

    (folder / "r").mkdir(parents=True)
    write_npz(folder / "r/a.npz")
    _arrays_yaml(folder / "r/a.yaml")


def _npy(folder: Path) -> None:
    from test_arrays_reader import write_npy

    (folder / "r").mkdir(parents=True)
    write_npy(folder / "r/a")
    _arrays_yaml(folder / "r/a/recording.yaml")


def _arrays_yaml(path: Path) -> None:
    from real_recordings import INTRINSICS, write_yaml

    write_yaml(path, fps=10, depth_unit_m=0.001, intrinsics=INTRINSICS)


def _rh20t(folder: Path) -> None:
    from test_rh20t_reader import GRIPPER, MS, TCP, write_calibration, write_camera, write_rows

    episode = folder / "r/train/ep_1"
    camera = write_camera(episode)
    write_rows(camera / "tcp", TCP, late_ms=4)
    write_rows(camera / "gripper_command", GRIPPER)
    write_calibration(folder / "r")
    (episode / "timestamp.txt").write_text("1649\n")
    (episode / "metadata.json").write_text(json.dumps({"finish_time": int(MS[-1]), "rating": 3, "calib": 1649}))


def _pickle(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    values = {"1": np.eye(4), 2: [np.arange(16.0)], "3": np.asfortranarray(np.arange(12, dtype=">f4").reshape(3, 4)),
              "4": np.float64(3), "5": [[1, 2], [3, 4.5]]}  # fmt: skip
    for protocol in range(2, 6):
        import pickle

        file = io.BytesIO()
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})  # type: ignore[arg-type]
        pickle.dump(np.array(values, object), file, protocol)
        (folder / f"{protocol}.npy").write_bytes(file.getvalue())


def _read_pickles(folder: Path, rng: random.Random) -> None:
    """Two hundred of them at a time, for they are quick."""
    from flowlab.errors import FlowlabError
    from flowlab.recordings.readers.safe_pickle import pickled_numbers

    path = folder / "case.npy"
    samples = [f.read_bytes() for f in sorted(folder.glob("[2-5].npy")) if f.is_file()]
    for _ in range(200):
        path.write_bytes(mutate(rng.choice(samples), "x.npy", rng))
        with suppress(FlowlabError):
            pickled_numbers(path, rng.choice("12345"))


def _ros(kind: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        from test_ros_reader import say_robot_and_camera, write_kind

        (folder / "r").mkdir(parents=True)
        write_kind(folder / "r", kind, say_robot_and_camera)

    return make


def _calibration(folder: Path) -> None:
    _plain(folder)
    shutil.copy(folder / "r/a/recording.yaml", folder / "c.yaml")


def _with_calibration(folder: Path, rng: random.Random) -> None:
    _open(folder, calibration=folder / "c.yaml")


# Other files


def _truth(folder: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {"query_px": rng.uniform(0, 8, (5, 2)).astype(np.float32),
              "tracks_cam": rng.normal(size=(4, 5, 3)).astype(np.float32), "visible": np.ones((4, 5), bool),
              "role": np.array([0, 1, 2, -1, 3], np.int8)}  # fmt: skip
    folder.mkdir(parents=True)
    np.savez_compressed(folder / "ground_truth.npz", **arrays)
    (folder / "simulated.json").write_text('{"unusable_queries": 3, "task": "push"}')


def _read_truth(folder: Path, rng: random.Random) -> None:
    from flowlab.grading.ground_truth import find_with_truth, read, unusable_queries

    for found in find_with_truth(folder):
        unusable_queries(found)
        read(found)


def _trials(folder: Path) -> None:
    folder.mkdir(parents=True)
    rows = [f"{p},{t},{k},{(k + len(p)) % 2},fine" for p in ("dp3", "fdp") for t in ("pour", "push") for k in range(4)]
    (folder / "a.csv").write_text("policy,task,trial,success,note\n" + "\n".join(rows) + "\n")
    (folder / "b.csv").write_text("policy,task,trial,success\nmba,pour,1,yes\n")


def _report_trials(folder: Path, rng: random.Random) -> None:
    from flowlab.benchmark.robot_trials import comparisons, read_robot_trials, successes

    trials = [trial for file in sorted(folder.glob("*.csv")) for trial in read_robot_trials(file)]
    repr((successes(trials), comparisons(trials)))


def _dp3(folder: Path) -> None:
    from test_dp3_importer import make_arrays, write_v2

    write_v2(folder / "s.zarr", make_arrays((4, 3), points=4))


def _read_dp3(folder: Path, rng: random.Random) -> None:
    from flowlab.storage.importers.dp3 import DP3Store

    store = DP3Store(folder / "s.zarr")
    repr((store.fingerprint, store.frames))
    for episode in store.episodes():
        repr(episode)


def _weights(folder: Path) -> None:
    import torch

    folder.mkdir(parents=True)
    torch.save({"model": {"a.weight": torch.zeros(2, 3), "b": torch.ones(4, dtype=torch.float16)}}, folder / "w.pt")


def _read_weights(folder: Path, rng: random.Random) -> None:
    """Whatever it raises becomes a sentence where the network is loaded; nothing may crash, hang or run."""
    from torch import nn

    from flowlab.tracking.trackers.weights import read_weights

    with suppress(Exception):
        nn.Linear(3, 2).load_state_dict(read_weights(folder / "w.pt"))


# Settings


def _recipes(folder: Path) -> None:
    folder.mkdir(parents=True)
    for file in sorted((TESTS.parent / "pipelines").glob("*.yaml")):
        shutil.copy(file, folder)


def _load_recipes(folder: Path, rng: random.Random) -> None:
    from flowlab.pipeline.recipe import load_recipe

    for file in _yaml_files(folder):
        recipe = load_recipe(str(file))
        recipe.settings()
        if rng.random() < 0.05:  # which opens the simulator
            recipe.pipeline().provenance("push")


def _yaml_files(folder: Path) -> Iterator[Path]:
    yield from sorted(folder.glob("*.yaml"))


def _profiles(folder: Path) -> None:
    folder.mkdir(parents=True)
    for file in [*(TESTS.parent / "pipelines/train").glob("*.yaml"), *(TESTS / "profiles").glob("*.yaml")]:
        shutil.copy(file, folder)


def _load_profiles(folder: Path, rng: random.Random) -> None:
    from flowlab.policies.profiles import load_settings

    for file in _yaml_files(folder):
        load_settings(str(file), rng.choice(("dp3", "fdp", "mba")))


def _experiments(folder: Path) -> None:
    folder.mkdir(parents=True)
    for file in (TESTS.parent / "pipelines/bench").glob("*.yaml"):
        shutil.copy(file, folder)


def _plan_experiments(folder: Path, rng: random.Random) -> None:
    from flowlab.benchmark.recipe import load_experiment
    from flowlab.benchmark.units import plan_cost, plan_units

    for file in _yaml_files(folder):
        recipe = load_experiment(str(file))
        plan_cost(recipe, len(plan_units(recipe)))


def _nothing(folder: Path) -> None:
    folder.mkdir(parents=True)


def _set(folder: Path, rng: random.Random) -> None:
    """A setting string, for a recipe, a profile, a tracker or an exporter."""
    from flowlab.grading.run import make_graded_tracker
    from flowlab.pipeline.recipe import load_recipe
    from flowlab.policies.profiles import load_settings

    text = _setting(rng)
    how = rng.randrange(4)
    if how == 0:
        load_recipe(rng.choice(("metaworld", "real")), [text])
    elif how == 1:
        load_settings("fast", rng.choice(("fdp", "dp3", "mba")), [text])
    elif how == 2:
        make_graded_tracker("lucas-kanade", ["lucas-kanade"], [text], None)
    else:
        load_recipe(rng.choice(("metaworld", "real")), [text, _setting(rng)])


_KEYS = (
    "observer.points", "observer.crop", "queries.points", "queries.sampling", "expert.scene.camera", "expert.noise",
    "write.depth", "track.tracker", "track.options", "track.chunks", "recording.reader", "recording.max_width", "lift",
    "batch.windows", "encoder.points", "encoder.widths", "action", "motion.denoiser", "run.steps", "run.minutes",
    "diffusion.train_steps", "data.held_out", "horizon", "name", "stages", "first_seed", "stages.0", "window", "levels",
)  # fmt: skip


def _setting(rng: random.Random) -> str:
    key = rng.choice(_KEYS) if rng.random() < 0.9 else nasty_text(rng)
    if rng.random() < 0.2:
        key += f".{nasty_text(rng)}"
    text = f"{key}={nasty_text(rng)}" if rng.random() < 0.95 else key
    return (
        mutate(text.encode("utf-8", "surrogatepass"), "x", rng).decode("utf-8", "surrogateescape")
        if rng.random() < 0.3
        else text
    )


def _names(folder: Path, rng: random.Random) -> None:
    """Names of tasks, trackers, recipes, policies, exporters, readers, and arguments of commands."""
    from flowlab.registry import REGISTRIES
    from flowlab.sim.tasks import tasks_named

    name, how = nasty_text(rng), rng.randrange(4)
    if how == 0:
        tasks_named([name])
    elif how == 1:
        rng.choice(REGISTRIES).load(name)
    elif how == 2:
        command(rng.choice(("info", "validate", "report")), rng.choice((name, folder / name.replace("\0", ""))))
    else:
        command("extract-sim", name, "--out", folder / "d", "--dry-run", "--episodes", rng.choice((1, name)))


# Datasets, runs


def _dataset(which: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        shutil.copytree(OLD / which, folder / "d")

    return make


def _new_dataset(folder: Path) -> None:
    from synthetic import make_dataset, make_episode, with_quality

    small = {"steps": 4, "points": 8, "queries": 4}
    first = [make_episode(k, depth=True, rgb=True, **small) for k in range(2)]
    make_dataset(folder / "d", [first, [with_quality(make_episode(0, task="push", depth=True, rgb=True, **small))]])


def _use_dataset(folder: Path, rng: random.Random) -> None:
    how = rng.randrange(8)
    if how < 3:
        command("info", folder / "d", *(["--json"] if how else []))
    elif how < 5:
        command("validate", folder / "d")
    elif how == 5:
        command("export", folder / "d", "--to", "dp3", "--out", folder / "out.zarr")
    else:
        _windows(folder)


def _windows(folder: Path) -> None:
    from flowlab.data.windows import Windows
    from flowlab.storage.dataset import open_dataset

    data = open_dataset(folder / "d")
    repr(data.episode(0))
    windows = Windows(data, {"state": [-1, 0], "point_cloud": [0], "action": range(3)}, cache=folder / "cache")
    repr((windows[0], windows[len(windows) - 1], windows.stats))


def _run(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        shutil.copytree(OLD / "runs" / name, folder / "run")
        shutil.copytree(OLD / "dataset-sim", folder / "d")
        about = json.loads((folder / "run/run.json").read_text())
        (folder / "run/run.json").write_text(json.dumps({**about, "dataset": "case/d"}))

    return make


def _use_run(folder: Path, rng: random.Random) -> None:
    from test_old_runs import frame_of, state_of

    from flowlab.deployment.robot_policy import Policy

    how = rng.randrange(6)
    if how == 0:
        command("report", folder / "run", "--out", folder / "report")
    elif how == 1:
        command("validate", folder / "run")
    elif how == 2:
        command("train", "--resume", folder / "run")
    else:
        policy = Policy.load(folder / "run")
        policy.act(frame_of(0), state_of(0))


def _experiment(folder: Path) -> None:
    from policy_results import EXAMPLE

    from flowlab.benchmark.results import unit_path, write_result

    for k, result in enumerate(EXAMPLE):
        write_result(unit_path(folder / "e", f"unit-{k}"), result)


def _use_experiment(folder: Path, rng: random.Random) -> None:
    from flowlab.benchmark.results import read_results
    from flowlab.benchmark.summary import summarize

    summarize(read_results([folder / "e"]))
    if rng.random() < 0.02:
        command("report", folder / "e", "--out", folder / "report")


KINDS = {
    kind.name: kind
    for kind in (
        Kind("plain", _plain, _recording, share=2),
        Kind("plain-arrays", _plain_arrays, _recording, share=2),
        Kind("jpeg", _jpeg, _recording, "r/a/color/*"),
        Kind("tum", _tum, _recording),
        Kind("npz", _npz, _recording, share=2),
        Kind("npy", _npy, _recording),
        Kind("rh20t", _rh20t, _recording, share=2),
        Kind("pickle", _pickle, _read_pickles, "nothing", share=4),
        Kind("ros-bag", _ros("bag"), _recording),
        Kind("ros-mcap", _ros("mcap"), _recording),
        Kind("ros-db3", _ros("db3"), _recording),
        Kind("calibration", _calibration, _with_calibration, "c.yaml", share=2),
        Kind("truth", _truth, _read_truth, share=2),
        Kind("trials", _trials, _report_trials),
        Kind("dp3", _dp3, _read_dp3, share=2),
        Kind("weights", _weights, _read_weights),
        Kind("recipe", _recipes, _load_recipes, names_code=True),
        Kind("profile", _profiles, _load_profiles),
        Kind("experiment", _experiments, _plan_experiments),
        Kind("set", _nothing, _set, "nothing", share=4),
        Kind("names", _nothing, _names, "nothing"),
        Kind("dataset-new", _new_dataset, _use_dataset, share=2, sealed=True),
        Kind("dataset-sim", _dataset("dataset-sim"), _use_dataset, sealed=True),
        Kind("dataset-real", _dataset("dataset-real"), _use_dataset, sealed=True),
        Kind("run-fdp", _run("fdp"), _use_run, "run/**/*", sealed=True),
        Kind("run-dp3", _run("dp3"), _use_run, "run/**/*", sealed=True),
        Kind("run-interrupted", _run("fdp-interrupted"), _use_run, "run/**/*", sealed=True),
        Kind("results", _experiment, _use_experiment, sealed=True),
    )
}
