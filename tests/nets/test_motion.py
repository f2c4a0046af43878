"""What is predicted before the action: what it learns from, and what the action gets to know of it."""

from typing import Any

import pytest
import torch
from builders import sampler, tiny_settings
from torch import Tensor
from torch.nn import functional

from flowlab.nets.diffusion import Diffusion
from flowlab.nets.encoder import PointNet
from flowlab.nets.motion import (
    ChannelFlowHead,
    MotionHead,
    PerQueryFlowHead,
    PoseHead,
    QueryEncoder,
    SequenceMotionHead,
)

HORIZON, M, CONDITION, FEATURES, STEPS, CLIP = 8, 6, 5, 8, 100, 1.5
LAYOUTS = ("channels", "per-query", "pose")
CONDITIONS = ("clean", "one-step", "truth", "truth-noised", "auxiliary")
SHAPE = {"channels": (HORIZON, 3 * M), "per-query": (M, 3 * HORIZON), "pose": (HORIZON, 9)}


def make(layout: str, condition: str = "clean", *overrides: str) -> MotionHead:
    conditions = f"motion.condition='{condition}'", "motion.condition_noise=0.3", f"diffusion.train_steps={STEPS}"
    s = tiny_settings("fdp", *conditions, *overrides)
    diffusion = Diffusion(STEPS, 5, s.diffusion.loss)
    torch.manual_seed(0)
    if layout == "per-query":
        return PerQueryFlowHead(s.motion, diffusion, CLIP, HORIZON, CONDITION)
    if layout == "channels":
        return ChannelFlowHead(s.motion, diffusion, CLIP, HORIZON, CONDITION, M)
    return PoseHead(s.motion, diffusion, CLIP, HORIZON, CONDITION)


def inputs(layout: str, windows: int = 4) -> dict[str, Tensor]:
    """The arguments of ``compute_loss``: some of the truth lies beyond the clip."""
    random = torch.Generator().manual_seed(1)
    shape = (0, 3) if layout == "pose" else (M, FEATURES)
    return {
        "target": torch.randn(windows, *SHAPE[layout], generator=random),
        "weight": torch.rand(windows, *SHAPE[layout], generator=random),
        "condition": torch.randn(windows, CONDITION, generator=random),
        "queries": torch.randn(windows, *shape, generator=random),
    }


