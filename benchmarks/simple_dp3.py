"""SimpleDP3 as one would write it down from its description: what a user of DP3's smaller model waits for.

Source: ``SimpleDP3``, ``PointNetEncoderXYZ``, its ``ConditionalUnet1D`` and ``EMAModel`` of the 3D-Diffusion-Policy
repository (Ze et al., 2024), with ``config/simple_dp3.yaml``; written anew in plain PyTorch, with no line of theirs.
It has their layers in their sizes, so it does their arithmetic: 7.4 million parameters. Its U-Net has one residual
block at each level where DP3's own has two.

Differences: 16 steps are predicted, as in ``dp3.yaml``, instead of 4; inputs come normalized; diffusers' DDIM
scheduler is written out; masks for inpainting, which hide nothing in this configuration, are left out.
"""

import copy
import math
import sys
import time

import torch
from torch import Tensor, nn
from torch.nn import functional

STATE, ACTION, FRAMES, HORIZON = 9, 4, 2, 16
WIDTHS, KERNEL, GROUPS, STEP_EMBEDDING = (128, 256, 384), 5, 8, 128
TRAIN_STEPS, INFERENCE_STEPS = 100, 10


class SimpleDP3(nn.Module):
    """From two frames of N points and the robot's state to a plan; everything normalized to [-1, 1]."""

    alpha_bar: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.denoiser = UNet(condition=FRAMES * 128)
        self.register_buffer("alpha_bar", squared_cosine(TRAIN_STEPS))

    def loss(self, points: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """Mean squared error of denoised actions, from points (B, 2, N, 3), state (B, 2, 9), action (B, 16, 4)."""
        condition = self.encoder(points, state)
        step = torch.randint(TRAIN_STEPS, (len(action),), device=action.device)
        kept = self.alpha_bar[step][:, None, None]
        noisy = kept.sqrt() * action + (1 - kept).sqrt() * torch.randn_like(action)
        return functional.mse_loss(self.denoiser(noisy, step, condition), action)

    @torch.no_grad()
    def plan(self, points: Tensor, state: Tensor) -> Tensor:
        """Actions (B, 16, 4) drawn with DDIM, from points (B, 2, N, 3) and state (B, 2, 9)."""
        condition = self.encoder(points, state)
        plan = torch.randn(len(points), HORIZON, ACTION, device=points.device)
        stride = TRAIN_STEPS // INFERENCE_STEPS
        for k in reversed(range(0, TRAIN_STEPS, stride)):
            step = torch.full((len(points),), k, device=points.device)
            clean = self.denoiser(plan, step, condition)
            now, then = self.alpha_bar[k], self.alpha_bar[k - stride] if k else torch.ones_like(self.alpha_bar[0])
            # As in diffusers, the noise belongs to the prediction before it is clipped.
            noise = (plan - now.sqrt() * clean) / (1 - now).sqrt()
            plan = then.sqrt() * clean.clamp(-1, 1) + (1 - then).sqrt() * noise
        return plan


class Encoder(nn.Module):
    """A PointNet for the cloud and an MLP for the state; 128 features of each frame."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width_in, width in ((3, 64), (64, 128), (128, 256)):
            layers += [nn.Linear(width_in, width), nn.LayerNorm(width), nn.ReLU()]
        self.point = nn.Sequential(*layers)
        self.cloud = nn.Sequential(nn.Linear(256, 64), nn.LayerNorm(64))
        self.state = nn.Sequential(nn.Linear(STATE, 64), nn.ReLU(), nn.Linear(64, 64))

    def forward(self, points: Tensor, state: Tensor) -> Tensor:
        """Features (B, 256) of points (B, 2, N, 3) and state (B, 2, 9)."""
        points, state = points.flatten(0, 1), state.flatten(0, 1)
        cloud = self.cloud(self.point(points).max(1).values)
        return torch.cat([cloud, self.state(state)], -1).reshape(-1, FRAMES * 128)


class UNet(nn.Module):
    """The denoiser: 1D convolutions over time, a residual block at each of three levels, down and up again."""

    def __init__(self, condition: int) -> None:
        super().__init__()
        e, (a, b, c) = STEP_EMBEDDING, WIDTHS
        condition += e
        self.step = nn.Sequential(Sinusoids(e), nn.Linear(e, 4 * e), nn.Mish(), nn.Linear(4 * e, e))
        self.down = nn.ModuleList(ResidualBlock(i, o, condition) for i, o in ((ACTION, a), (a, b), (b, c)))
        self.shrink = nn.ModuleList(nn.Conv1d(width, width, 3, stride=2, padding=1) for width in (a, b))
        self.middle = ResidualBlock(c, c, condition)
        self.up = nn.ModuleList(ResidualBlock(2 * i, o, condition) for i, o in ((c, b), (b, a)))
        self.grow = nn.ModuleList(nn.ConvTranspose1d(width, width, 4, stride=2, padding=1) for width in (b, a))
        self.out = nn.Sequential(conv_block(a, a), nn.Conv1d(a, ACTION, 1))

    def forward(self, noisy: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """The clean actions (B, 16, 4) of noisy ones at diffusion steps (B,), given features (B, 256)."""
        condition = torch.cat([self.step(step), condition], -1)
        x = noisy.transpose(1, 2)
        skipped = []
        for k, block in enumerate(self.down):
            x = block(x, condition)
            skipped.append(x)
            if k < len(self.shrink):
                x = self.shrink[k](x)
        x = self.middle(x, condition)
        for block, grow in zip(self.up, self.grow, strict=True):
            x = grow(block(torch.cat([x, skipped.pop()], 1), condition))
        return self.out(x).transpose(1, 2)


class ResidualBlock(nn.Module):
    """Two convolutions; between them the condition scales and shifts every channel (FiLM)."""

    def __init__(self, width_in: int, width: int, condition: int) -> None:
        super().__init__()
        self.first, self.second = conv_block(width_in, width), conv_block(width, width)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * width))
        self.skip = nn.Conv1d(width_in, width, 1) if width_in != width else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Channels over time (B, C, T) to others, given (B, F)."""
        scale, shift = self.film(condition)[..., None].chunk(2, 1)
        return self.second(scale * self.first(x) + shift) + self.skip(x)


def conv_block(width_in: int, width: int) -> nn.Sequential:
    """Convolution over time, group norm, Mish."""
    return nn.Sequential(
        nn.Conv1d(width_in, width, KERNEL, padding=KERNEL // 2), nn.GroupNorm(GROUPS, width), nn.Mish()
    )


class Sinusoids(nn.Module):
    """Sines, then cosines, of a diffusion step, at wavelengths from 2 pi to 20 000 pi."""

    def __init__(self, length: int) -> None:
        super().__init__()
        self.half = length // 2

    def forward(self, step: Tensor) -> Tensor:
        """Steps (B,) to (B, length)."""
        frequency = torch.exp(torch.arange(self.half, device=step.device) * (-math.log(10000) / (self.half - 1)))
        angle = step[:, None] * frequency
        return torch.cat([angle.sin(), angle.cos()], -1)


def squared_cosine(steps: int) -> Tensor:
    """The share of the signal's power that is left at each diffusion step (Nichol & Dhariwal, 2021)."""

    def left(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - left((k + 1) / steps) / left(k / steps), 0.999) for k in range(steps)]
    return torch.cumprod(1 - torch.tensor(betas), 0)


class Ema:
    """The moving average of a model's weights, which is what acts in the end."""

    def __init__(self, model: nn.Module) -> None:
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self.steps = 0

    @torch.no_grad()
    def update(self, model: nn.Module) -> None:
        """Call after each step of the optimizer."""
        keep = min(1 - max(self.steps, 1) ** -0.75, 0.9999)  # nothing at the first two updates, as in theirs
        self.steps += 1
        for average, now in zip(self.model.parameters(), model.parameters(), strict=True):
            average.mul_(keep).add_(now, alpha=1 - keep)


def make_optimizer(model: nn.Module) -> torch.optim.Optimizer:
    """DP3's optimizer."""
    return torch.optim.AdamW(model.parameters(), lr=1e-4, betas=(0.95, 0.999), eps=1e-8, weight_decay=1e-6)


def make_batch(size: int, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points, state and action of a batch of noise."""
    cloud, state = torch.rand(size, FRAMES, points, 3), torch.rand(size, FRAMES, STATE)
    return 2 * cloud - 1, 2 * state - 1, 2 * torch.rand(size, HORIZON, ACTION) - 1


if __name__ == "__main__":
    model = SimpleDP3()
    print(f"{sum(p.numel() for p in model.parameters()) / 1e6:.2f} million parameters")
    ema, optimizer = Ema(model), make_optimizer(model)
    points, state, action = make_batch(128, int(sys.argv[1]) if len(sys.argv) > 1 else 1024)
    for warm in (False, True):
        start = time.process_time()
        optimizer.zero_grad()
        model.loss(points, state, action).backward()
        optimizer.step()
        ema.update(model)
        if warm:
            print(f"training step of 128 windows: {time.process_time() - start:.2f} CPU seconds")
    start = time.process_time()
    ema.model.plan(points[:1], state[:1])
    print(f"plan: {1000 * (time.process_time() - start):.0f} CPU milliseconds")
