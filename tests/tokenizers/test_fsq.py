import math

import pytest
import torch

from kinetok.tokenizers import FSQ

LEVELS = (2, 3, 4, 5, 8, 9, 16)
BOUNDS = ("gpc", "mentzer")
kinds = pytest.mark.parametrize(("levels", "bound"), [(levels, bound) for levels in LEVELS for bound in BOUNDS])


def grid(dim: int = 1) -> torch.Tensor:
    """Latents (20001, dim) from -8 to 8."""
    return torch.linspace(-8, 8, 20001)[:, None].expand(-1, dim)


@kinds
def test_exactly_the_levels_occur_and_every_one_is_reached(levels, bound):
    out = FSQ(dim=2, levels=levels, bound=bound)(grid(2))
    assert out.codes.unique().tolist() == list(range(levels))
    assert out.codes.diff(dim=0).min() >= 0
    assert out.values.min() == -1.0 and out.values.max() <= 1.0


@kinds
def test_extreme_latents_stay_in_range(levels, bound):
    codes = FSQ(dim=1, levels=levels, bound=bound).encode(torch.tensor([[-1e30], [1e30]]))
    assert codes.tolist() == [[0], [levels - 1]]


@kinds
def test_decode_of_encode_is_what_forward_gave(levels, bound):
    fsq = FSQ(dim=1, levels=levels, bound=bound)
    out = fsq(grid())
    assert torch.equal(fsq.encode(grid()), out.codes)
    assert torch.equal(fsq.decode(out.codes), out.values)


@kinds
def test_every_code_is_a_fixed_point_of_decode_then_encode(levels, bound):
    """A latent that is bounded to the level of code k gives code k again."""
    fsq = FSQ(dim=1, levels=levels, bound=bound)
    codes = torch.arange(levels)[:, None]
    level = fsq.decode(codes).double() * (levels // 2)
    # Invert the bound: atanh of the level (drawn in a little, the outermost are limits) in the range of tanh.
    unit = ((level + fsq._offset) / fsq._width).clamp(-1 + 1e-6, 1 - 1e-6)
    assert torch.equal(fsq.encode(torch.atanh(unit) - fsq._shift), codes)


def test_by_hand_odd():
    # L = 9: h = 4. tanh(0.5) = 0.4621 -> 4 * 0.4621 = 1.8485 -> level 2 -> value 2/4, code 2 + 4
    # tanh(-0.3) = -0.2913 -> -1.1652 -> level -1 -> value -1/4, code 3
    # tanh(3) = 0.9951 -> 3.9802 -> level 4 -> value 1, code 8
    out = FSQ(dim=3, levels=9)(torch.tensor([[0.5, -0.3, 3.0]]))
    assert out.values.tolist() == [[0.5, -0.25, 1.0]]
    assert out.codes.tolist() == [[6, 3, 8]]
    # rounding: (|1.8485 - 2| + |-1.1652 + 1| + |3.9802 - 4|) / 3 = (0.1515 + 0.1652 + 0.0198) / 3
    assert out.metrics["rounding"].item() == pytest.approx(0.1122, abs=1e-4)
    assert out.metrics["saturation"].item() == pytest.approx(1 / 3)
    assert out.loss.item() == 0.0


def test_by_hand_even():
    # L = 4, h = 2, gpc: 1.5 tanh(z) - 0.5
    #   0.0 -> -0.5 -> level 0 (half to even) -> value 0, code 2
    #   0.4 -> 1.5 * 0.3799 - 0.5 = 0.0699 -> level 0
    #   2.0 -> 0.9460 -> level 1 -> value 1/2, code 3
    #  -0.5 -> -1.1932 -> level -1 -> value -1/2, code 1
    #  -2.0 -> -1.9460 -> level -2 -> value -1, code 0
    out = FSQ(dim=5, levels=4)(torch.tensor([[0.0, 0.4, 2.0, -0.5, -2.0]]))
    assert out.codes.tolist() == [[2, 2, 3, 1, 0]]
    assert out.values.tolist() == [[0.0, 0.0, 0.5, -0.5, -1.0]]


def test_mentzer_centres_even_levels():
    fsq = FSQ(dim=1, levels=8, bound="mentzer")
    assert fsq.bound(torch.zeros(1, 1)).item() == pytest.approx(0.0, abs=1e-6)
    assert fsq._shift == pytest.approx(math.atanh(0.5 / (3.5 * 1.001)))


@kinds
def test_straight_through_gradient_is_that_of_the_bounded_value(levels, bound):
    fsq = FSQ(dim=6, levels=levels, bound=bound)
    z = torch.randn(32, 6, generator=torch.Generator().manual_seed(0)).requires_grad_()
    weight = torch.randn(32, 6, generator=torch.Generator().manual_seed(1))
    (got,) = torch.autograd.grad((fsq(z).values * weight).sum(), z)
    (expected,) = torch.autograd.grad((fsq.bound(z) / (levels // 2) * weight).sum(), z)
    torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("levels", [level for level in LEVELS if level > 2])  # the oracle refuses L = 2
def test_mentzer_agrees_with_vector_quantize_pytorch(levels):
    oracle_module = pytest.importorskip("vector_quantize_pytorch")
    oracle = oracle_module.FSQ(levels=[levels] * 4, preserve_symmetry=False)
    z = 2 * torch.randn(5, 50, 4, generator=torch.Generator().manual_seed(0))
    values, index = oracle(z)
    ours = FSQ(dim=4, levels=levels, bound="mentzer")(z)
    torch.testing.assert_close(ours.values, values)
    # The oracle's index has its first scalar least significant.
    torch.testing.assert_close((ours.codes * levels ** torch.arange(4)).sum(-1), index.long())


def test_a_latent_of_unit_size_keeps_its_gradient_however_large_it_is():
    z = torch.randn(64, 12, generator=torch.Generator().manual_seed(0)) * 50
    flat, kept = z.clone().requires_grad_(), z.clone().requires_grad_()
    saturated, spread = FSQ(dim=12)(flat), FSQ(dim=12, unit=True)(kept)
    assert saturated.metrics["saturation"] > 0.9 and spread.metrics["saturation"] < 0.3
    for values in (saturated.values, spread.values):
        values.pow(2).sum().backward()
    # How many scalars would move by a step of the latent's own size along its straight-through gradient.
    moved = [float((50 * x.grad.abs() > 1e-2).float().mean()) for x in (flat, kept)]
    assert moved[0] < 0.1 and moved[1] > 0.8
    assert torch.equal(spread.codes, FSQ(dim=12, unit=True)(z / 1000).codes)