def learn(motion: MotionHead, given: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
    learned = motion.compute_loss(**given, noise=sampler(), windows=len(given["target"]))
    return learned.loss, learned.summary


def drawn(layout: str, windows: int = 4) -> tuple[Tensor, Tensor, Tensor]:
    """Steps, noise, and further noise, as ``compute_loss`` draws them."""
    d = sampler()
    return d.steps(STEPS, windows), d.normal(windows, *SHAPE[layout]), d.normal(windows, *SHAPE[layout])


def denoise(motion: MotionHead, x: Tensor, given: dict[str, Tensor], step: Tensor) -> Tensor:
    known = motion.query_terms(given["queries"], given["condition"])
    return motion.denoise(x, known, motion.terms(given["condition"], known, step[:, None]))


def summarize(motion: MotionHead, x: Tensor, given: dict[str, Tensor]) -> Tensor:
    return motion.summarize(x, motion.query_terms(given["queries"], given["condition"]))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("loss", ["l1", "mse"])
def test_the_loss_is_the_weighted_distance_to_the_clean_motion(layout: str, loss: str) -> None:
    motion, given = make(layout, "clean", f"diffusion.loss={loss}"), inputs(layout)
    step, noise, _ = drawn(layout)
    kept = motion.diffusion.alphas_cumprod[step].view(-1, 1, 1)
    away = denoise(motion, kept.sqrt() * given["target"] + (1 - kept).sqrt() * noise, given, step) - given["target"]
    distance = away.abs() if loss == "l1" else away.square()
    torch.testing.assert_close(learn(motion, given)[0], (distance * given["weight"]).mean())


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("condition", CONDITIONS)
def test_what_has_no_weight_gives_no_gradient(layout: str, condition: str, monkeypatch: pytest.MonkeyPatch) -> None:
    motion, given = make(layout, condition), inputs(layout)
    masked = torch.rand(given["weight"].shape) < 0.5
    given["weight"] = given["weight"].masked_fill(masked, 0)
    prediction = torch.zeros_like(given["target"], requires_grad=True)
    monkeypatch.setattr(motion, "denoise", lambda x, known, terms: prediction)
    (gradient,) = torch.autograd.grad(learn(motion, given)[0], prediction)
    assert (gradient[masked] == 0).all()
    assert (gradient[~masked] != 0).all()


def reached(output: Tensor, **inputs: Any) -> set[str]:
    """Which of the inputs, tensors or modules, a gradient of the output reaches."""
    found = set()
    for name, target in inputs.items():
        tensors = [target] if isinstance(target, Tensor) else list(target.parameters())
        given = torch.autograd.grad(output.square().sum(), tensors, retain_graph=True, allow_unused=True)
        if any(g is not None and g.abs().max() > 0 for g in given):
            found.add(name)
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_action_does_not_teach_the_motion(layout: str, condition: str) -> None:
    """What conditions the action is taken as it is; only its summary learns from the action."""
    motion, given = make(layout, condition), inputs(layout)
    for x in (given["queries"], given["condition"]):
        x.requires_grad_()
    loss, summary = learn(motion, given)
    parts = {"network": motion.network, "queries": given["queries"], "condition": given["condition"]}
    if layout == "pose":
        del parts["queries"]
    assert reached(loss, **parts) == parts.keys()
    if condition == "auxiliary":
        assert summary is None
        assert not hasattr(motion, "summary_layer"), "weights that nothing uses"
        return
    assert summary is not None
    assert summary.shape == (4, FEATURES)
    by_summary = reached(summary, **parts, summary_layer=motion.summary_layer, summary_output=motion.summary_output)
    # A query's place is an input of the per-query summary itself.
    assert by_summary == {"summary_layer", "summary_output"} | ({"queries"} if layout == "per-query" else set())
    assert reached(loss, summary_layer=motion.summary_layer, summary_output=motion.summary_output) == set()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_clean_sees_what_the_network_makes_of_the_noised_motion(layout: str) -> None:
    motion, given = make(layout, "clean"), inputs(layout)
    step, noise, _ = drawn(layout)
    seen = denoise(motion, motion.diffusion.noised(given["target"], noise, step), given, step)
    motion.clip = 0.3
    assert seen.abs().max() > motion.clip
    wanted = summarize(motion, seen.clamp(-0.3, 0.3), given)
    torch.testing.assert_close(learn(motion, given)[1], wanted)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_step_sees_in_use_what_it_sees_in_training(layout: str) -> None:
    """What the network makes of noise at the last step of diffusion, in which next to nothing is left of the truth."""
    motion, given = make(layout, "one-step"), inputs(layout)
    motion.clip = 0.3
    noise = drawn(layout)[1]
    guess = denoise(motion, noise, given, torch.full((4,), STEPS - 1))
    assert guess.abs().max() > 0.3
    predicted, summary = motion.predict(noise, given["condition"], given["queries"])
    torch.testing.assert_close(predicted, guess.clamp(-0.3, 0.3))
    torch.testing.assert_close(summary, summarize(motion, predicted, given))
    loss, in_training = learn(motion, given)
    almost = {"rtol": 1e-2, "atol": 1e-3}
    torch.testing.assert_close(in_training, summary, **almost)
    torch.testing.assert_close(loss, ((guess - given["target"]).abs() * given["weight"]).mean(), **almost)
    torch.testing.assert_close(learn(motion, given | {"target": -given["target"]})[1], summary, **almost)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_truth_sees_the_demonstrated_motion(layout: str) -> None:
    motion, given = make(layout, "truth"), inputs(layout)
    assert given["target"].abs().max() > CLIP
    torch.testing.assert_close(learn(motion, given)[1], summarize(motion, given["target"].clamp(-CLIP, CLIP), given))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_truth_noised_sees_it_with_noise(layout: str) -> None:
    motion, given = make(layout, "truth-noised"), inputs(layout)
    noised = given["target"] + 0.3 * drawn(layout)[2]
    torch.testing.assert_close(learn(motion, given)[1], summarize(motion, noised.clamp(-CLIP, CLIP), given))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("condition", CONDITIONS)
def test_in_use_the_motion_is_sampled_and_summarized(layout: str, condition: str) -> None:
    motion, given = make(layout, condition), inputs(layout)
    motion.clip = 0.2
    noise = torch.randn(4, *SHAPE[layout])
    predicted, summary = motion.predict(noise, given["condition"], given["queries"])
    assert predicted.shape == noise.shape
    assert predicted.abs().max() <= 0.2
    if condition != "one-step":
        steps = motion.diffusion.steps
        wanted = motion.diffusion.sample(
            lambda x, k: denoise(motion, x, given, torch.full((4,), steps[k])), noise, motion.clip
        )
        torch.testing.assert_close(predicted, wanted.clamp(-0.2, 0.2))
    assert (summary is None) == (condition == "auxiliary")
    assert motion.features == (0 if summary is None else FEATURES)
    if summary is not None:
        torch.testing.assert_close(summary, summarize(motion, predicted, given))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_motion_that_the_observation_decides_is_learned(layout: str) -> None:
    motion, given = make(layout), inputs(layout, windows=3)
    given["target"] = given["target"].clamp(-1, 1)
    given["condition"] = 2 * torch.eye(3, CONDITION)
    given["weight"] = torch.ones_like(given["weight"])
    optimizer = torch.optim.Adam(motion.parameters(), 5e-3)
    d, losses = sampler(), []
    for _ in range(250):
        loss = motion.compute_loss(**given, noise=d, windows=3).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-10:]) / 10 < 0.35 * losses[0]
    with torch.no_grad():
        found, _ = motion.predict(torch.randn_like(given["target"]), given["condition"], given["queries"])
    assert (found - given["target"]).abs().mean() < 0.35 * given["target"].abs().mean()


