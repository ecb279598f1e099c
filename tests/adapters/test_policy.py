"""policy.py: by hand, against sample() and against itself; what the nucleus cut off has no mass."""

from math import log

import pytest
import torch

from kinetok.adapters import FullConfig, LoRAConfig
from kinetok.adapters.adapted import Adapted
from kinetok.adapters.policy import draw, guided, new_caches, score, uniforms
from kinetok.gpt import GPT, GPTConfig, nucleus, sample
from tests.adapters.bending import HEADS, KINDS, batch, bend, build, move

heads = pytest.mark.parametrize("head", HEADS)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def by_hand(head: str, temperature: float) -> Adapted:
    """Two tokens, whose every choice has base (.5, .3, .15, .05) and adapted (.2, .3, .1, .4) at this temperature."""
    scalars = {"softmax": 1, "factorised": 2}[head]
    gpt = GPT(
        GPTConfig(state_dim=1, tokens_per_step=2, scalars=scalars, levels=4, width=4, layers=1, heads=1, head=head)
    )
    adapted = Adapted(gpt, FullConfig())
    with torch.no_grad():
        for model, p in ((adapted.base, (0.5, 0.3, 0.15, 0.05)), (adapted.gpt, (0.2, 0.3, 0.1, 0.4))):
            model.head.out.weight.zero_()
            model.head.out.bias.copy_(temperature * torch.tensor(p).log())
    return adapted


@pytest.mark.parametrize("temperature", [1.0, 2.0])
@pytest.mark.parametrize(("head", "choices"), [("softmax", 1), ("factorised", 2)])
def test_by_hand(head, choices, temperature):
    # top_p .7: .5 < .7 <= .8, so options 0 and 1 stay; adapted (.2, .3) / .5 = (.4, .6); base (.5, .3) / .8 =
    # (.625, .375). Each of the 2 tokens has `choices` choices, all alike.
    adapted, state = by_hand(head, temperature), torch.zeros(2000, 1)
    drawn = draw(adapted, state, None, uniforms(adapted, len(state), seeded()), top_p=0.7, temperature=temperature)
    assert drawn.keep.shape == (2000, 2, choices, 4)
    assert (drawn.keep == torch.tensor([True, True, False, False])).all()
    digits = adapted.base.split(drawn.tokens)
    assert digits.max() == 1
    assert abs(digits.float().mean() - 0.6) < 0.03  # 4 or 8 thousand choices: 3 sd are .023 at most
    expected = torch.where(digits == 1, log(0.6), log(0.4)).sum(-1)
    torch.testing.assert_close(drawn.log_prob, expected)
    scored = score(adapted, state, None, drawn.tokens, drawn.keep, temperature=temperature, reference=True)
    torch.testing.assert_close(scored.log_prob, expected.sum(-1))
    entropy = -(0.4 * log(0.4) + 0.6 * log(0.6))  # 0.6730 nats
    kl = 0.4 * log(0.4 / 0.625) + 0.6 * log(0.6 / 0.375)  # 0.1035 nats
    torch.testing.assert_close(scored.entropy, torch.full((2000,), 2 * choices * entropy))
    torch.testing.assert_close(scored.kl, torch.full((2000,), 2 * choices * kl))


@heads
def test_at_the_start_it_draws_what_the_base_samples(head):
    adapted, (state, c, _) = bend("lora", head), batch(64)
    plain = sample(adapted.base, state, generator=seeded(4), top_p=0.8, temperature=1.3)
    drawn = draw(adapted, state, c, uniforms(adapted, len(state), seeded(4)), top_p=0.8, temperature=1.3)
    assert torch.equal(drawn.tokens, plain)
    scored = score(adapted, state, c, drawn.tokens, drawn.keep, temperature=1.3, reference=True)
    torch.testing.assert_close(scored.kl, torch.zeros(64), rtol=0, atol=1e-5)
    greedy = draw(adapted, state, c, None)
    assert torch.equal(greedy.tokens, sample(adapted.base, state, greedy=True))


@heads
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("top_p", "temperature"), [(0.7, 1.3), (1.0, 1.0)])
def test_score_says_what_draw_said(head, kind, top_p, temperature):
    adapted, (state, c, _) = bend(kind, head, moved=True).double(), batch(64)
    state, c = state.double(), c.double()
    settings = {"top_p": top_p, "temperature": temperature}
    drawn = draw(adapted, state, c, uniforms(adapted, len(state), seeded()), **settings, caches=new_caches(adapted, 64))
    scored = score(adapted, state, c, drawn.tokens, drawn.keep, temperature=temperature, reference=True)
    torch.testing.assert_close(scored.log_prob.detach(), drawn.log_prob.sum(-1), rtol=0, atol=1e-9)
    assert drawn.keep.gather(-1, adapted.base.split(drawn.tokens)[..., None]).all()
    assert top_p < 1.0 or drawn.keep.all()
    assert (scored.kl >= -1e-5).all() and (scored.entropy >= -1e-5).all()
    again = draw(adapted, state, c, uniforms(adapted, len(state), seeded()), **settings)
    assert torch.equal(again.tokens, drawn.tokens) and torch.equal(again.keep, drawn.keep)
    bare = score(adapted, state, c, drawn.tokens, drawn.keep, temperature=temperature, bonus=False)
    assert torch.equal(bare.log_prob, scored.log_prob) and torch.equal(bare.entropy, scored.entropy)
    assert bare.log_prob.requires_grad and scored.entropy.requires_grad and not bare.entropy.requires_grad


