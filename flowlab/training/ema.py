"""The moving average of a policy's weights."""

import copy

import torch
from torch import Tensor

from flowlab.data.training_settings import OptimizerSettings
from flowlab.policies.base import PolicyNetwork


class EMA:
    """Exponential moving average of a policy's weights: what is validated, kept and used."""

    def __init__(self, policy: PolicyNetwork, settings: OptimizerSettings) -> None:
        self.policy = copy.deepcopy(policy).requires_grad_(False).eval()
        self._settings = settings
        self._averaged: list[Tensor] = list(self.policy.parameters())

    def update(self, policy: PolicyNetwork, step: int) -> None:
        """Take in the weights after a step."""
        decay = min(1 - (1 + step) ** -self._settings.ema_power, self._settings.ema_max)
        torch._foreach_lerp_(self._averaged, [p.detach() for p in policy.parameters()], 1 - decay)
