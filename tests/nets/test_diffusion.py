"""Noise is added and taken away as diffusers' DDIM does, and random numbers do not depend on who draws them."""

import math
from itertools import pairwise

import pytest
import torch
from builders import sampler
from torch import Tensor

from flowlab.nets.diffusion import Diffusion, NoiseSampler

diffusers = pytest.importorskip("diffusers")


def theirs(train_steps: int, inference_steps: int, clip: float) -> "diffusers.DDIMScheduler":
    scheduler = diffusers.DDIMScheduler(
        num_train_timesteps=train_steps,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        clip_sample=math.isfinite(clip),
        clip_sample_range=clip,
    )
    scheduler.set_timesteps(inference_steps)
    return scheduler


def denoise(x: Tensor, step: int) -> Tensor:
    """Nothing a network would do, but nonlinear, different at each step, and often beyond 1."""
    return 2.3 * torch.sin(3 * x + 0.1 * step) + 0.4 * torch.cos(x) + 0.2 * math.cos(step)


@pytest.mark.parametrize(("train_steps", "inference_steps"), [(100, 10), (100, 100), (100, 1), (50, 5), (1000, 20)])
@pytest.mark.parametrize("clip", [1.0, 2.0, math.inf])
def test_sampling_is_that_of_diffusers_step_by_step(train_steps: int, inference_steps: int, clip: float) -> None:
    scheduler, diffusion = theirs(train_steps, inference_steps, clip), Diffusion(train_steps, inference_steps)
    assert diffusion.steps == tuple(scheduler.timesteps.tolist())
    seen: list[Tensor] = []

    def noted(x: Tensor, k: int) -> Tensor:
        seen.append(x)
        return denoise(x, diffusion.steps[k])

    noise = torch.randn(7, 5, 3, generator=torch.Generator().manual_seed(0))
    seen.append(diffusion.sample(noted, noise, clip))
    assert torch.equal(seen[0], noise)
    beyond = 0
    for (x, after), step in zip(pairwise(seen), diffusion.steps, strict=True):
        clean = denoise(x, step)
        beyond += int((clean.abs() > min(clip, 2)).sum())
        # Step by step, since such a denoiser makes much of the least difference.
        torch.testing.assert_close(after, scheduler.step(clean, step, x).prev_sample)
    assert beyond > 10, "nothing to clip"


def test_noise_is_added_as_diffusers_does() -> None:
    diffusion, scheduler = Diffusion(100, 10), theirs(100, 10, 1.0)
    torch.testing.assert_close(diffusion.alphas_cumprod, scheduler.alphas_cumprod)
    clean, noise, step = torch.randn(100, 4, 3), torch.randn(100, 4, 3), torch.arange(100)
    wanted = scheduler.add_noise(clean, noise, step)
    torch.testing.assert_close(diffusion.noised(clean, noise, step), wanted)
    together = diffusion.noised(*(x.view(20, 5, 4, 3) for x in (clean, noise)), step.view(20, 5))
    torch.testing.assert_close(together.flatten(0, 1), wanted)


def test_who_knows_the_truth_gets_there() -> None:
    truth = torch.rand(5, 8, 3) * 2 - 1
    for inference_steps in (1, 10):
        found = Diffusion(100, inference_steps).sample(lambda x, k: truth, torch.randn(5, 8, 3), 1.0)
        torch.testing.assert_close(found, truth)


@pytest.mark.parametrize("parts", [1, 2, 4])
def test_parts_of_a_batch_get_what_the_whole_gets(parts: int) -> None:
    """However many processes share 8 windows, after any number of draws."""

    def drawn(d: NoiseSampler) -> tuple[Tensor, ...]:
        return d.steps(100, 8, 3), d.normal(8, 5, 2), d.steps(7, 8), d.normal(8)

    whole = drawn(sampler())
    size = 8 // parts
    pieces = [drawn(sampler(part=slice(k * size, (k + 1) * size))) for k in range(parts)]
    for k, numbers in enumerate(whole):
        assert all(len(p[k]) == size for p in pieces)
        assert torch.equal(torch.cat([p[k] for p in pieces]), numbers)


def test_draws_are_a_function_of_the_seed() -> None:
    torch.manual_seed(1)
    first = sampler(3).normal(4, 2)
    torch.manual_seed(2)
    assert torch.equal(sampler(3).normal(4, 2), first)
    assert not torch.equal(sampler(4).normal(4, 2), first)
    again = sampler(3)
    again.normal(4, 2)
    assert not torch.equal(again.normal(4, 2), first), "a second draw repeats the first"


def test_numbers_drawn_are_distributed_as_they_should_be() -> None:
    steps, normal = sampler().steps(20, 10_000, 4), sampler().normal(10_000, 4)
    assert steps.shape == normal.shape == (10_000, 4)
    share = torch.bincount(steps.flatten(), minlength=20) / steps.numel()
    assert len(share) == 20
    assert (share - 0.05).abs().max() < 0.005
    assert abs(float(normal.mean())) < 0.02
    assert abs(float(normal.std()) - 1) < 0.02
