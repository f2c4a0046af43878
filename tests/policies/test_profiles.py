"""The profiles of training: what they say, that they say all of it, and what is said of wrong values."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from flowlab.config import Settings
from flowlab.data.needs import Needs
from flowlab.data.training_settings import BatchSettings, TrainSettings
from flowlab.errors import UsageError
from flowlab.policies.migrations import migrate_policy
from flowlab.policies.profiles import load_settings, settings_class
from flowlab.policies.settings import OWN, FDPSettings
from flowlab.registry import POLICIES as REGISTRY

PROFILES = Path(__file__).parents[2] / "pipelines/train"
POLICIES = ["fdp", "dp3", "mba"]


OLD = Path(__file__).parents[1] / "fixtures/old/settings.json"
"""What the profiles came to when they still said everything, at commit 79a7dbb."""


@pytest.mark.parametrize("policy", POLICIES)
def test_the_fast_profile_says_what_it_said(policy: str) -> None:
    """By today's names, and without what was another policy's; settings that came later are not in what is kept. It
    plans anew twice as often as it did."""
    old = json.loads(OLD.read_text())[f"fast/{policy}"]
    wanted = migrate_policy({"format": 1, "policy": {"settings": old}})["policy"]["settings"]
    assert load_settings("fast", policy).model_dump(mode="json") == {**wanted, "n_action_steps": 4}


LATER = {
    "optimizer.decay_from": "warmup", "encoder.scale": "axes", "motion.summary": "pooled",
    "motion.query_condition": "local",
}  # fmt: skip


@pytest.mark.parametrize("path", LATER)
def test_settings_that_came_later_are_kept_where_they_say_something(path: str) -> None:
    """And a run from before them is one with their defaults."""
    settings = load_settings("fast", "fdp", [f"{path}={LATER[path]}", "motion.flow_representation=channels"])
    kept = dict(said(settings.model_dump(mode="json")))
    assert kept[path] == LATER[path]
    assert FDPSettings.model_validate_json(settings.model_dump_json()) == settings
    assert path not in dict(said(load_settings("fast", "fdp").model_dump(mode="json")))


@pytest.mark.parametrize("policy", POLICIES)
def test_the_defaults_are_the_fast_profile(policy: str) -> None:
    assert load_settings("fast", policy) == settings_class(policy)()
    assert yaml.safe_load((PROFILES / "fast.yaml").read_text()) is None


def said(values: dict[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from said(value, f"{where}{name}.")
        else:
            yield where + name, value


@pytest.mark.parametrize("policy", POLICIES)
def test_the_paper_profile_says_what_differs_only(policy: str) -> None:
    values = yaml.safe_load((PROFILES / "paper.yaml").read_text())
    own = values.pop("policies")[policy]
    defaults = dict(said(settings_class(policy)().model_dump(mode="json")))
    told = {**dict(said(values)), **dict(said(own))}
    assert len(told) > 8
    assert {key for key, value in told.items() if defaults.get(key) == value} == set()


@pytest.mark.parametrize("policy", POLICIES)
def test_every_setting_has_a_default(policy: str) -> None:
    def required(model: type[Settings], where: str = "") -> Iterator[str]:
        for name, field in model.model_fields.items():
            if field.is_required():
                yield where + name
            if isinstance(field.default, Settings):
                yield from required(type(field.default), f"{where}{name}.")

    assert list(required(settings_class(policy))) == []


def test_a_group_given_in_part_keeps_the_defaults_of_its_place() -> None:
    """A denoiser's widths are others for the motion than for the action."""
    settings = FDPSettings.model_validate(
        {"motion": {"denoiser": {"step_embedding": 8}}, "action": {"step_embedding": 8}}
    )
    assert settings.motion.denoiser.widths == (128, 128, 128)
    assert settings.action.widths == (512, 512, 512)
    assert settings == load_settings("fast", "fdp", ["motion.denoiser.step_embedding=8", "action.step_embedding=8"])


