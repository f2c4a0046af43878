"""Errors without a simulator: figures one can work out by hand, on the right demonstrations and no others."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from builders import tiny_settings, tiny_spec
from synthetic import CAMERA, SETTINGS, call_cli, make_dataset, make_episode, make_provenance, with_tracks
from trained_runs import SMALL, lines_of, make_rolls, make_run, options

from flowlab.data.batches import Batch, ObservationBatch
from flowlab.errors import DataError
from flowlab.evaluation.flow_metrics import FlowErrors
from flowlab.evaluation.offline import OfflineReport, evaluate_offline
from flowlab.evaluation.sampled_flow import DRAWS
from flowlab.geometry.camera import Camera
from flowlab.policies.base import ActionPlan, PolicyNetwork
from flowlab.policies.checkpoint import LoadedPolicy, load_policy
from flowlab.policies.fdp import FDP
from flowlab.policies.trained import TrainedPolicy
from flowlab.records import Episode
from flowlab.report.tables import demonstration_table, offline_table
from flowlab.storage.dataset import Dataset

Capture = pytest.CaptureFixture[str]
AHEAD, EXECUTED = 7, 4
"""Steps that are predicted from now on, and how many of them are executed."""
NEAR = Camera(CAMERA.width, CAMERA.height, CAMERA.K * [[3], [3], [1]], CAMERA.T_world_cam)


class Drawer(FDP):
    """Predicts the flow of :func:`gliding`, off by (1 + (draw + row) % 10) mm more at every step, across the way."""

    def plan(self, context: ObservationBatch, generators: Any = None) -> ActionPlan:
        windows, s = len(context.observed), self.spec.settings
        row = context.state[context.observed[:, -1], 0].round().long()
        draw = torch.arange(windows) // (windows if isinstance(context, Batch) else windows // DRAWS)
        flow = torch.zeros(windows, s.horizon, s.motion.points, 3)
        flow[..., 0] = 0.01 * (context.queries[:, None, :, 0] > 0)
        flow[..., 1] = 0.001 * (1 + (draw + row) % 10)[:, None, None]
        return ActionPlan(torch.zeros(windows, s.horizon, self.spec.action_width), flow)


def gliding(seed: int, steps: int, camera: Camera) -> Episode:
    """Points right of the middle go on by 1 cm a step, the others lie still; the state begins with the row."""
    episode = make_episode(seed, steps=steps, queries=6)
    start = np.array([[-0.3 + 0.12 * m, 0.3 + 0.05 * m, 0.1 * m] for m in range(6)])
    t = np.arange(steps)[:, None, None]
    tracks = start + 0.01 * t * np.array([1.0, 0, 0]) * (start[:, :1] > 0)
    state = episode.state.copy()
    state[:, 0] = np.arange(steps)
    episode = with_tracks(replace(episode, state=state, camera=camera), tracks.astype(np.float32))
    seen = (np.arange(steps)[:, None] + np.arange(6)) % (3 + 2 * seed) != 0
    return replace(episode, tracks=replace(episode.tracks, visible=seen))


def untrained(folder: Path, network: type[PolicyNetwork], settings: Any, **changes: Any) -> LoadedPolicy:
    torch.manual_seed(0)
    spec = tiny_spec(settings, **{"tasks": ("roll",), "observer": SETTINGS["observer"]} | changes)
    trained = TrainedPolicy(policy=spec, dataset="elsewhere", fingerprint="another", versions={})
    return LoadedPolicy(network(spec), trained, 7, folder / "checkpoints" / "step-00000007.safetensors")


def by_hand(episode: Episode) -> dict[str, float]:
    """What :class:`FlowErrors` holds of the flow that :class:`Drawer` foresees. The best draw is 1 mm off a step."""
    off, far, last, z, seen = [], [], [], [], []
    xyz, camera = episode.tracks.xyz_world, episode.camera
    for now in range(len(episode) - EXECUTED + 1):
        for m in (k for k in range(6) if xyz[0, k, 0] > 0):
            n = min(AHEAD, len(episode) - 1 - now)
            for j in range(1, n + 1):
                off.append([0.001 * j * (1 + (draw + now) % 10) for draw in range(10)])
                far.append(0.01 * j)
                last.append(j == n)
                z.append(1 - xyz[now + j, m, 2])
                seen.append(episode.tracks.visible[now + j, m])
    error, ends, s = np.array(off), np.array(last), np.array(seen)
    focal = np.sqrt(camera.K[0, 0] * camera.K[1, 1]) * 256 / 12
    within = [(error < p * np.array(z)[:, None] / focal)[s] for p in (1, 2, 4, 8, 16)]
    return {
        "pairs": len(off),
        "ends": ends.sum(),
        "seen": s.sum(),
        "ade_mm": 1e3 * error.mean(),
        "fde_mm": 1e3 * error[ends].mean(),
        "zero_ade_mm": 1e3 * np.mean(far),
        "zero_fde_mm": 1e3 * np.array(far)[ends].mean(),
        "best_ade_mm": 1e3 * error.min(1).mean(),
        "best_fde_mm": 1e3 * error[ends].min(1).mean(),
        "apd": np.mean([w.mean() for w in within]),
        "average_jaccard": np.mean([w.sum(0) / (len(w) + (~w).sum(0)) for w in within]),
    }


def shown(flow: FlowErrors | None) -> dict[str, float]:
    assert flow is not None
    of_policy = flow.policy.model_dump()
    counts = {name: getattr(flow, name) for name in ("pairs", "ends", "seen", "best_ade_mm", "best_fde_mm")}
    return {**of_policy, **counts, "zero_ade_mm": flow.zero.ade_mm, "zero_fde_mm": flow.zero.fde_mm}


@pytest.mark.parametrize("own_camera", [False, True])
def test_predicted_flow_is_off_by_what_one_works_out_by_hand(tmp_path: Path, own_camera: bool) -> None:
    """Of a recording, the camera is its own. The first is planned in two portions, of 64 windows at most."""
    cameras = [NEAR if own_camera else CAMERA, CAMERA]
    demos = [gliding(k, steps, camera) for k, (steps, camera) in enumerate(zip((80, 14), cameras, strict=True))]
    changes = {"provenance": make_provenance(camera={})} if own_camera else {}
    make_dataset(tmp_path / "d", [[d] for d in demos], **changes)
    settings = tiny_settings("fdp", "encoder.points=24")
    report = evaluate_offline(untrained(tmp_path, Drawer, settings), tmp_path / "d")
    wanted = [by_hand(d) for d in demos]
    for found, one in zip(report.demonstrations, wanted, strict=True):
        assert shown(found.flow) == pytest.approx(one, rel=1e-4)
    assert [(m.task, m.seed, m.windows) for m in report.demonstrations] == [("roll", 0, 77), ("roll", 1, 11)]
    weight = {"fde_mm": "ends", "zero_fde_mm": "ends", "best_fde_mm": "ends", "apd": "seen", "average_jaccard": "seen"}
    together = {
        name: sum(w[name] for w in wanted)
        if name in ("pairs", "ends", "seen")
        else np.average([w[name] for w in wanted], weights=[w[weight.get(name, "pairs")] for w in wanted])
        for name in wanted[0]
    }
    assert shown(report.all.flow) == pytest.approx(together, rel=1e-4)
    assert report.all.flow is not None
    assert report.all.flow.draws == 10
    # At the first frame nothing is known of the velocity; later on these points keep theirs.
    assert report.all.flow.constant is not None
    first = 3 * 10 * sum(range(1, AHEAD + 1)) * 2
    assert report.all.flow.constant.ade_mm == pytest.approx(first / together["pairs"], rel=1e-3)
    assert report.all.errors.flow_moving_mm is not None
    assert report.all.windows == 88


def test_where_nothing_moves_there_is_no_such_figure(tmp_path: Path) -> None:
    still = gliding(0, 20, CAMERA)
    still = with_tracks(still, np.repeat(still.tracks.xyz_world[:1], 20, 0))
    make_dataset(tmp_path / "d", [[still], [gliding(1, 14, CAMERA)]])
    report = evaluate_offline(untrained(tmp_path, Drawer, tiny_settings("fdp")), tmp_path / "d")
    first, second = report.demonstrations
    assert first.flow is None
    assert first.errors.flow_moving_mm is None
    assert report.all.flow == second.flow


def test_draws_of_a_real_policy_differ_and_the_best_is_better(tmp_path: Path) -> None:
    make_dataset(tmp_path / "d", [[gliding(0, 20, CAMERA)]])
    loaded = untrained(tmp_path, FDP, tiny_settings("fdp"))
    report = evaluate_offline(loaded, tmp_path / "d")
    assert report.all.flow is not None
    assert report.all.flow.best_ade_mm < 0.95 * report.all.flow.policy.ade_mm
    assert evaluate_offline(loaded, tmp_path / "d") == report, "the noise is the same each time"
    one_frame = untrained(tmp_path, FDP, tiny_settings("fdp", "n_obs_steps=1"))
    found = evaluate_offline(one_frame, tmp_path / "d").all
    assert found.flow is not None
    assert found.flow.constant is None
    assert found.errors.action_l1_hold is None


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("data") / "rolls", 6)


@pytest.fixture(scope="module", params=["fdp", "dp3", "mba"])
def run(request: pytest.FixtureRequest, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained on demonstrations 0 to 3 of six."""
    out = tmp_path_factory.mktemp("run") / request.param
    return make_run(data, "--policy", request.param, "--out", out, *SMALL, *options("data.held_out=2"))


