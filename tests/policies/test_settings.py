"""The profiles of training: what they say, that they say all of it, and what is said of wrong values."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from flowlab.config import Settings
from flowlab.data.settings import TrainSettings
from flowlab.errors import UsageError
from flowlab.policies.settings import load_settings

PROFILES = Path(__file__).parents[2] / "pipelines/train"
POLICIES = ["fdp", "dp3", "mba"]


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("profile", ["fast", "paper"])
def test_the_profiles_suit_every_policy(profile: str, policy: str) -> None:
    settings = load_settings(profile, policy)
    assert settings.policy == policy
    values = yaml.safe_load((PROFILES / f"{profile}.yaml").read_text())
    assert settings.model_dump(mode="json") == {"policy": policy, **values}


def keys(model: type[Settings], where: str = "") -> Iterator[str]:
    """Every setting of a model, by its path."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, Settings):
            yield from keys(inner, f"{where}{name}.")
        else:
            yield where + name


def keys_in(values: dict[str, Any], where: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from keys_in(value, f"{where}{name}.")
        else:
            yield where + name


@pytest.mark.parametrize("profile", sorted(PROFILES.glob("*.yaml")), ids=lambda p: p.stem)
def test_a_profile_says_everything(profile: Path) -> None:
    """So that to read it is to know the run; and no setting has a second default in the code."""
    said = sorted(keys_in(yaml.safe_load(profile.read_text())))
    known = sorted(keys(TrainSettings))
    assert len(known) > 50
    assert [*said, "policy"] == [*(k for k in known if k != "policy"), "policy"]


def test_no_setting_has_a_default_in_the_code() -> None:
    values = yaml.safe_load((PROFILES / "fast.yaml").read_text())
    for path in keys_in(values):
        *groups, name = path.split(".")
        without = yaml.safe_load((PROFILES / "fast.yaml").read_text())
        target = without
        for group in groups:
            target = target[group]
        del target[name]
        with pytest.raises(ValueError, match="Field required") as caught:
            TrainSettings.model_validate({"policy": "fdp", **without})
        assert ".".join(map(str, caught.value.errors()[0]["loc"])) == path  # type: ignore[attr-defined]


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
        "optimizer={learning_rate: 2e-3, betas: [0, 0], weight_decay: 0, warmup_steps: 0, ema_power: 1, ema_max: 0}"],
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
    "motion.denoiser.kind=transformer": "motion.denoiser.kind: Input should be 'unet' or 'mlp' (found 'transformer')",
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
        ("motion.points", "--set motion.points: must look like motion.points=50"),
        ("=3", "--set =3: must look like motion.points=50"),
        ("motion.=3", "--set motion.=3: must look like motion.points=50"),
        ("points=3", "no setting is called 'points'; there are: action, batch, "),
        ("n_obs_steps.frames=3", "--set n_obs_steps.frames=3: 'n_obs_steps' holds a value, not further settings"),
        ("encoder.widths=[16", "--set encoder.widths=[16: not valid YAML: '[16'"),
    ],
)
def test_a_change_that_cannot_be_made_is_shown(change: str, sentence: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_settings("fast", "fdp", [change])
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "a profile is a mapping with the keys policy, n_obs_steps, horizon, "),
        ("[1, 2]", "a profile is a mapping with the keys "),
        ("n_obs_steps: [", "not valid YAML: "),
        ("n_obs_steps: 2", "horizon: Field required"),
    ],
)
def test_a_profile_that_is_none_is_refused(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(UsageError) as caught:
        load_settings(str(tmp_path / "mine.yaml"), "fdp")
    assert str(caught.value).startswith(f"profile {tmp_path / 'mine.yaml'}: {sentence}")
