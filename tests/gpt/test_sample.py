from dataclasses import replace

import pytest
import torch

from kinetok.gpt import GPT, GPTConfig, draw, nucleus, restrict, sample

TINY = GPTConfig(state_dim=3, tokens_per_step=3, scalars=2, levels=3, width=16, layers=2, heads=2, head_width=12)
heads = pytest.mark.parametrize("head", ["softmax", "factorised"])


def build(head: str, dropout: float = 0.0) -> GPT:
    """A tiny model with weights large enough that its distributions are far from flat."""
    torch.manual_seed(0)
    model = GPT(replace(TINY, head=head, dropout=dropout))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(8.0) if parameter.ndim > 1 else None
    return model.eval()


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def states(rows: int) -> torch.Tensor:
    return torch.randn(rows, 3, generator=seeded(9))


def logits_of(*probabilities: float) -> torch.Tensor:
    return torch.tensor([probabilities]).log()


@pytest.mark.parametrize(
    ("probabilities", "p", "kept"),
    [
        ((0.1, 0.5, 0.15, 0.25), 0.7, [1, 3]),  # 0.5 < 0.7 <= 0.5 + 0.25
        ((0.1, 0.5, 0.15, 0.25), 0.8, [1, 2, 3]),  # 0.75 < 0.8 <= 0.9
        ((0.1, 0.5, 0.15, 0.25), 0.49, [1]),
        ((0.1, 0.5, 0.15, 0.25), 0.001, [1]),  # never empty
        ((0.1, 0.5, 0.15, 0.25), 0.95, [0, 1, 2, 3]),
        ((0.1, 0.5, 0.15, 0.25), 1.0, [0, 1, 2, 3]),
        ((0.2, 0.4, 0.2, 0.2), 0.7, [0, 1, 2]),  # 0.4 + 0.2 < 0.7: two of the three tied, the lower ids
        ((0.2, 0.2, 0.2, 0.4), 0.5, [0, 3]),
        ((0.25, 0.25, 0.25, 0.25), 0.6, [0, 1, 2]),  # 0.5 < 0.6 <= 0.75
        ((0.0, 0.6, 0.0, 0.4), 0.9, [1, 3]),
        ((0.0, 0.6, 0.0, 0.4), 1.0, [1, 3]),  # impossible tokens stay out
    ],
)
def test_nucleus_by_hand(probabilities, p, kept):
    assert nucleus(logits_of(*probabilities), p)[0].nonzero().flatten().tolist() == kept


def test_a_nucleus_of_at_least_so_many_by_hand():
    logits = logits_of(0.01, 0.9, 0.05, 0.04)
    for least, kept in ((1, [1]), (2, [1, 2]), (3, [1, 2, 3]), (9, [0, 1, 2, 3])):
        assert nucleus(logits, 0.8, least)[0].nonzero().flatten().tolist() == kept
    peaked, flat = torch.zeros(1, 5000), torch.zeros(1, 5000)
    peaked[0, :3] = 20.0
    for rows in (peaked, torch.cat([peaked, flat])):  # as many whatever the other rows need
        assert nucleus(rows, 0.8, 100)[0].sum() == 100
    assert nucleus(logits, 0.97, 2)[0].nonzero().flatten().tolist() == [1, 2, 3]  # the mass asks for more


@pytest.mark.parametrize("vocabulary", [1, 9, 729, 5000])
@pytest.mark.parametrize("scale", [0.0, 0.5, 3.0])
def test_nucleus_is_the_smallest_set_that_reaches_p(vocabulary, scale):
    logits = scale * torch.randn(6, vocabulary, generator=seeded())
    keep, probs = nucleus(logits, 0.9), logits.softmax(-1)
    mass, count = (probs * keep).sum(-1), keep.sum(-1)
    smallest_kept = probs.masked_fill(~keep, 2.0).amin(-1)
    assert (mass >= 0.9 - 1e-5).all() and (count >= 1).all()
    assert (mass - smallest_kept < 0.9 + 1e-5).all()  # one fewer does not reach p
    assert (smallest_kept >= probs.masked_fill(keep, -1.0).amax(-1)).all()  # and no other is more probable