def seeds(report: OfflineReport) -> list[int]:
    return [m.seed for m in report.demonstrations]


def test_the_errors_of_a_run_are_those_that_training_found_last(run: Path) -> None:
    report = evaluate_offline(load_policy(run))
    assert seeds(report) == [4, 5]
    last = lines_of(run, "validation")[-1]
    wanted = {k: v for k, v in last.items() if k not in ("kind", "step", "cpu_s", "wall_s")}
    assert report.all.errors.model_dump(exclude_none=True) == pytest.approx(wanted, rel=1e-3)
    assert (report.step, report.policy) == (last["step"], run.name)
    assert (report.all.flow is not None) == (run.name == "fdp")
    each = [m.errors.action_l1_zero for m in report.demonstrations]
    assert np.mean(each) == pytest.approx(last["action_l1_zero"], rel=1e-4), "they are equally long"
    assert each[0] != each[1]
    json.dumps(report.model_dump(mode="json"), allow_nan=False)


def test_a_dataset_that_was_moved_is_still_the_runs_own(run: Path, data: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(data, tmp_path / "moved")
    found = evaluate_offline(load_policy(run), moved)
    assert found.model_dump(exclude={"dataset"}) == evaluate_offline(load_policy(run)).model_dump(exclude={"dataset"})


def test_of_other_data_every_demonstration_counts(run: Path, tmp_path: Path) -> None:
    make_dataset(tmp_path / "d", [[make_episode(k, steps=20) for k in (0, 1, 7)]])
    report = evaluate_offline(load_policy(run), tmp_path / "d")
    assert seeds(report) == [0, 1, 7], "recordings have no scene that two datasets could share"
    assert report.dataset == str(tmp_path / "d")


def test_tables_show_what_there_is(run: Path) -> None:
    report = evaluate_offline(load_policy(run))
    table = offline_table(report)
    rows = {name: values for name, *values in table.rows}
    e = report.all.errors
    assert rows["action L1"] == [e.action_l1, e.action_l1_zero, e.action_l1_hold]
    assert len(rows) == {"dp3": 1, "mba": 2, "fdp": 9}[run.name]
    if report.all.flow is not None:
        assert rows["ADE mm, best of 10 draws"] == [report.all.flow.best_ade_mm, "-", "-"]
    assert all(len(row) == len(table.columns) for row in table.rows)
    table = demonstration_table(report)
    assert [row[0] for row in table.rows] == ["roll 4", "roll 5"]
    assert ("pose mm" in table.columns, "3D-AJ" in table.columns) == (run.name == "mba", run.name == "fdp")
    assert all(len(row) == len(table.columns) for row in table.rows)


def simulated(folder: Path, numbers: Sequence[int]) -> Path:
    """A dataset that says it was simulated."""
    settings = {"expert": {"scene": {"convention": "flowlab"}}, **SETTINGS}
    make_dataset(folder, [[make_episode(k, steps=20) for k in numbers]], settings=settings)
    return folder


def test_scenes_that_were_trained_on_are_left_out_of_other_data(tmp_path: Path) -> None:
    data = simulated(tmp_path / "d", range(2, 6))
    run = make_run(data, "--policy", "dp3", "--out", tmp_path / "run", *SMALL)
    assert seeds(evaluate_offline(load_policy(run))) == [5]
    more = simulated(tmp_path / "more", range(8))
    assert seeds(evaluate_offline(load_policy(run), more)) == [0, 1, 5, 6, 7]
    (run / "run.json").unlink()
    assert seeds(evaluate_offline(load_policy(run), more)) == [0, 1, 6, 7], "5 may have been trained on, then"
    with pytest.raises(DataError, match=r"trained on the scenes of all its 2 demonstrations; give a dataset with oth"):
        evaluate_offline(load_policy(run), simulated(tmp_path / "few", (3, 4)))


def refused(run: Path, data: Path | None = None) -> str:
    with pytest.raises(DataError) as found:
        evaluate_offline(load_policy(run), data)
    return str(found.value)


def test_what_cannot_be_evaluated_is_told_in_a_sentence(tmp_path: Path) -> None:
    data = make_rolls(tmp_path / "d")
    run = make_run(data, "--policy", "mba", "--out", tmp_path / "run", *SMALL)
    other = tmp_path / "other"
    make_dataset(other, [[make_episode(task="pour", steps=20)]])
    assert "has the tasks pour, and the policy was trained on roll" in refused(run, other)
    wide = make_episode(steps=20)
    make_dataset(tmp_path / "wide", [[replace(wide, state=np.tile(wide.state, 2))]])
    assert "'state' is 18 wide, and 9 in what the policy was trained on" in refused(run, tmp_path / "wide")
    make_rolls(tmp_path / "seen", settings={**SETTINGS, "observer": {"points": 32}})
    assert "observer.points: the dataset has 32, the policy has 64" in refused(run, tmp_path / "seen")
    make_dataset(tmp_path / "blind", [[make_episode(steps=20, object_pose=False)]])
    assert "has no object poses, which mba needs" in refused(run, tmp_path / "blind")
    shutil.move(data, tmp_path / "gone")
    assert refused(run) == f"{run}: its dataset is no longer at {data}; give where it is now with --data"
    make_rolls(data, 7)
    assert "was trained on content" in refused(run)
    assert "nothing tells which of its demonstrations were" in refused(run, data)
    (run / "run.json").unlink()
    assert "does not tell which demonstrations were held out (it has no run.json)" in refused(run)
    assert "does not tell which demonstrations were held out" in refused(run, tmp_path / "gone")


def test_a_run_that_saw_everything_has_nothing_to_be_tested_on(tmp_path: Path) -> None:
    data = make_rolls(tmp_path / "d")
    run = make_run(data, "--policy", "dp3", "--out", tmp_path / "run", *SMALL, "--overfit", 1)
    assert "no demonstration was held out from its training" in refused(run)
    assert len(Dataset(data)) == 4


def test_the_command_prints_what_the_function_returns(run: Path, data: Path, capsys: Capture) -> None:
    report = evaluate_offline(load_policy(run))
    code, out, err = call_cli(capsys, "eval", run, "--offline", "--json")
    assert code == 0, err
    assert json.loads(out) == {str(run): json.loads(report.model_dump_json())}
    code, out, err = call_cli(capsys, "eval", run, "--offline", "--data", data)
    assert code == 0, err
    assert f"{report.all.errors.action_l1:,.4g}" in out
