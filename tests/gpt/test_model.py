from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from kinetok.config import ConfigError, from_dict, to_dict
from kinetok.gpt import GPT, GPTConfig

TINY = GPTConfig(state_dim=7, tokens_per_step=4, scalars=2, levels=3, width=16, layers=2, heads=2, head_width=12)
heads = pytest.mark.parametrize("head", ["softmax", "factorised"])


def build(head: str, seed: int = 0, scale: float = 8.0) -> GPT:
    """A tiny model with weights large enough that every input matters."""
    torch.manual_seed(seed)
    model = GPT(replace(TINY, head=head))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(scale) if parameter.ndim > 1 else None
    return model.eval()


def batch(rows: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return torch.randn(rows, 7, generator=generator), torch.randint(9, (rows, 4), generator=generator)


@pytest.mark.parametrize(("head", "shape"), [("softmax", (5, 4, 1, 9)), ("factorised", (5, 4, 2, 3))])
def test_shapes(head, shape):
    state, tokens = batch()
    model = build(head)
    assert model(state, tokens).shape == shape
    assert model.log_prob(state, tokens).shape == (5, 4)


@heads
def test_a_later_token_does_not_change_earlier_logits(head):
    model, (state, tokens) = build(head), batch()
    before = model(state, tokens)
    for j in range(4):
        changed = tokens.clone()
        changed[:, j] = (changed[:, j] + 1) % 9  # another last digit
        after = model(state, changed)
        torch.testing.assert_close(after[:, :j], before[:, :j])
        # Position j itself may read only the digits of t_j before the one it predicts: the first logits stay.
        torch.testing.assert_close(after[:, j, 0], before[:, j, 0])
        assert j == 3 or not torch.allclose(after[:, j + 1 :], before[:, j + 1 :])


@heads
def test_gradient_of_the_future_is_zero(head):
    model, (state, tokens) = build(head), batch()
    rows_per_position = TINY.scalars * TINY.levels
    for j in range(4):
        (gradient,) = torch.autograd.grad(model.hidden(state, tokens)[:, j].square().sum(), model.embed.weight)
        by_position = gradient.view(3, rows_per_position, -1).abs().sum((1, 2))
        assert (by_position[:j] > 0).all()
        assert (by_position[j:] == 0).all()


def test_a_digit_of_the_factorised_head_reads_only_digits_before_it():
    model, h = build("factorised"), torch.randn(1, 16)
    logits = torch.stack([model.head(h, torch.tensor([[a, b]]))[0] for a in range(3) for b in range(3)])
    assert (logits[:, 0] - logits[0, 0]).abs().max() == 0
    by_first = logits[:, 1].view(3, 3, 3)
    torch.testing.assert_close(by_first, by_first[:, :1].expand(3, 3, 3))
    assert not torch.allclose(by_first[0], by_first[1])


@heads
def test_cached_decoding_equals_uncached(head):
    model, (state, tokens) = build(head, scale=4.0), batch()
    logits, choices, cache = model(state, tokens), model.split(tokens), model.new_cache(5)
    for _ in range(2):  # the second time on a used cache
        for j in range(4):
            h = model.begin(state, cache) if j == 0 else model.advance(tokens[:, j - 1], cache)
            x = model.head.begin(h)
            for d in range(model.head.choices):
                torch.testing.assert_close(model.head.logits(x, d), logits[:, j, d], rtol=1e-5, atol=1e-5)
                x = model.head.push(x, d, choices[:, j, d])


@heads
def test_log_prob_sums_to_one_over_the_whole_vocabulary(head):
    model, (state, tokens) = build(head), batch(1)
    for j in range(4):
        every = tokens.repeat(9, 1)
        every[:, j] = torch.arange(9)
        total = model.log_prob(state.expand(9, -1), every)[:, j].logsumexp(0)
        assert total.item() == pytest.approx(0.0, abs=1e-5)


def test_split_gives_the_digits_most_significant_first():
    # 7 = 2 * 3 + 1
    assert build("factorised").split(torch.tensor([7])).tolist() == [[2, 1]]
    assert build("softmax").split(torch.tensor([7])).tolist() == [[7]]


def test_softmax_loss_is_cross_entropy_with_label_smoothing():
    model, (state, tokens) = build("softmax"), batch()
    logits = model(state, tokens)[:, :, 0].flatten(0, 1)
    for smoothing in (0.0, 0.1):
        loss, metrics = model.loss(state, tokens, label_smoothing=smoothing)
        torch.testing.assert_close(loss, F.cross_entropy(logits, tokens.flatten(), label_smoothing=smoothing))
        torch.testing.assert_close(metrics["cross_entropy"], F.cross_entropy(logits.detach(), tokens.flatten()))


@heads
def test_loss_without_smoothing_is_the_mean_negative_log_prob(head):
    model, (state, tokens) = build(head), batch()
    torch.testing.assert_close(model.loss(state, tokens)[0], -model.log_prob(state, tokens).mean())


@heads
def test_a_few_steps_fit_a_batch(head):
    torch.manual_seed(0)
    model, (state, tokens) = GPT(replace(TINY, head=head)), batch(8)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(100):
        loss, _ = model.loss(state, tokens)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    loss, metrics = model.loss(state, tokens)
    assert loss.item() < 0.1 and metrics["accuracy"].item() == 1.0
    assert all(parameter.grad is not None for parameter in model.parameters())


def test_state_statistics_are_stored_and_constant_features_survive():
    model, (state, tokens) = build("softmax"), batch()
    mean, std = torch.arange(7.0), torch.tensor([2.0] * 6 + [0.0])
    expected = model(state, tokens)
    model.set_state_statistics_(mean, std)
    assert model.state_dict()["state_mean"].tolist() == mean.tolist()
    assert model.state_std.tolist() == [2.0] * 6 + [1.0]
    torch.testing.assert_close(model(state * model.state_std + mean, tokens), expected, rtol=1e-4, atol=1e-4)


@heads
def test_a_state_dict_restores_the_model(head):
    (state, tokens), model, other = batch(), build(head), build(head, seed=1)
    other.load_state_dict(model.state_dict())
    assert torch.equal(other(state, tokens), model(state, tokens))


def test_smallest_shapes_work():
    config = GPTConfig(
        state_dim=1, tokens_per_step=1, scalars=1, levels=2, width=4, layers=1, heads=1, head="factorised"
    )
    assert GPT(config)(torch.zeros(2, 1), torch.tensor([[0], [1]])).shape == (2, 1, 1, 2)
    assert from_dict(GPTConfig, to_dict(config)) == config


def full_cache() -> None:
    model, (state, tokens) = build("softmax"), batch()
    cache = model.new_cache(5)
    model.begin(state, cache)
    for j in range(4):
        model.advance(tokens[:, j % 3], cache)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: replace(TINY, width=15), ValueError, "width 15 must be a multiple of heads 2"),
        (lambda: replace(TINY, layers=0), ValueError, "layers >= 1, not 0"),
        (lambda: replace(TINY, ff=0), ValueError, "ff >= 1, not 0"),
        (lambda: replace(TINY, dropout=1.0), ValueError, r"dropout in \[0, 1\), not 1.0"),
        (lambda: GPT(replace(TINY, head="factorized")), ConfigError, "did you mean 'factorised'"),  # pyright: ignore
        (
            lambda: build("softmax")(torch.zeros(2, 6), torch.zeros(2, 4).long()),
            ValueError,
            r"must be \(N, 7\)",
        ),
        (
            lambda: build("softmax")(torch.zeros(2, 7), torch.zeros(2, 3).long()),
            ValueError,
            r"must be \(2, 4\)",
        ),
        (
            lambda: build("softmax")(torch.zeros(2, 7), torch.full((2, 4), 9)),
            ValueError,
            r"token 9.*in 0\.\.8",
        ),
        (
            lambda: build("softmax").advance(torch.tensor([0]), build("softmax").new_cache(1)),
            ValueError,
            "begin",
        ),
        (full_cache, ValueError, "4 positions with 4 filled"),
    ],
)
def test_messages(call, error, message):
    with pytest.raises(error, match=message):
        call()