def test_nucleus_rows_are_independent():
    logits = torch.cat([0.1 * torch.randn(3, 5000, generator=seeded()), 5.0 * torch.randn(3, 5000, generator=seeded())])
    together = nucleus(logits, 0.9)
    assert torch.equal(together, torch.cat([nucleus(row[None], 0.9) for row in logits]))


def test_draw_by_hand():
    # Running sums 0.25, 0.25, 0.75, 1: option 1 is impossible.
    logits = logits_of(0.25, 0.0, 0.5, 0.25).expand(6, -1)
    uniform = torch.tensor([0.0, 0.2, 0.3, 0.7, 0.8, 1 - 2**-24])
    assert draw(logits, uniform).tolist() == [0, 0, 2, 2, 3, 3]
    assert draw(logits_of(0.0, 1.0, 0.0), torch.tensor([1 - 2**-24])).tolist() == [1]


@heads
def test_greedy_is_deterministic_and_takes_the_best_choice(head):
    model, state = build(head), states(6)
    tokens = sample(model, state, greedy=True)
    assert torch.equal(tokens, sample(model, state, greedy=True))
    assert torch.equal(model(state, tokens).argmax(-1), model.split(tokens))
    # A nucleus so small holds the best choice alone.
    assert torch.equal(tokens, sample(model, state, generator=seeded(), top_p=1e-6))


@heads
def test_same_seed_same_tokens_whatever_the_rows_after(head):
    model, state = build(head), states(40)
    tokens = sample(model, state, generator=seeded(4))
    assert tokens.shape == (40, 3) and tokens.dtype == torch.int64
    assert tokens.min() >= 0 and tokens.max() < 9
    assert torch.equal(tokens, sample(model, state, generator=seeded(4)))
    assert torch.equal(tokens, sample(model, state, generator=seeded(4), cache=model.new_cache(40)))
    assert not torch.equal(tokens, sample(model, state, generator=seeded(5)))
    assert torch.equal(tokens[:7], sample(model, state[:7], generator=seeded(4)))


@heads
@pytest.mark.parametrize(("top_p", "temperature"), [(1.0, 1.0), (0.8, 1.0), (0.7, 1.5)])
def test_frequencies_approach_the_restricted_distribution(head, top_p, temperature):
    rows = 8000
    model, state = build(head), states(1)
    tokens = sample(model, state.expand(rows, -1), generator=seeded(), top_p=top_p, temperature=temperature)
    seen = torch.bincount(tokens[:, 0], minlength=9) / rows
    # p(t_0) over all nine tokens, choice by choice, each restricted to its nucleus.
    every = torch.zeros(9, 3, dtype=torch.int64)
    every[:, 0] = torch.arange(9)
    expected = torch.ones(9)
    for d, chosen in enumerate(model.split(every[:, 0]).unbind(-1)):
        logits = model(state.expand(9, -1), every)[:, 0, d] / temperature
        kept = restrict(logits, nucleus(logits, top_p)).softmax(-1)
        expected *= kept.gather(-1, chosen[:, None]).squeeze(-1).detach()
    assert expected.sum().item() == pytest.approx(1.0, abs=1e-5)
    assert (seen[expected == 0] == 0).all()
    assert (seen - expected).abs().max() < 0.0225  # four standard errors of a frequency of one half


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sample(build("softmax"), states(2)), "needs generator"),
        (
            lambda: sample(build("softmax"), states(2), generator=seeded(), temperature=0.0),
            "temperature.*greedy",
        ),
        (
            lambda: sample(build("softmax"), states(2), generator=seeded(), top_p=0.0),
            r"top_p must lie in \(0, 1\]",
        ),
        (lambda: sample(build("softmax", dropout=0.1).train(), states(2), greedy=True), r"model\.eval\(\)"),
        (
            lambda: sample(build("softmax"), states(2), greedy=True, cache=build("softmax").new_cache(3)),
            r"3 rows",
        ),
    ],
)
def test_messages(call, message):
    with pytest.raises(ValueError, match=message):
        call()
