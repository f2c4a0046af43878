"""3D Flow Diffusion Policy: predicts how points of the scene will move before the action.

Its loss is that of the action and that of the flow (``policies/diffusion_policy.py``), each point of which has the
weight that its quality gives it (``data/batch_builder.py``); the heads that predict flow are in ``nets/motion.py``.
"""

from jaxtyping import Float
from torch import Tensor, nn

from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.scaler import Scaler
from flowlab.nets.motion import ChannelFlowHead, PerQueryFlowHead, QueryEncoder
from flowlab.policies.diffusion_policy import MotionPolicy
from flowlab.policies.settings import FDPSettings
from flowlab.policies.spec import PolicySpec


class FDP(MotionPolicy):
    """3D Flow Diffusion Policy."""

    title = "3D Flow Diffusion Policy"
    settings_class = FDPSettings
    motion: ChannelFlowHead | PerQueryFlowHead

    def make_motion(self, spec: PolicySpec, condition: int) -> int:
        """See :class:`~flowlab.policies.diffusion_policy.DiffusionPolicy`."""
        s, n = spec.settings, spec.normalizer
        assert isinstance(s, FDPSettings)
        assert n.flow is not None
        assert n.flow_clip is not None
        self.motion_settings, self.flow_scale, self.flow_clip = s.motion, Scaler(n.flow), n.flow_clip
        more = s.motion.query_condition == "more"
        if s.motion.is_per_query:
            self.motion = PerQueryFlowHead(s.motion, self.diffusion, n.flow_clip, s.horizon, condition)
        else:
            self.motion = ChannelFlowHead(
                s.motion, self.diffusion, n.flow_clip, s.horizon, condition, s.motion.points, more
            )
        self.query_encoder = QueryEncoder(self.encoder.cloud, s.motion.features, coordinates=more)
        return self.motion.features

    def encode_queries(
        self, context: ObservationBatch, gripper: Float[Tensor, "W 3"] | None
    ) -> Float[Tensor, "W M features"]:
        """See :class:`~flowlab.policies.diffusion_policy.MotionPolicy`."""
        xyz = context.queries if gripper is None else context.queries - gripper[:, None]
        return self.query_encoder(self.encoder.cloud, self.position_scale(xyz))

    def motion_target(
        self, batch: Batch, gripper: Float[Tensor, "W 3"] | None
    ) -> tuple[Float[Tensor, "W T M 3"], Float[Tensor, "W T M 3"]]:
        """See :class:`~flowlab.policies.diffusion_policy.MotionPolicy`."""
        flow = self.flow_scale(batch.flow).clamp(-self.flow_clip, self.flow_clip)
        return flow, batch.flow_weight[..., None].expand_as(flow)

    def describe_motion(self, motion: Tensor, gripper: Float[Tensor, "W 3"] | None) -> dict[str, Tensor]:
        """See :class:`~flowlab.policies.diffusion_policy.DiffusionPolicy`."""
        return {"flow": self.flow_scale.invert(motion)}

    def parameter_groups(self) -> dict[str, list[nn.Module]]:
        """See :class:`~flowlab.policies.base.PolicyNetwork`."""
        return {**super().parameter_groups(), "motion": [self.motion, self.query_encoder]}