@heads
def test_guidance_goes_further_the_same_way(head):
    adapted, (state, c, _) = bend("cola", head, moved=True).double(), batch(64)
    state, c = state.double(), c.double()
    drawn = draw(adapted, state, c, uniforms(adapted, len(state), seeded()), top_p=0.8, guidance=2.5)
    scored = score(adapted, state, c, drawn.tokens, drawn.keep, guidance=2.5, reference=True)
    torch.testing.assert_close(scored.log_prob.detach(), drawn.log_prob.sum(-1), rtol=0, atol=1e-9)
    plain = score(adapted, state, c, drawn.tokens, drawn.keep, guidance=0.0, reference=True)
    assert float(plain.kl.abs().max()) < 1e-9  # none of it is the base
    here, there = torch.randn(2, 5, 7, generator=seeded())
    torch.testing.assert_close(guided(here, there, 2.5) - here, 2.5 * (there - here))
    assert guided(here, there, 1.0) is there
    base = draw(adapted, state, c, uniforms(adapted, len(state), seeded()), guidance=0.0)
    assert torch.equal(base.tokens, sample(adapted.base, state, generator=seeded(), top_p=0.9))


@pytest.mark.parametrize("kind", ["lora", "cola"])
@heads
def test_in_single_precision_score_and_draw_differ_by_rounding(head, kind):
    adapted, (state, c, _) = Adapted(build(head, scale=2.0), KINDS[kind], 2), batch(64)
    optimizer = torch.optim.Adam(adapted.trainable(), lr=3e-3)
    for seed in range(3):
        drawn = draw(adapted, state, c, uniforms(adapted, len(state), seeded(seed)))
        scored = score(adapted, state, c, drawn.tokens, drawn.keep)
        torch.testing.assert_close(scored.log_prob.detach(), drawn.log_prob.sum(-1), rtol=1e-5, atol=1e-5)
        optimizer.zero_grad()
        (scored.log_prob * state[:, 0]).mean().backward()
        optimizer.step()
    assert max(p.grad.abs().max() for p in adapted.trainable()) > 0


@heads
def test_the_nucleus_is_that_of_the_base(head):
    adapted, (state, c, _) = bend("cola", head, moved=True), batch(64)
    drawn = draw(adapted, state, c, uniforms(adapted, len(state), seeded()), top_p=0.6)
    base = adapted.base(state, drawn.tokens).softmax(-1)
    mass = (base * drawn.keep).sum(-1)
    smallest = base.masked_fill(~drawn.keep, 2.0).amin(-1)
    assert (mass >= 0.6 - 1e-5).all() and (mass - smallest < 0.6 + 1e-5).all()


@heads
def test_over_all_actions_probability_entropy_and_kl_are_those_of_one_distribution(head):
    # All 81 actions of two tokens in one state. Sums over them: probability 1; -p log p is the expectation of
    # `entropy` along the tokens drawn (chain rule), and so for the KL; the gradient of sum p is 0.
    torch.manual_seed(0)
    shape = GPTConfig(state_dim=7, tokens_per_step=2, scalars=2, levels=3, width=16, layers=2, heads=2, head=head)
    adapted = move(Adapted(GPT(shape), LoRAConfig(rank=3, alpha=5.0), 2))
    tokens = torch.cartesian_prod(torch.arange(9), torch.arange(9))
    state, c = torch.randn(1, 7).expand(81, -1), torch.randn(1, 2).expand(81, -1)
    logits = adapted.base(state, tokens)
    keep = nucleus(logits.flatten(0, 2), 0.7).view(logits.shape)
    scored = score(adapted, state, c, tokens, keep, reference=True)
    p = scored.log_prob.exp()
    inside = keep.gather(-1, adapted.base.split(tokens)[..., None]).all(-1).flatten(1).all(-1)
    assert 1 < inside.sum() < 81
    assert (p[~inside] == 0).all() and (p[inside] > 0).all()
    torch.testing.assert_close(p.sum(), torch.tensor(1.0))
    torch.testing.assert_close((p * scored.entropy).sum(), -(p * p.log())[inside].sum())
    log_q = score(Adapted(adapted.base, LoRAConfig(), 2), state, c, tokens, keep).log_prob
    torch.testing.assert_close((p * scored.kl).sum(), (p * (p.log() - log_q))[inside].sum())
    for gradient in torch.autograd.grad(p.sum(), adapted.trainable(), retain_graph=True):
        assert gradient.abs().max() < 1e-5
    for total in (scored.entropy.sum(), scored.kl.sum(), scored.log_prob[inside].sum()):
        gradients = torch.autograd.grad(total, adapted.trainable(), retain_graph=True)
        assert all(torch.isfinite(g).all() for g in gradients) and any(g.abs().max() > 0 for g in gradients)


def test_what_cannot_be_drawn_is_refused():
    adapted, (state, c, tokens) = bend("lora"), batch()
    with pytest.raises(ValueError, match=r"temperature must be above 0, not 0\.0"):
        draw(adapted, state, c, uniforms(adapted, len(state), seeded()), temperature=0.0)
    with pytest.raises(ValueError, match=r"hold 4 rows and the state has 5; make new_caches\(adapted, 5\)"):
        draw(adapted, state, c, uniforms(adapted, len(state), seeded()), caches=new_caches(adapted, 4))
    dropping = Adapted(build(), LoRAConfig(dropout=0.1), 2).train()
    with pytest.raises(ValueError, match="in training mode and drops units out"):
        score(dropping, state, c, tokens, torch.ones(5, 4, 1, 9, dtype=torch.bool))
