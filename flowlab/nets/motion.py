"""What is predicted before the action: how query points, or the object, will move."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from flowlab.nets.denoiser import Conv, PointSetDenoiser, Terms, make_denoiser
from flowlab.nets.diffusion import Diffusion, NoiseSampler
from flowlab.nets.encoder import PointNet, layers
from flowlab.policies.settings import TrainSettings


@dataclass(frozen=True, slots=True)
class MotionLoss:
    """What a motion network makes of demonstrations in a training step."""

    loss: Tensor
    summary: Tensor | None
    """(W, features): what the action is conditioned on; None where it is not."""


class MotionHead(nn.Module):
    """Diffusion over a motion (W, ...) in normalized units, and a summary of it for the action."""

    def __init__(self, settings: TrainSettings, diffusion: Diffusion, clip: float) -> None:
        super().__init__()
        self.settings = settings.motion
        self.diffusion = diffusion
        self.clip = clip
        self.distance = functional.l1_loss if settings.diffusion.loss == "l1" else functional.mse_loss

    @property
    def features(self) -> int:
        """Length of what the action is conditioned on."""
        return 0 if self.settings.condition == "auxiliary" else self.settings.features

    def compute_loss(
        self, truth: Tensor, weight: Tensor, condition: Tensor, places: Tensor, draws: NoiseSampler, windows: int
    ) -> MotionLoss:
        """The loss for true motions, and the summary the action is trained with.

        ``condition`` (W, D) is the observation, ``places`` (W, M, ...) what is known of where the queries are, and
        ``windows`` the size of the whole batch, of which this process may have a part.
        """
        mode = self.settings.condition
        step = draws.steps(self.diffusion.train_steps, windows)
        if mode == "one-step":
            step = torch.full_like(step, self.diffusion.train_steps - 1)
        noise = draws.normal(windows, *truth.shape[1:])
        known = self.place_terms(places, condition)
        denoised = self.denoise(
            self.diffusion.noised(truth, noise, step), known, self.terms(condition, known, step[:, None])
        )
        loss = (self.distance(denoised, truth, reduction="none") * weight).mean()
        if mode == "auxiliary":
            return MotionLoss(loss, None)
        if mode in ("clean", "one-step"):
            seen = denoised.detach()
        else:
            seen = truth
            if mode == "truth-noised":
                seen = truth + self.settings.condition_noise * draws.normal(windows, *truth.shape[1:])
        return MotionLoss(loss, self.summarize(seen.clamp(-self.clip, self.clip), known))

    def predict(self, noise: Tensor, condition: Tensor, places: Tensor) -> tuple[Tensor, Tensor | None]:
        """The motion that an observation leads to, from noise (W, ...), and its summary."""
        known = self.place_terms(places, condition)
        mode = self.settings.condition
        if mode == "one-step":
            motion = self._at_once(noise, condition, known)
        else:
            step = torch.tensor(self.diffusion.steps, device=noise.device).expand(len(noise), -1)
            terms = self.terms(condition, known, step)

            def denoise(x: Tensor, k: int) -> Tensor:
                return self.denoise(x, known, [t[:, k : k + 1] for t in terms])

            motion = self.diffusion.sample(denoise, noise, self.clip)
        motion = motion.clamp(-self.clip, self.clip)
        return motion, None if mode == "auxiliary" else self.summarize(motion, known)

    def _at_once(self, noise: Tensor, condition: Tensor, known: Tensor) -> Tensor:
        last = torch.full((len(noise), 1), self.diffusion.train_steps - 1, device=noise.device)
        return self.denoise(noise, known, self.terms(condition, known, last)).clamp(-self.clip, self.clip)

    def place_terms(self, places: Tensor, condition: Tensor) -> Tensor:
        """What the network needs to know of the places of the queries, worked out once."""
        raise NotImplementedError

    def terms(self, condition: Tensor, known: Tensor, step: Tensor) -> Terms:
        """Modulation for steps (W, K)."""
        raise NotImplementedError

    def denoise(self, x: Tensor, known: Tensor, terms: Terms) -> Tensor:
        """The clean motion behind a noised one."""
        raise NotImplementedError

    def summarize(self, motion: Tensor, known: Tensor) -> Tensor:
        """A vector for each motion: temporal convolution, then the average over all steps (the paper's)."""
        raise NotImplementedError


class SequenceMotionHead(MotionHead):
    """One sequence (W, T, C): the object's pose (MBA), or all queries' flow as channels (3D FDP, literal reading).

    ``queries`` is their number, 0 for a pose. What is known of their places is projected, query by query, together
    with the observation, and all of it conditions the network.
    """

    _PROJECTED = 16

    def __init__(
        self, settings: TrainSettings, diffusion: Diffusion, clip: float, condition: int, channels: int, queries: int
    ) -> None:
        super().__init__(settings, diffusion, clip)
        self.project = nn.Linear(settings.motion.features + condition, self._PROJECTED) if queries else None
        whole = condition + queries * self._PROJECTED
        train_steps = settings.diffusion.train_steps
        self.network = make_denoiser(settings.motion.denoiser, settings.horizon, channels, whole, train_steps)
        if self.features:
            self.convolve = Conv(channels, self.features, 5)
            self.leave = nn.Linear(self.features, self.features)

    def place_terms(self, places: Tensor, condition: Tensor) -> Tensor:
        """See :class:`MotionHead`."""
        if self.project is None:
            return condition
        together = torch.cat([places, condition[:, None].expand(-1, places.shape[1], -1)], -1)
        return torch.cat([condition, self.project(together).flatten(1)], -1)

    def terms(self, condition: Tensor, known: Tensor, step: Tensor) -> Terms:
        """See :class:`MotionHead`."""
        return self.network.terms(known, step)

    def denoise(self, x: Tensor, known: Tensor, terms: Terms) -> Tensor:
        """See :class:`MotionHead`."""
        return self.network.denoise(x, terms)

    def summarize(self, motion: Tensor, known: Tensor) -> Tensor:
        """See :class:`MotionHead`."""
        return self.leave(functional.mish(self.convolve(motion)).mean(1))


class PointMotionHead(MotionHead):
    """Flow (W, M, 3 T) by one network for all queries, in whatever order and number they come.

    The temporal convolution of the summary is as wide as the horizon; it sees where each query is, and its results
    are averaged over the queries, beside their maximum.
    """

    def __init__(self, settings: TrainSettings, diffusion: Diffusion, clip: float, condition: int) -> None:
        super().__init__(settings, diffusion, clip)
        local, horizon = settings.motion.features, settings.horizon
        self.network = PointSetDenoiser(
            settings.motion.denoiser, horizon, local, condition, settings.diffusion.train_steps
        )
        if self.features:
            self.convolve = layers([3 * horizon + local, self.features, self.features])
            self.leave = nn.Linear(2 * self.features, self.features)

    def place_terms(self, places: Tensor, condition: Tensor) -> Tensor:
        """See :class:`MotionHead`."""
        return places

    def terms(self, condition: Tensor, known: Tensor, step: Tensor) -> Terms:
        """See :class:`MotionHead`."""
        return self.network.terms(condition, step)

    def denoise(self, x: Tensor, known: Tensor, terms: Terms) -> Tensor:
        """See :class:`MotionHead`."""
        return self.network.denoise_points(x, self.network.of_place(known), terms)

    def summarize(self, motion: Tensor, known: Tensor) -> Tensor:
        """See :class:`MotionHead`."""
        h = functional.relu(self.convolve(torch.cat([motion, known], -1)))
        return self.leave(torch.cat([h.mean(1), h.amax(1)], -1))


class QueryEncoder(nn.Module):
    """What is known of where queries are: the encoder's view of each point, and its coordinates (W, M, 3)."""

    def __init__(self, encoder: PointNet, features: int) -> None:
        super().__init__()
        self.layers = layers([encoder.point_features + 3, features, features])

    def forward(self, encoder: PointNet, xyz: Tensor) -> Tensor:
        """(W, M, 3) -> (W, M, features)."""
        return self.layers(torch.cat([encoder.of_points(xyz), xyz], -1))
