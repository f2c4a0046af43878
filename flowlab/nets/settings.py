"""Settings of the networks."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from flowlab.config import Settings, later
from flowlab.limits import MAX_WIDTH

Width = Annotated[int, Field(gt=0, le=MAX_WIDTH)]
"""Of a layer, or how many points or steps there are: files of strangers may ask for any."""


class EncoderSettings(Settings):
    """How clouds and the robot's state become a vector."""

    points: Width = 1024
    """Of each cloud, the first so many: farthest-point samples are nested."""
    subset: Width | None = 256
    """Train on a random subset of so many of them, another in each step: cheaper, and varied. null trains on all."""
    subset_most: Annotated[Width | None, later(None)] = None
    """Draw how many that are in each step, from ``subset`` to so many: in use all are seen. null always takes
    ``subset``."""
    octaves: int = Field(default=1, ge=0, le=32)
    """Fourier features of the coordinates: sine and cosine of so many octaves."""
    relative: bool = True
    """Give points relative to the gripper, where the data tell where it is."""
    widths: tuple[Width, ...] = Field(default=(64, 128, 256), min_length=1)
    """Layers of the PointNet, each followed by LayerNorm and ReLU, before its max-pool."""
    features: Width = 256
    """Length of a cloud's vector."""
    scale: Annotated[Literal["shape", "axes"], later("shape")] = "shape"
    """``shape``: coordinates have one unit for all axes, so that shapes keep their proportions. ``axes``: each axis has
    its own limits, as in DP3."""
    state_widths: tuple[Width, ...] = Field(default=(64, 64), min_length=1)
    """Layers for the robot's state; the last is the length of its vector."""

    @model_validator(mode="after")
    def _ordered(self) -> "EncoderSettings":
        if self.subset_most is None:
            return self
        if self.subset is None:
            raise ValueError(f"subset_most={self.subset_most} needs the least number, as in subset=256; subset is null")
        if not self.subset <= self.subset_most <= self.points:
            raise ValueError(
                f"subset_most is from subset ({self.subset}) to points ({self.points}); found {self.subset_most}"
            )
        return self


class DenoiserSettings(Settings):
    """A denoising network."""

    kind: Literal["unet", "dp3-unet", "mlp"] = "mlp"
    """``unet``: 1D convolutions over time, one block a level as in SimpleDP3. ``dp3-unet``: DP3's own, with two blocks
    a level and in the middle, and its channels scaled by what the condition says instead of 1 and more. ``mlp``:
    residual layers over the whole horizon at once."""
    widths: tuple[Width, ...] = Field(default=(512, 512, 512), min_length=1)
    """Channels of each level, or of each residual layer (all alike)."""
    step_embedding: int = Field(default=64, ge=4, le=MAX_WIDTH, multiple_of=2)
    """Length of the diffusion step's embedding."""

    @model_validator(mode="after")
    def _fits(self) -> "DenoiserSettings":
        if self.kind == "mlp" and len(set(self.widths)) != 1:
            raise ValueError(f"residual layers are all alike, as in [512, 512, 512]; found {list(self.widths)}")
        if self.is_unet and any(w % 8 for w in self.widths):
            raise ValueError(f"a U-Net normalizes channels in 8 groups, so widths are multiples of 8: {self.widths}")
        return self

    @property
    def is_unet(self) -> bool:
        """Whether it halves and doubles the number of steps."""
        return self.kind != "mlp"

    def check_horizon(self, horizon: int) -> None:
        """Raises :class:`ValueError` where a network with these settings cannot denoise so many steps."""
        if self.is_unet and horizon % 2 ** (len(self.widths) - 1):
            raise ValueError(f"a U-Net of {len(self.widths)} levels cannot halve {horizon} steps so often")


class DiffusionSettings(Settings):
    """DDIM with a squared-cosine schedule, predicting the clean sample."""

    train_steps: Width = 100
    """Steps of noise that are trained on."""
    inference_steps: Width = 10
    """Steps in which noise is taken away in use."""
    loss: Literal["l1", "mse"] = "l1"
    """Distance between a predicted and a clean sample."""

    @model_validator(mode="after")
    def _divides(self) -> "DiffusionSettings":
        if self.train_steps % self.inference_steps:
            raise ValueError(f"{self.train_steps} steps cannot be gone through in {self.inference_steps} equal strides")
        return self


class MotionSettings(Settings):
    """What is predicted before the action: how points, or an object, will move."""

    condition: Literal["clean", "one-step", "truth", "truth-noised", "auxiliary"] = "one-step"
    """What the action is conditioned on in training. ``clean``: what the network makes of the noised motion, without
    gradient. ``one-step``: what it makes of pure noise, in use too; then it learns that step alone. ``truth``: the
    demonstrated motion; ``truth-noised``: the same with noise. ``auxiliary``: nothing, the motion is only an additional
    loss."""
    condition_noise: float = Field(default=0.0, ge=0)
    """Deviation of the noise of ``truth-noised``, in normalized units."""
    weight: float = Field(default=0.2, gt=0)
    """Of the motion's loss; the action's has 1."""
    summary: Annotated[Literal["mixed", "pooled"], later("mixed")] = "mixed"
    """What is made of a predicted motion for the action. ``pooled``: a convolution over time and the average of its
    results, the paper's words. ``mixed``: nonlinear layers around that. Only for a motion that is one sequence."""
    features: Width = 128
    """Length of the summary that the action is conditioned on, and of a query point's own vector."""
    denoiser: DenoiserSettings = DenoiserSettings(widths=(128, 128, 128))
    """The motion's network. With ``per-query``, ``mlp`` is meant, and its widths are those of each query."""
