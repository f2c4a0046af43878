"""Every setting of a training run. The profiles in ``pipelines/train/`` give all of them a value."""

from collections.abc import Iterable
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, PositiveFloat, PositiveInt, ValidationError, model_validator

from flowlab.config import Settings, explain, override, read_named
from flowlab.errors import UsageError, unknown_name

POLICIES = {"fdp": "3D Flow Diffusion Policy", "dp3": "3D Diffusion Policy", "mba": "Motion Before Action"}
_Share = Annotated[float, Field(ge=0, lt=1)]


class EncoderSettings(Settings):
    """How an observation becomes a vector."""

    points: PositiveInt
    """Of each cloud, the first so many: farthest-point samples are nested."""
    subset: PositiveInt | None
    """Train on a random subset of so many of them, another in each step; null trains on all."""
    octaves: int = Field(ge=0)
    """Fourier features of the coordinates: sine and cosine of so many octaves."""
    relative: bool
    """Give points relative to the gripper, where the data tell where it is."""
    widths: tuple[PositiveInt, ...] = Field(min_length=1)
    """Layers of the PointNet, each followed by LayerNorm and ReLU, before its max-pool."""
    features: PositiveInt
    """Length of a cloud's vector."""
    state_widths: tuple[PositiveInt, ...] = Field(min_length=1)
    """Layers for the robot's state; the last is the length of its vector."""


class DenoiserSettings(Settings):
    """A denoising network."""

    kind: Literal["unet", "mlp"]
    """``unet``: 1D convolutions over time, DP3's. ``mlp``: residual layers over the whole horizon at once."""
    widths: tuple[PositiveInt, ...] = Field(min_length=1)
    """Channels of each level, or of each residual layer (all alike)."""
    step_embedding: int = Field(ge=4, multiple_of=2)
    """Length of the diffusion step's embedding."""

    @model_validator(mode="after")
    def _fits(self) -> "DenoiserSettings":
        if self.kind == "mlp" and len(set(self.widths)) != 1:
            raise ValueError(f"residual layers are all alike, as in [512, 512, 512]; found {list(self.widths)}")
        if self.kind == "unet" and any(w % 8 for w in self.widths):
            raise ValueError(f"a U-Net normalizes channels in 8 groups, so widths are multiples of 8: {self.widths}")
        return self


class MotionSettings(Settings):
    """What 3D FDP and MBA predict before the action: how points, or an object, will move."""

    points: PositiveInt
    """M, the query points of an episode. 3D FDP only, like the next four."""
    sampling: Literal["scene", "object", "stratified"]
    """Which of the dataset's query points: see :class:`~flowlab.perception.queries.QuerySettings`."""
    flow_representation: Literal["channels", "per-query"]
    """``channels``: one sequence of M x 3 channels, each query its own. ``per-query``: one network for all queries,
    which tell each other what they have in common through their mean and maximum; their order does not matter."""
    subset: PositiveInt | None
    """Train on a random subset of so many queries, another in each step; null trains on all. per-query only."""
    occluded_weight: float = Field(ge=0, le=1)
    """Weight in the loss of a point that the camera does not see; one that it sees exactly has 1."""
    sigma_m: PositiveFloat
    """Stated error [m] at which the weight of an estimated position is a half."""
    condition: Literal["clean", "one-step", "truth", "truth-noised", "auxiliary"]
    """What the action is conditioned on in training. ``clean``: what the network makes of the noised motion, without
    gradient. ``one-step``: what it makes of pure noise, in use too; then it learns that step alone. ``truth``: the
    demonstrated motion; ``truth-noised``: the same with noise. ``auxiliary``: nothing, the motion is only an additional
    loss."""
    condition_noise: float = Field(ge=0)
    """Deviation of the noise of ``truth-noised``, in normalized units."""
    scale: Literal["limits", "quantile"]
    """What is 1 when flow is normalized (0 is always no motion): its largest component, or the length that 99 % of the
    steps stay below; the rest is clipped at ``clip``."""
    clip: PositiveFloat
    """Greatest value of normalized flow with ``quantile``."""
    weight: float = Field(gt=0)
    """Of the motion's loss; the action's has 1."""
    features: PositiveInt
    """Length of the summary that the action is conditioned on, and of what a query knows of its place."""
    denoiser: DenoiserSettings
    """The motion's network. With ``per-query``, ``mlp`` is meant, and its widths are those of each query."""


class DiffusionSettings(Settings):
    """DDIM with a squared-cosine schedule, predicting the clean sample."""

    train_steps: PositiveInt
    inference_steps: PositiveInt
    loss: Literal["l1", "mse"]

    @model_validator(mode="after")
    def _divides(self) -> "DiffusionSettings":
        if self.train_steps % self.inference_steps:
            raise ValueError(f"{self.train_steps} steps cannot be gone through in {self.inference_steps} equal strides")
        return self