def test_a_profile_says_only_what_differs_from_another(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        "extends: paper\nbatch: {windows: 32}\npolicies:\n  fdp: {motion: {points: 7}}\n  dp3: {horizon: 24}\n"
    )
    (tmp_path / "b.yaml").write_text("extends: a.yaml\nbatch: {draws: 3}\nhorizon: 32\n")
    found = load_settings(str(tmp_path / "b.yaml"), "fdp", ["motion.features=9"])
    paper = load_settings("paper", "fdp")
    assert found == paper.model_copy(
        update={
            "horizon": 32,
            "batch": paper.batch.model_copy(update={"windows": 32, "draws": 3}),
            "motion": paper.motion.model_copy(update={"points": 7, "features": 9}),
        }
    )
    assert load_settings(str(tmp_path / "b.yaml"), "dp3").horizon == 32, "what extends comes after what is extended"
    assert load_settings(str(tmp_path / "a.yaml"), "dp3").horizon == 24


def test_a_wrong_value_in_python_is_one_sentence_too() -> None:
    for make, sentence in (
        (lambda: FDPSettings(horizon=0), "FDPSettings: horizon: Input should be greater than 0 (found 0)"),
        (
            lambda: FDPSettings(horison=8),
            "FDPSettings: horison: no setting is called 'horison'; did you mean horizon or motion?",
        ),
        (lambda: BatchSettings(windows=7), "BatchSettings: 7 windows cannot be cut into segments of 8"),
        (lambda: TrainSettings(), "TrainSettings: policy: Field required"),
    ):
        with pytest.raises(UsageError) as caught:
            make()
        assert str(caught.value) == sentence


PAPER = {
    "encoder.points": 1024,
    "n_obs_steps": 2,
    "horizon": 16,
    "n_action_steps": 8,
    "motion.points": 100,
    "motion.sampling": "scene",
    "diffusion.train_steps": 100,
    "diffusion.inference_steps": 10,
    "diffusion.loss": "l1",
    "batch.windows": 128,
    "run.epochs": 1000,
    "run.steps": None,
    "run.minutes": None,
    "optimizer.learning_rate": 1e-4,
    "optimizer.betas": (0.95, 0.999),
    "optimizer.weight_decay": 1e-6,
    "optimizer.warmup_steps": 500,
    "encoder.subset": None,
    "batch.shift_m": 0.0,
    "batch.turn_deg": 0.0,
}
"""Its sections on training and inference; the last three: "without any data augmentation"."""


@pytest.mark.parametrize("key", PAPER)
def test_the_papers_numbers_are_the_papers(key: str) -> None:
    value: Any = load_settings("paper", "fdp")
    for part in key.split("."):
        value = getattr(value, part)
    assert value == PAPER[key]


def test_overrides_are_yaml_and_the_last_one_counts() -> None:
    settings = load_settings(
        "fast", "fdp", ["motion.points=50", "run.minutes=null", "action.widths=[8, 8]", "motion.points=51",
        "optimizer={learning_rate: 2e-3, betas: [0, 0]}"],
    )  # fmt: skip
    assert (settings.motion.points, settings.run.minutes, settings.action.widths) == (51, None, (8, 8))
    assert (settings.optimizer.learning_rate, settings.optimizer.betas) == (2e-3, (0, 0))


WRONG = {
    "motion.points=0": "motion.points: Input should be greater than 0 (found 0)",
    "motion.points=2.5": "motion.points: ",
    "motion.condition=true": "motion.condition: ",
    "motion.sampling=objects": "motion.sampling: Input should be 'scene', 'object' or 'stratified' (found 'objects')",
    "motion.occluded_weight=1.5": "motion.occluded_weight: ",
    "motion.sigma_m=0": "motion.sigma_m: ",
    "motion.denoiser.kind=transformer": "motion.denoiser.kind: Input should be 'unet', 'dp3-unet' or 'mlp'",
    "motion.denoiser.widths=[16, 0]": "motion.denoiser.widths.1: ",
    "motion.denoiser.width=[16]": "motion.denoiser.width: no setting is called 'width'; did you mean widths?",
    "motion.denoiser.widths=[]": "motion.denoiser.widths: ",
    "encoder.widths=16": "encoder.widths: ",
    "encoder.state_widths=[]": "encoder.state_widths: ",
    "encoder.octaves=-1": "encoder.octaves: ",
    "encoder.relative=perhaps": "encoder.relative: ",
    "encoder.color=true": "encoder.color: no setting is called 'color'; ",
    "action.widths=[512, 256]": "action: ",
    "action={kind: unet, widths: [60], step_embedding: 8}": "action: ",
    "action.step_embedding=63": "action.step_embedding: ",
    "diffusion.inference_steps=7": "diffusion: ",
    "diffusion.loss=l2": "diffusion.loss: Input should be 'l1' or 'mse' (found 'l2')",
    "batch.segment=7": "batch: ",
    "batch.shift_m=-0.1": "batch.shift_m: ",
    "optimizer.learning_rate=0": "optimizer.learning_rate: ",
    "optimizer.betas=[0.9]": "optimizer.betas.1: ",
    "optimizer.betas=[0.9, 1]": "optimizer.betas.1: ",
    "optimizer.ema_max=1": "optimizer.ema_max: ",
    "data.held_out=-1": "data.held_out: ",
    "data.demonstrations=0": "data.demonstrations: ",
    "run.minutes=.inf": "run.minutes: ",
    "run.checkpoints=0": "run.checkpoints: ",
    "run.seed=9223372036854775808": "run.seed: ",
    "n_action_steps=16": "16 steps from frame 2 on reach beyond 16",
    "horizon=null": "horizon: ",
}


