"""lora.py, dora.py, cola.py by hand; inject.py: targets, and a model that stays as it was."""

import pytest
import torch
from torch import Tensor, nn

from kinetok.adapters import CoLAConfig, DoRAConfig, LoRAConfig
from kinetok.adapters.cola import CoLALinear, Film
from kinetok.adapters.dora import DoRALinear
from kinetok.adapters.inject import Condition, match, replaced
from kinetok.adapters.lora import LoRALinear
from kinetok.config import ConfigError
from tests.adapters.bending import build


def linear(weight: list[list[float]], bias: list[float]) -> nn.Linear:
    layer = nn.Linear(len(weight[0]), len(weight))
    layer.load_state_dict({"weight": torch.tensor(weight), "bias": torch.tensor(bias)})
    return layer.requires_grad_(False)


def low_rank_(layer: LoRALinear | CoLALinear, a: list[list[float]], b: list[list[float]]) -> None:
    layer.lora_A.weight.data, layer.lora_B.weight.data = torch.tensor(a), torch.tensor(b)


def close(found: Tensor, expected: list) -> None:
    torch.testing.assert_close(found.detach(), torch.tensor(expected))


def test_lora_by_hand():
    layer = LoRALinear(linear([[1.0, 0.0], [0.0, 1.0]], [0.5, 0.0]), rank=1, alpha=2.0)
    low_rank_(layer, [[1.0, -1.0]], [[4.0], [3.0]])
    # A x = 3 - 4 = -1, B A x = (-4, -3), alpha / r = 2: (3 + .5 - 8, 4 - 6).
    close(layer(torch.tensor([[3.0, 4.0]])), [[-4.5, -2.0]])
    close(layer.merged()(torch.tensor([[3.0, 4.0]])), [[-4.5, -2.0]])


def test_dora_by_hand():
    layer = DoRALinear(linear([[3.0, 4.0], [0.0, 2.0]], [1.0, 0.0]), rank=1, alpha=3.0)
    close(layer.lora_magnitude_vector, [5.0, 2.0])  # the norms of the rows
    low_rank_(layer, [[1.0, 0.0]], [[-1.0], [0.0]])
    layer.lora_magnitude_vector.data = torch.tensor([10.0, 6.0])
    # V = ((3 - 3, 4), (0, 2)), of norms 4 and 2; W = ((0, 10), (0, 6)); x = (1, 2) gives (20 + 1, 12).
    close(layer(torch.tensor([[1.0, 2.0]])), [[21.0, 12.0]])
    close(layer.merged()(torch.tensor([[1.0, 2.0]])), [[21.0, 12.0]])


def test_the_norm_of_dora_is_a_constant_in_the_gradient():
    layer = DoRALinear(linear([[3.0, 4.0]], [0.0]), rank=1, alpha=1.0)
    low_rank_(layer, [[1.0, 0.0]], [[0.0]])
    layer(torch.tensor([[2.0, 7.0]])).sum().backward()
    # y = m / ||V|| (W0 + B A) x with m / ||V|| = 1: dy/dB = A x = 2; with the norm's own gradient it would be
    # 2 - (W0 x) (W0 A^T) / ||W0||^2 = 2 - 34 * 3 / 25.
    close(layer.lora_B.weight.grad, [[2.0]])  # type: ignore[arg-type]