class BatchSettings(Settings):
    """What one training step sees."""

    windows: PositiveInt
    segment: PositiveInt
    """Consecutive windows taken together: they share frames, which are encoded once."""
    draws: PositiveInt
    """Noise draws per window for the action: an observation is encoded once for all of them."""
    shift_m: float = Field(ge=0)
    """Shift scene and robot together by up to so much along x and y, at random [m]."""
    turn_deg: float = Field(ge=0, le=180)
    """Turn scene and robot together about the vertical by up to so much, at random [degrees]: only where all of the
    state is places and the action is a place or a displacement, as in simulation."""
    pad: bool
    """Train on the steps before the start and after the end of a demonstration too, which repeat its first and last
    action, as DP3 does; else they have no weight."""

    @model_validator(mode="after")
    def _divides(self) -> "BatchSettings":
        if self.windows % self.segment:
            raise ValueError(f"{self.windows} windows cannot be cut into segments of {self.segment}")
        return self


class OptimizerSettings(Settings):
    """AdamW for each module, cosine decay after a linear warm-up, moving average of the weights."""

    learning_rate: PositiveFloat
    betas: tuple[_Share, _Share]
    weight_decay: float = Field(ge=0)
    warmup_steps: int = Field(ge=0)
    """At most a tenth of the run."""
    ema_power: float = Field(gt=0)
    """After n steps the average keeps ``1 - (1 + n) ** -ema_power`` of itself,"""
    ema_max: float = Field(ge=0, lt=1)
    """and never more than this."""


class DataSettings(Settings):
    """Which demonstrations are trained on."""

    demonstrations: PositiveInt | None
    """Of each task the first so many; null takes all that are not held out."""
    held_out: int = Field(ge=0)
    """Of each task the last so many, never trained on; fewer where a task would be left with under two thirds."""


class RunSettings(Settings):
    """How long, and what is kept."""

    epochs: PositiveInt
    """Each demonstrated window once an epoch; ``steps`` or ``minutes`` override it."""
    steps: PositiveInt | None
    minutes: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    """As many steps as fit: they are timed first. CPU time of one thread; on a GPU, by the clock."""
    validations: int = Field(ge=0)
    """Evenly spaced looks at held-out demonstrations."""
    checkpoints: PositiveInt
    """Evenly spaced checkpoints of the weights; the last can be resumed."""
    seed: int = Field(ge=0, lt=2**63)


class TrainSettings(Settings):
    """A training run."""

    policy: Literal["fdp", "dp3", "mba"]
    n_obs_steps: PositiveInt
    """Frames an action is decided on."""
    horizon: PositiveInt
    """Steps that are predicted, from the first of those frames on."""
    n_action_steps: PositiveInt
    """Of those, how many are executed, from the last of those frames on."""
    encoder: EncoderSettings
    action: DenoiserSettings
    motion: MotionSettings
    diffusion: DiffusionSettings
    batch: BatchSettings
    optimizer: OptimizerSettings
    data: DataSettings
    run: RunSettings

    @model_validator(mode="after")
    def _fits(self) -> "TrainSettings":
        if self.n_obs_steps - 1 + self.n_action_steps > self.horizon:
            raise ValueError(
                f"{self.n_action_steps} steps from frame {self.n_obs_steps} on reach beyond {self.horizon}"
            )
        for denoiser in (self.action, *([self.motion.denoiser] if self.policy != "dp3" else [])):
            if denoiser.kind == "unet" and self.horizon % 2 ** (len(denoiser.widths) - 1):
                raise ValueError(f"a U-Net of {len(denoiser.widths)} levels cannot halve {self.horizon} steps so often")
        if (
            self.policy == "fdp"
            and self.motion.flow_representation == "per-query"
            and len(set(self.motion.denoiser.widths)) != 1
        ):
            raise ValueError(
                "the layers of a per-query network are all alike, as in motion.denoiser.widths=[128, 128, 128]; found "
                f"{list(self.motion.denoiser.widths)}"
            )
        return self


def load_settings(profile: str, policy: str, overrides: Iterable[str] = ()) -> TrainSettings:
    """The settings of a profile, by the name of one that comes with flowlab or by file, with ``key=value`` overrides.

    Raises :class:`UsageError` naming the setting that is missing, unknown or wrong.
    """
    if policy not in POLICIES:
        raise unknown_name("policy", policy, POLICIES)
    origin = f"profile {profile}"
    try:
        values: Any = yaml.safe_load(read_named("profile", profile, "train"))
    except yaml.YAMLError as error:
        raise UsageError(f"{origin}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise UsageError(f"{origin}: a profile is a mapping with the keys {', '.join(TrainSettings.model_fields)}")
    values["policy"] = policy
    for text in overrides:
        override(values, text, TrainSettings.model_fields, "motion.points=50")
    try:
        return TrainSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        of_all = not first["loc"]  # several groups do not fit each other: to show all settings would not help
        reason = first["msg"].removeprefix("Value error, ") if of_all else explain(error, TrainSettings)
        raise UsageError(f"{origin}: {reason}") from error
