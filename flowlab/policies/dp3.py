"""3D Diffusion Policy (Ze et al. 2024): point clouds and state in, actions out."""

from flowlab.policies.diffusion_policy import DiffusionPolicy
from flowlab.policies.settings import DP3Settings


class DP3(DiffusionPolicy):
    """3D Diffusion Policy."""

    title = "3D Diffusion Policy"
    settings_class = DP3Settings
