"""Settings of the policies that come with flowlab; apart from their networks, so that a mistake is told at once."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, model_validator

from flowlab.config import later
from flowlab.data.needs import CloudNeeds, FlowNeeds, Needs
from flowlab.data.training_settings import TrainSettings
from flowlab.nets.settings import DenoiserSettings, DiffusionSettings, EncoderSettings, MotionSettings, Width


class DiffusionPolicySettings(TrainSettings):
    """Settings of a diffusion policy on point clouds."""

    encoder: EncoderSettings = EncoderSettings()
    action: DenoiserSettings = DenoiserSettings()
    """The network that denoises actions."""
    diffusion: DiffusionSettings = DiffusionSettings()

    @property
    def cloud_needs(self) -> CloudNeeds:
        """What the encoder asks for."""
        return CloudNeeds(self.encoder.points, self.encoder.subset, self.encoder.subset_most)

    @property
    def needs(self) -> Needs:
        """Point clouds."""
        return Needs(point_cloud=self.cloud_needs)

    @property
    def relative_to_gripper(self) -> bool:
        """As ``encoder.relative`` says."""
        return self.encoder.relative

    @property
    def scales_axes(self) -> bool:
        """As ``encoder.scale`` says."""
        return self.encoder.scale == "axes"

    @model_validator(mode="after")
    def _networks_fit(self) -> "DiffusionPolicySettings":
        self.action.check_horizon(self.horizon)
        return self


class DP3Settings(DiffusionPolicySettings):
    """Settings of 3D Diffusion Policy: those that every diffusion policy on clouds has."""

    policy: str = "dp3"


class FlowSettings(MotionSettings):
    """How the flow of query points is learned and predicted."""

    points: Width = 100
    """M, the query points of an episode."""
    sampling: Literal["scene", "object", "stratified"] = "scene"
    """Which of the dataset's query points: see :class:`~flowlab.perception.queries.QuerySettings`."""
    flow_representation: Literal["channels", "per-query"] = "per-query"
    """``channels``: one sequence of M x 3 channels, each query its own. ``per-query``: one network for all queries,
    which tell each other what they have in common through their mean and maximum; their order does not matter."""
    query_condition: Annotated[Literal["more", "local"], later("more")] = "more"
    """What the flow network is told of a query point. ``local``: the encoder's local feature, joined with the
    observation and projected, the paper's words. ``more``: also its coordinates and, with ``channels``, the observation
    once more."""
    subset: Width | None = 16
    """Train on a random subset of so many queries, another in each step; null trains on all. per-query only."""
    occluded_weight: float = Field(default=0.5, ge=0, le=1)
    """Weight in the loss of a point that the camera does not see; one that it sees exactly has 1."""
    sigma_m: PositiveFloat = 0.01
    """Stated error [m] at which the weight of an estimated position is a half."""
    scale: Literal["limits", "quantile"] = "quantile"
    """What is 1 when flow is normalized (0 is always no motion): its largest component, or the length that 99 % of the
    steps stay below; the rest is clipped at ``clip``."""
    clip: PositiveFloat = 3.0
    """Greatest value of normalized flow with ``quantile``."""

    @property
    def is_per_query(self) -> bool:
        """Whether one network serves all query points."""
        return self.flow_representation == "per-query"


class FDPSettings(DiffusionPolicySettings):
    """Settings of 3D Flow Diffusion Policy."""

    policy: str = "fdp"
    motion: FlowSettings = FlowSettings()

    @property
    def needs(self) -> Needs:
        """Point clouds, and the flow of query points."""
        m = self.motion
        flow = FlowNeeds(
            points=m.points,
            sampling=m.sampling,
            subset=m.subset if m.is_per_query else None,
            occluded_weight=m.occluded_weight,
            sigma_m=m.sigma_m,
            scale=m.scale,
            clip=m.clip,
        )
        return Needs(point_cloud=self.cloud_needs, flow=flow)

    @model_validator(mode="after")
    def _motion_fits(self) -> "FDPSettings":
        widths = self.motion.denoiser.widths
        if self.motion.is_per_query and len(set(widths)) != 1:
            raise ValueError(
                "the layers of a per-query network are all alike, as in motion.denoiser.widths=[128, 128, 128]; found "
                f"{list(widths)}"
            )
        if self.motion.is_per_query and self.motion.summary == "pooled":
            raise ValueError("motion.summary: pooled is for motion.flow_representation=channels, or leave it out")
        self.motion.denoiser.check_horizon(self.horizon)
        return self


class MBASettings(DiffusionPolicySettings):
    """Settings of Motion Before Action."""

    policy: str = "mba"
    motion: MotionSettings = MotionSettings()

    @property
    def needs(self) -> Needs:
        """Point clouds and, in training, the object's pose."""
        return Needs(point_cloud=self.cloud_needs, object_pose=True)

    @model_validator(mode="after")
    def _motion_fits(self) -> "MBASettings":
        self.motion.denoiser.check_horizon(self.horizon)
        return self


OWN: Mapping[str, type[TrainSettings]] = {
    "flowlab.policies.dp3:DP3": DP3Settings,
    "flowlab.policies.fdp:FDP": FDPSettings,
    "flowlab.policies.mba:MBA": MBASettings,
}
"""The settings by the import path of the policy: the same that the policy itself names."""
