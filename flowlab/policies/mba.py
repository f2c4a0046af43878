"""Motion Before Action (Su et al. 2024): predicts the pose of the object before the action."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from flowlab.data.batches import Batch
from flowlab.nets.motion import PoseHead
from flowlab.policies.diffusion_policy import MotionPolicy
from flowlab.policies.settings import MBASettings
from flowlab.policies.spec import PolicySpec

_CLIP = 2.0
"""Greatest normalized coordinate of a pose."""


class MBA(MotionPolicy):
    """Motion Before Action."""

    title = "Motion Before Action"
    settings_class = MBASettings

    def make_motion(self, spec: PolicySpec, condition: int) -> int:
        """See :class:`~flowlab.policies.diffusion_policy.DiffusionPolicy`."""
        s = spec.settings
        assert isinstance(s, MBASettings)
        self.motion_settings = s.motion
        self.motion = PoseHead(s.motion, self.diffusion, _CLIP, s.horizon, condition)
        return self.motion.features

    def motion_target(
        self, batch: Batch, gripper: Float[Tensor, "W 3"] | None
    ) -> tuple[Float[Tensor, "W T 9"], Float[Tensor, "W T 1"]]:
        """See :class:`~flowlab.policies.diffusion_policy.MotionPolicy`."""
        position = batch.object_pose[..., :3]
        position = position if gripper is None else position - gripper[:, None]
        pose = torch.cat([self.position_scale(position), batch.object_pose[..., 3:]], -1)
        return pose, batch.action_weight[..., None]

    def describe_motion(self, motion: Tensor, gripper: Float[Tensor, "W 3"] | None) -> dict[str, Tensor]:
        """See :class:`~flowlab.policies.diffusion_policy.DiffusionPolicy`."""
        position = self.position_scale.invert(motion[..., :3])
        position = position if gripper is None else position + gripper[:, None]
        return {"object_pose": torch.cat([position, motion[..., 3:]], -1)}

    def parameter_groups(self) -> dict[str, list[nn.Module]]:
        """See :class:`~flowlab.policies.base.PolicyNetwork`."""
        return {**super().parameter_groups(), "motion": [self.motion]}