@pytest.mark.parametrize("change", WRONG)
def test_a_wrong_value_is_named_by_its_path(change: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_settings("fast", "fdp", [change])
    assert str(caught.value).startswith(f"profile fast: {WRONG[change]}")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("motion.points", "--set motion.points: must look like batch.windows=64"),
        ("=3", "--set =3: must look like batch.windows=64"),
        ("motion.=3", "--set motion.=3: must look like batch.windows=64"),
        (
            "points=3",
            "no setting of fdp is called 'points'; there are: action, batch, data, diffusion, encoder, horizon, ",
        ),
        ("n_obs_steps.frames=3", "--set n_obs_steps.frames=3: 'n_obs_steps' holds a value, not further settings"),
        ("encoder.widths=[16", "--set encoder.widths=[16: not valid YAML: '[16'"),
    ],
)
def test_a_change_that_cannot_be_made_is_shown(change: str, sentence: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_settings("fast", "fdp", [change])
    assert str(caught.value).startswith(sentence)


def test_a_setting_of_another_policy_is_unknown() -> None:
    with pytest.raises(UsageError, match=r"^no setting of dp3 is called 'motion'; there are: action, batch, .*, run$"):
        load_settings("fast", "dp3", ["motion.points=50"])
    with pytest.raises(UsageError, match=r"motion.points: no setting is called 'points'; there are: condition, "):
        load_settings("fast", "mba", ["motion.points=50"])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[1, 2]", "must be a mapping of settings, as in 'extends: fast' and 'horizon: 8'"),
        ("n_obs_steps: [", "not valid YAML: "),
        ("history: 2", "no setting of fdp is called 'history'; there are: "),
        ("extends: mine.yaml", "extends itself ("),
        ("extends: [fast]", "extends: must be the name of a profile or a file; found ['fast']"),
        ("policies: [fdp]", "policies: must hold settings by policy, as in 'fdp: {motion: {points: 50}}'"),
        ("policies: {fpd: {horizon: 8}}", "policies: no policy is called 'fpd'; did you mean fdp?"),
        ("policies: {dp3: 3}", "policies: must hold settings by policy"),
        ("policy: dp3", "is for policy dp3, and fdp was asked for"),
        ("batch: 3", "batch: Input should be a valid dictionary"),
    ],
)
def test_a_profile_that_is_none_is_refused(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(UsageError) as caught:
        load_settings(str(tmp_path / "mine.yaml"), "fdp")
    assert str(caught.value).startswith(f"profile {tmp_path / 'mine.yaml'}: {sentence}")


def test_a_profile_that_is_not_there_is_named() -> None:
    with pytest.raises(UsageError, match=r"no profile is called 'fats'; did you mean fast\?"):
        load_settings("fats", "fdp")


def test_policies_on_pictures_are_not_trained_on_moved_scenes() -> None:
    class Pictures(TrainSettings):
        @property
        def needs(self) -> Needs:
            return Needs(rgb=True)

    with pytest.raises(UsageError, match=r"batch.shift_m is 0.1 and batch.turn_deg 20.0, and x is trained on pictures"):
        Pictures(policy="x")
    Pictures(policy="x", batch=BatchSettings(shift_m=0, turn_deg=0))


def test_settings_that_are_known_without_a_policy_are_those_of_the_policy() -> None:
    assert {place: REGISTRY.load(place).settings_class for place in OWN} == OWN
    assert {*OWN} == {plugin.place for plugin in REGISTRY.offers() if plugin.package.startswith("flowlab ")}
