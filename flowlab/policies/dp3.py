"""3D Diffusion Policy (Ze et al. 2024): point clouds and state in, actions out."""

from flowlab.policies.diffusion_policy import DiffusionPolicy, DiffusionPolicySettings


class DP3Settings(DiffusionPolicySettings):
    """Settings of 3D Diffusion Policy: those that every diffusion policy on clouds has."""

    policy: str = "dp3"


class DP3(DiffusionPolicy):
    """3D Diffusion Policy."""

    title = "3D Diffusion Policy"
    settings_class = DP3Settings