@pytest.mark.parametrize("layout", ["channels", "pose"])
def test_a_sequence_is_summarized_by_convolution_and_the_mean_over_its_steps(layout: str) -> None:
    motion, given = make(layout), inputs(layout)
    outputs, _ = motion.summary_layer.linear.weight.shape
    weight = motion.summary_layer.linear.weight.view(outputs, 5, -1).transpose(1, 2)
    h = functional.conv1d(given["target"].transpose(1, 2), weight, motion.summary_layer.linear.bias, padding=2)
    torch.testing.assert_close(
        summarize(motion, given["target"], given), motion.summary_output(functional.mish(h).mean(2))
    )


def test_the_places_of_queries_reach_the_network_of_channels_each_at_its_own_entry() -> None:
    motion, given = make("channels"), inputs("channels")
    assert isinstance(motion, SequenceMotionHead)
    assert motion.query_projection is not None
    known = motion.query_terms(given["queries"], given["condition"])
    torch.testing.assert_close(known[:, :CONDITION], given["condition"])
    for m in range(M):
        wanted = motion.query_projection(torch.cat([given["queries"][:, m], given["condition"]], -1))
        torch.testing.assert_close(known[:, CONDITION:].view(4, M, -1)[:, m], wanted)


def test_the_order_and_number_of_queries_are_free_per_query() -> None:
    motion, given = make("per-query"), inputs("per-query")
    noise, order = torch.randn_like(given["target"]), torch.randperm(M)
    predicted, summary = motion.predict(noise, given["condition"], given["queries"])
    shuffled, same = motion.predict(noise[:, order], given["condition"], given["queries"][:, order])
    torch.testing.assert_close(shuffled, predicted[:, order], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(same, summary, rtol=1e-4, atol=1e-5)
    many, _ = motion.predict(torch.randn(4, 3 * M, 3 * HORIZON), given["condition"], given["queries"].repeat(1, 3, 1))
    assert many.shape == (4, 3 * M, 3 * HORIZON)


def test_a_place_is_what_the_encoder_sees_there_and_its_coordinates() -> None:
    torch.manual_seed(0)
    encoder = PointNet((16, 16), 8, 1)
    places, xyz = QueryEncoder(encoder, FEATURES), torch.randn(4, M, 3)
    found = places(encoder, xyz)
    assert found.shape == (4, M, FEATURES)
    first, _, last = places.layers
    seen = torch.cat([encoder.encode_points(xyz[2, 3]), xyz[2, 3]])
    torch.testing.assert_close(found[2, 3], last(functional.relu(first(seen))))
    assert reached(found, encoder=encoder, queries=places) == {"encoder", "queries"}
