"""The PointNet is what a plain one is, for a fraction of the work."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples
from torch import Tensor, nn

from flowlab.nets import max_pooling
from flowlab.nets.encoder import PointNet, linear_layers


class Plain(nn.Module):
    """A PointNet as one would write it down: every point through every layer, then the maximum."""

    def __init__(self, theirs: PointNet) -> None:
        super().__init__()
        parts: list[nn.Module] = []
        for linear in theirs.layers:
            i, o = linear.in_features, linear.out_features
            parts += [nn.Linear(i, o), nn.LayerNorm(o), nn.ReLU()]
        self.octaves, self.of_point = theirs.octaves, nn.Sequential(*parts)
        self.project = nn.Linear(theirs.project.in_features, theirs.project.out_features)
        self.norm = nn.LayerNorm(theirs.project.out_features)
        mine = [m for m in [*self.of_point, self.project, self.norm] if not isinstance(m, nn.ReLU)]
        originals = [m for pair in zip(theirs.layers, theirs.norms, strict=True) for m in pair]
        self.twins = list(zip(mine, [*originals, theirs.project, theirs.norm], strict=True))
        self.to(theirs.norm.weight.dtype)
        for copy, original in self.twins:
            copy.load_state_dict(original.state_dict())

    def forward(self, points: Tensor) -> Tensor:
        seen = [points]
        for k in range(self.octaves):
            seen += [torch.sin(2**k * math.pi * points), torch.cos(2**k * math.pi * points)]
        return self.norm(self.project(self.of_point(torch.cat(seen, -1)).max(1).values))


def make_net(widths: tuple[int, ...] = (16, 24), octaves: int = 2, features: int = 8) -> PointNet:
    """A network in double precision, with no weight left at a value that hides mistakes."""
    torch.manual_seed(0)
    net = PointNet(widths, features, octaves).double()
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.2 * torch.randn_like(p))
    return net


@settings(max_examples=examples(40), deadline=None, derandomize=True)
@given(
    clouds=st.integers(1, 5),
    size=st.integers(1, 40),
    repeated=st.integers(0, 10),
    widths=st.lists(st.integers(2, 24), min_size=1, max_size=3),
    octaves=st.integers(0, 3),
    at_once=st.sampled_from([1, 16, 64, 4096]),
    block=st.sampled_from([1, 4, 7, 32]),
)
def test_values_and_gradients_are_those_of_a_plain_pointnet(
    clouds: int, size: int, repeated: int, widths: list[int], octaves: int, at_once: int, block: int
) -> None:
    net = make_net(tuple(widths), octaves)
    plain = Plain(net)
    points = torch.randn(clouds, size, 3, dtype=torch.float64)
    points = torch.cat([points, points[:, torch.arange(repeated) % size]], 1)  # clouds are filled up like this
    mine_of, theirs_of = points.clone().requires_grad_(), points.clone().requires_grad_()
    wanted = torch.randn(clouds, 8, dtype=torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(max_pooling, "_AT_ONCE", at_once)
        patch.setattr(max_pooling, "_BLOCK", block)
        mine = net(mine_of)
        with torch.no_grad():
            torch.testing.assert_close(net(points), mine)
    theirs = plain(theirs_of)
    torch.testing.assert_close(mine, theirs)
    (mine * wanted).sum().backward()
    (theirs * wanted).sum().backward()
    for copy, original in plain.twins:
        torch.testing.assert_close(original.weight.grad, copy.weight.grad)
        torch.testing.assert_close(original.bias.grad, copy.bias.grad)
    torch.testing.assert_close(_of_places(mine_of), _of_places(theirs_of))


def _of_places(points: Tensor) -> Tensor:
    """The gradient of every place (B, N, 3): of points at one place any may have it."""
    assert points.grad is not None
    same = (points[:, :, None] == points[:, None]).all(-1)
    return same.to(points.dtype) @ points.grad


@pytest.mark.parametrize("frozen", ["layers.0", "norms.0", "layers.1", "norms"])
def test_what_is_frozen_stays_and_the_rest_learns_as_before(frozen: str) -> None:
    whole, part = make_net(), make_net()
    part.get_submodule(frozen).requires_grad_(False)
    points = torch.randn(3, 20, 3, dtype=torch.float64)
    for net in (whole, part):
        net(points).square().sum().backward()
    for (name, a), b in zip(whole.named_parameters(), part.parameters(), strict=True):
        if name.startswith(frozen):
            assert b.grad is None
        else:
            torch.testing.assert_close(a.grad, b.grad)


def test_only_points_that_matter_go_through_with_a_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    net = make_net((8, 4))
    rows: list[tuple[int, bool]] = []
    before_last = net._before_last

    def counted(xyz: Tensor) -> Tensor:
        rows.append((xyz[..., 0].numel(), torch.is_grad_enabled()))
        return before_last(xyz)

    monkeypatch.setattr(net, "_before_last", counted)
    monkeypatch.setattr(max_pooling, "_ROWS", 4)  # of which the number of points is made a multiple
    net(torch.randn(3, 200, 3, dtype=torch.float64)).sum().backward()
    assert sum(n for n, with_gradient in rows if not with_gradient) == 600
    assert sum(n for n, with_gradient in rows if with_gradient) <= 3 * 4
    rows.clear()
    with torch.no_grad():
        net(torch.randn(3, 200, 3, dtype=torch.float64))
    assert sum(n for n, _ in rows) == 600, "without a gradient once is enough"


def test_the_order_and_repetition_encode_points_do_not_matter() -> None:
    net = make_net()
    points = torch.randn(2, 30, 3, dtype=torch.float64)
    shuffled = points[:, torch.randperm(30)]
    torch.testing.assert_close(net(shuffled), net(points))
    torch.testing.assert_close(net(torch.cat([points, points[:, :7]], 1)), net(points))
    assert not torch.allclose(net(points[:, :3]), net(points)), "points do not matter at all"


def test_a_point_has_the_same_vector_wherever_it_is_asked_for() -> None:
    net = make_net()
    points = torch.randn(2, 5, 3, dtype=torch.float64)
    encode_points = net.encode_points(points)
    assert encode_points.shape == (2, 5, net.point_width)
    torch.testing.assert_close(net.encode_points(points[1, 3]), encode_points[1, 3])
    torch.testing.assert_close(net.norm(net.project(encode_points.amax(1))), net(points))


def test_fourier_features_are_sines_and_cosines_of_doubling_frequency() -> None:
    xyz = torch.tensor([[0.25, -0.5, 1.0 / 3]], dtype=torch.float64)
    net = PointNet((8,), 4, octaves=3)
    assert net.layers[0].in_features == 21
    found = net._fourier(xyz)[0].tolist()
    wanted = xyz[0].tolist()
    for frequency in (0.5, 1, 2):  # periods of 2, 1 and 1/2
        for wave in (math.sin, math.cos):
            wanted += [wave(2 * math.pi * frequency * c) for c in xyz[0].tolist()]
    assert found == pytest.approx(wanted)
    assert PointNet((8,), 4, octaves=0)._fourier(xyz) is xyz


def test_weights_learn_in_half_precision_too() -> None:
    """Under autocast, casts of weights are cached: one made where no gradient is wanted must not be used again."""
    net = make_net().float()
    with torch.autocast("cpu", torch.bfloat16):
        vector = net(torch.randn(3, 20, 3))
    (vector * torch.randn(3, 8)).sum().backward()
    for name, p in net.named_parameters():
        assert p.grad is not None, name
        assert p.grad.abs().max() > 0, name


def test_layers_have_relu_between_them_and_none_behind() -> None:
    net = linear_layers([3, 5, 2])
    assert [type(m) for m in net] == [nn.Linear, nn.ReLU, nn.Linear]
    first, _, last = net
    x = torch.randn(4, 3)
    torch.testing.assert_close(net(x), (x @ first.weight.T + first.bias).clamp(min=0) @ last.weight.T + last.bias)


def test_a_network_whose_points_are_all_cut_off_learns_nothing_from_them() -> None:
    net = make_net()
    with torch.no_grad():
        net.norms[-1].bias.fill_(-100)
    net(torch.randn(3, 20, 3, dtype=torch.float64)).square().sum().backward()
    for module in (*net.layers, *net.norms):
        for p in module.parameters():
            assert p.grad is not None
            assert not p.grad.any(), "what the last ReLU takes away came back"
    assert net.project.bias.grad is not None
    assert net.project.bias.grad.any()
