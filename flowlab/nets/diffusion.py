"""Denoising diffusion: how noise is added in training, and taken away in use."""

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional


class Diffusion(nn.Module):
    """DDIM (Song et al. 2021, eta 0) that predicts the clean sample, with the squared-cosine schedule of Nichol &
    Dhariwal 2021.

    Agrees with diffusers' ``DDIMScheduler(beta_schedule="squaredcos_cap_v2", prediction_type="sample")`` with its
    defaults, which DP3 uses (see the tests).
    """

    alphas_cumprod: Tensor
    """(train_steps,): share of the clean sample's variance that is left after each step."""

    def __init__(self, train_steps: int = 100, inference_steps: int = 10, loss: Literal["l1", "mse"] = "l1") -> None:
        super().__init__()
        self._distance = functional.l1_loss if loss == "l1" else functional.mse_loss

        def level(t: float) -> float:
            return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

        beta = [min(1 - level((i + 1) / train_steps) / level(i / train_steps), 0.999) for i in range(train_steps)]
        # On the CPU also where a network is only sketched: there, arithmetic would load half of torch's compiler first.
        with torch.device("cpu"):
            alphas_cumprod = torch.cumprod(1 - torch.tensor(beta, dtype=torch.float32), 0)
        self.register_buffer("alphas_cumprod", alphas_cumprod, persistent=False)
        self.train_steps = train_steps
        stride = train_steps // inference_steps
        self.steps = tuple(range(0, train_steps, stride))[::-1]
        """Those gone through in use, from noise to clean."""

    def distance(self, predicted: Tensor, clean: Tensor) -> Tensor:
        """How far a prediction is from the clean sample, number by number."""
        return self._distance(predicted, clean, reduction="none")

    def noised(self, clean: Tensor, noise: Tensor, step: Tensor) -> Tensor:
        """The clean sample (B..., ...) as it is after ``step`` (B...) steps of noise."""
        alpha = self.alphas_cumprod[step].reshape(*step.shape, *[1] * (clean.ndim - step.ndim))
        return alpha.sqrt() * clean + (1 - alpha).sqrt() * noise

    def sample(self, denoise: Callable[[Tensor, int], Tensor], noise: Tensor, clip: float) -> Tensor:
        """From noise to a clean sample; ``denoise(x, k)`` predicts it from what is left at ``self.steps[k]``."""
        x = noise
        for k, step in enumerate(self.steps):
            clean = denoise(x, k)
            alpha = self.alphas_cumprod[step]
            residue = (x - alpha.sqrt() * clean) / (1 - alpha).sqrt()
            after = self.alphas_cumprod[self.steps[k + 1]] if k + 1 < len(self.steps) else torch.ones_like(alpha)
            x = after.sqrt() * clean.clamp(-clip, clip) + (1 - after).sqrt() * residue
        return x


class NoiseSampler:
    """The random numbers of one training step, a function of (seed, step) alone.

    Several processes that share a batch draw the numbers of all of it and keep their own part, so that their number
    does not change what is drawn. So does a resumed run.
    """

    def __init__(
        self, generator: torch.Generator, device: torch.device | str = "cpu", part: slice | None = None
    ) -> None:
        self._generator = generator
        self._device = device
        self._part = part or slice(None)

    def normal(self, windows: int, *shape: int) -> Tensor:
        """Standard normal numbers for this process's part of so many windows."""
        return self._kept(torch.randn(windows, *shape, generator=self._generator))

    def steps(self, below: int, windows: int, *shape: int) -> Tensor:
        """Diffusion steps, uniform from 0 to ``below - 1``."""
        return self._kept(torch.randint(below, (windows, *shape), generator=self._generator))

    def _kept(self, drawn: Tensor) -> Tensor:
        # Else the host would wait, at each draw, until a GPU has done all that was asked of it before.
        return drawn[self._part].to(self._device, non_blocking=True)