def test_cola_by_hand():
    condition = Condition()
    layer = CoLALinear(
        linear([[1.0, 0.0], [0.0, 1.0]], [0.0, 0.0]), rank=1, alpha=2.0, condition=condition, name="here"
    )
    low_rank_(layer, [[1.0, -1.0]], [[4.0], [3.0]])
    layer.magnitude.data = torch.tensor([1.0, -1.0])
    condition.film = {"here": (torch.tensor([[2.0], [0.0]]), torch.tensor([[5.0], [-1.0]]))}
    # Row 0: A x = -1, gamma A x + beta = 3, u = (12, 9), ||u|| = 15, rms = 15 / sqrt(2), u / rms = (.8, .6) sqrt(2);
    # times alpha / r = 2 and m: (1.6, -1.2) sqrt(2). Row 1: gamma = 0, beta = -1, so u / rms = -(.8, .6) sqrt(2).
    x, root = torch.tensor([[3.0, 4.0], [3.0, 4.0]]), 2**0.5
    expected = [[3 + 1.6 * root, 4 - 1.2 * root], [3 - 1.6 * root, 4 + 1.2 * root]]
    close(layer(x), expected)
    close(layer(x[:, None, None].expand(2, 3, 2, 2))[:, 2, 1], expected)  # rows go with rows, whatever is between
    with pytest.raises(ValueError, match=r"cannot be merged into one weight: the norm in eq\. 7"):
        layer.merged()
    condition.clear()
    with pytest.raises(ValueError, match="the condition is not set"):
        layer(x)


def test_film_starts_as_identity():
    film = Film(cond_dim=2, hidden=4, rank=3, names=["a", "b"])
    assert film(torch.randn(5, 2)).keys() == {"a", "b"}
    for gamma, beta in film(torch.randn(5, 2)).values():
        assert torch.equal(gamma, torch.ones(5, 3)) and torch.equal(beta, torch.zeros(5, 3))


ENDS = ("qkv", "proj", "up", "down")
BLOCKS = [f"blocks.{i}.{end}" for i in range(2) for end in ENDS]


@pytest.mark.parametrize(
    ("targets", "expected"),
    [
        (("blocks",), BLOCKS),
        (("blocks.1",), BLOCKS[4:]),
        (("qkv",), ["blocks.0.qkv", "blocks.1.qkv"]),
        (("blocks.1.down", "blocks.0.up"), ["blocks.0.up", "blocks.1.down"]),
        (("up",), ["blocks.0.up", "blocks.1.up", "head.up"]),
        (("0.up",), ["blocks.0.up"]),
        (("state_encoder",), ["state_encoder.0", "state_encoder.2"]),
        (("head", "head.up"), ["head.lift", "head.up", "head.down", "head.out"]),
    ],
)
def test_targets(targets, expected):
    assert match(targets, build("factorised")) == expected


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("kqv", "no linear layer is called 'kqv'; one of state_encoder, blocks, head, qkv, proj, .*did you mean 'qkv'"),
        ("block", "did you mean 'blocks'"),
        ("kv", "no linear layer is called 'kv'"),  # the end of a word is not the end of a name
        ("blocks.0.qk", "did you mean 'blocks.0.qkv'"),
        ("embed", "no linear layer is called 'embed'"),
        ("", "no linear layer is called ''"),
    ],
)
def test_unknown_targets(target, message):
    with pytest.raises(ConfigError, match=message):
        match(("blocks", target), build())


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (lambda: LoRAConfig(rank=0), "LoRA needs rank >= 1, not 0"),
        (lambda: LoRAConfig(dropout=1.0), r"LoRA needs dropout in \[0, 1\), not 1.0"),
        (lambda: DoRAConfig(alpha=0.0), "DoRA needs alpha > 0, not 0.0"),
        (lambda: CoLAConfig(targets=()), "CoLA needs at least one target"),
    ],
)
def test_configs_refuse(config, message):
    with pytest.raises(ValueError, match=message):
        config()


def test_a_model_is_replaced_in_without_being_touched():
    model = build()
    before = dict(model.named_modules())
    bent = replaced(model, ("qkv",), lambda name, linear: LoRALinear(linear, rank=2, alpha=2.0))
    assert dict(model.named_modules()) == before  # the same objects
    assert isinstance(bent.blocks[0].qkv, LoRALinear) and isinstance(model.blocks[0].qkv, nn.Linear)
    assert bent.blocks[0].qkv.base.weight is model.blocks[0].qkv.weight
    assert bent.embed.weight is model.embed.weight and bent.state_mean is model.state_mean
