"""The settings that every training run has, whatever its policy: the base of each policy's own."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from flowlab.config import Settings, later, merge
from flowlab.data.needs import Needs
from flowlab.limits import MAX_WIDTH

_Steps = Annotated[int, Field(gt=0, le=MAX_WIDTH)]
_Proportion = Annotated[float, Field(ge=0, lt=1)]


class BatchSettings(Settings):
    """What one training step sees."""

    windows: PositiveInt = 128
    """Windows of every step, all processes together."""
    segment: PositiveInt = 8
    """Consecutive windows taken together: they share frames, which are encoded once."""
    draws: PositiveInt = 4
    """Noise draws per window for the action: an observation is encoded once for all of them."""
    shift_m: float = Field(default=0.1, ge=0)
    """Shift scene and robot together by up to so much along x and y, at random [m]."""
    turn_deg: float = Field(default=20.0, ge=0, le=180)
    """Turn scene and robot together about the vertical by up to so much, at random [degrees]: only where all of the
    state is positions and the action is a position or a displacement, as in simulation."""
    pad: bool = False
    """Train on the steps before the start and after the end of a demonstration too, which repeat its first and last
    action, as DP3 does; else they have no weight."""

    @model_validator(mode="after")
    def _divides(self) -> "BatchSettings":
        if self.windows % self.segment:
            raise ValueError(f"{self.windows} windows cannot be cut into segments of {self.segment}")
        return self


class OptimizerSettings(Settings):
    """AdamW for each group of parameters, cosine decay after a linear warm-up, moving average of the weights."""

    learning_rate: PositiveFloat = 2e-3
    """Where it is greatest, after the warm-up."""
    betas: tuple[_Proportion, _Proportion] = (0.95, 0.999)
    """Of AdamW."""
    weight_decay: float = Field(default=1e-6, ge=0)
    """Of AdamW."""
    warmup_steps: int = Field(default=100, ge=0)
    """At most a tenth of the run, with ``decay_from`` at its default."""
    decay_from: Annotated[Literal["start", "warmup"], later("start")] = "start"
    """Where the cosine begins: with the run, or after the warm-up, as in DP3."""
    ema_power: float = Field(default=0.75, gt=0)
    """After n steps the average keeps ``1 - (1 + n) ** -ema_power`` of itself,"""
    ema_max: float = Field(default=0.9995, ge=0, lt=1)
    """and never more than this."""


class DataSettings(Settings):
    """Which demonstrations are trained on."""

    demonstrations: PositiveInt | None = None
    """Of each task the first so many; null takes all that are not held out."""
    held_out: int = Field(default=1, ge=0)
    """Of each task the last so many, never trained on; fewer where a task would be left with under two thirds."""


class RunSettings(Settings):
    """How long a run is, and what is saved of it."""

    epochs: PositiveInt = 1000
    """Each demonstrated window once an epoch; ``steps`` or ``minutes`` override it."""
    steps: PositiveInt | None = None
    """Training steps; null leaves it to ``minutes`` or ``epochs``."""
    minutes: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = 10.0
    """As many steps as fit: they are timed first. CPU time of one thread; on a GPU, by the clock."""
    validations: int = Field(default=10, ge=0)
    """Evenly spaced looks at held-out demonstrations."""
    checkpoints: PositiveInt = 5
    """Evenly spaced checkpoints of the weights; the last can be resumed."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Decides the first weights, the order of windows, and all noise."""


class TrainSettings(Settings):
    """A training run. Each policy adds its own settings in a subclass; every default is a field's, here or there.

    A group may be given in part, ``{"batch": {"windows": 64}}``: what it does not say keeps the default that it has in
    this class.
    """

    policy: str
    """Name of the policy, or where its class is: ``module:Class``."""
    n_obs_steps: _Steps = 2
    """Frames an action is decided on."""
    horizon: _Steps = 16
    """Steps that are predicted, from the first of those frames on."""
    n_action_steps: _Steps = 4
    """Of those, how many are executed, from the last of those frames on; the paper and DP3 execute 8."""
    batch: BatchSettings = BatchSettings()
    optimizer: OptimizerSettings = OptimizerSettings()
    data: DataSettings = DataSettings()
    run: RunSettings = RunSettings()

    @property
    def needs(self) -> Needs:
        """Which arrays of a dataset a policy with these settings needs."""
        return Needs()

    @property
    def relative_to_gripper(self) -> bool:
        """Whether positions are given relative to the gripper, where the data tell where it is."""
        return False

    @property
    def scales_axes(self) -> bool:
        """Whether each axis of a position has limits of its own."""
        return False

    @model_validator(mode="before")
    @classmethod
    def _complete_groups(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        groups = {n: f.default for n, f in cls.model_fields.items() if isinstance(f.default, Settings)}
        given = {n: v for n, v in values.items() if n in groups and isinstance(v, Mapping)}
        return {**values, **{n: merge(groups[n].model_dump(), v) for n, v in given.items()}}

    @model_validator(mode="after")
    def _fits(self) -> "TrainSettings":
        if self.n_obs_steps - 1 + self.n_action_steps > self.horizon:
            raise ValueError(
                f"{self.n_action_steps} steps from frame {self.n_obs_steps} on reach beyond {self.horizon}"
            )
        if self.needs.pictures and (self.batch.shift_m or self.batch.turn_deg):
            raise ValueError(
                f"batch.shift_m is {self.batch.shift_m} and batch.turn_deg {self.batch.turn_deg}, and {self.policy} is "
                "trained on pictures, in which a scene cannot be moved; set both to 0"
            )
        return self
