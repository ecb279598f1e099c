import pytest
import torch

from kinetok.config import ConfigError, from_dict, to_dict
from kinetok.tokenizers import (
    FSQ,
    QUANTIZERS,
    Continuous,
    ContinuousConfig,
    FSQConfig,
    QuantizerConfig,
    build_quantizer,
)


def test_continuous_is_the_identity_and_has_no_codes():
    z = torch.randn(3, 5, requires_grad=True)
    out = Continuous(dim=5)(z)
    assert torch.equal(out.values, z)
    assert out.codes.shape == (3, 0) and out.codes.dtype == torch.int64
    assert out.loss.item() == 0.0 and out.metrics == {}
    (gradient,) = torch.autograd.grad(out.values.sum(), z)
    assert torch.equal(gradient, torch.ones_like(z))


def test_build_quantizer_picks_by_kind():
    continuous = build_quantizer(ContinuousConfig(dim=7))
    assert isinstance(continuous, Continuous) and (continuous.dim_in, continuous.levels) == (7, ())
    fsq = build_quantizer(FSQConfig(dim=4, levels=5, bound="mentzer"))
    assert isinstance(fsq, FSQ) and (fsq.dim_in, fsq.dim_out, fsq.levels) == (4, 4, (5, 5, 5, 5))


@pytest.mark.parametrize("kind", QUANTIZERS)
def test_configs_round_trip_and_carry_their_kind(kind):
    config_class, quantizer_class = QUANTIZERS[kind]
    config: QuantizerConfig = config_class()
    assert config.kind == kind
    assert from_dict(config_class, to_dict(config)) == config
    assert isinstance(build_quantizer(config), quantizer_class)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: Continuous(dim=0), ValueError, "dim >= 1, not 0"),
        (lambda: Continuous(dim=4)(torch.zeros(2, 3)), ValueError, r"shape \(2, 3\).*must be 4"),
        (lambda: Continuous(dim=4).encode(torch.zeros(2, 4)), ValueError, "no tokens: use forward.*fsq"),
        (lambda: Continuous(dim=4).decode(torch.zeros(2, 4).long()), ValueError, "no tokens"),
        (lambda: FSQ(dim=4, levels=1), ValueError, r"levels in 2\.\.1000, not 1"),
        (lambda: FSQ(dim=4, bound="gcp"), ConfigError, "unknown FSQ bound 'gcp'.*gpc"),  # pyright: ignore
        (lambda: FSQ(dim=4)(torch.zeros(2, 5)), ValueError, "last dimension must be 4"),
        (lambda: FSQ(dim=2, levels=3).decode(torch.tensor([[0, 3]])), ValueError, r"0\.\.2; found 3"),
        (lambda: FSQ(dim=2, levels=3).decode(torch.tensor([[0, -1]])), ValueError, r"0\.\.2; found -1"),
        (lambda: FSQ(dim=2, levels=3).decode(torch.zeros(1, 2)), ValueError, r"integers, not torch\.float32"),
    ],
)
def test_messages(call, error, message):
    with pytest.raises(error, match=message):
        call()
