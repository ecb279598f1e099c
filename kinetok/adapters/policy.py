"""The token policy that reinforcement learning fine-tunes (GPC sec. 7.2, app. D.3).

    uniform = uniforms(adapted, len(state), generator)
    drawn = draw(adapted, state, c, uniform, top_p=0.9)                      # tokens, keep, log_prob
    scored = score(adapted, state, c, drawn.tokens, drawn.keep)              # log_prob, entropy, with gradients

Each choice is drawn from the adapted distribution restricted to the top-p nucleus of the frozen base, both given
the same choices so far, and renormalised; log-probabilities, entropy and KL are those of that distribution, the
one that acted. The nucleus is the base's alone: it does not move while the adapter learns, so a rollout keeps it
as a mask. An action is the S tokens of a control step, and its log-probability the sum over them.

The temperature divides the logits of both before anything else. Entropy and KL are sums, over the choices of the
step, of those of the conditionals along the tokens drawn: unbiased for the step's by the chain rule, as the
tokens come from the policy itself.

Knows neither rewards nor advantages.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from kinetok.adapters.adapted import Adapted
from kinetok.gpt.cache import KVCache
from kinetok.gpt.sample import draw as option_at
from kinetok.gpt.sample import nucleus, restrict


class Drawn(NamedTuple):
    """tokens: (N, S) int64. keep: (N, S, D, K) bool, the options of each choice that the base's nucleus left.
    log_prob: (N, S), of each token under the distribution it was drawn from, in nats."""

    tokens: Tensor
    keep: Tensor
    log_prob: Tensor


@dataclass(frozen=True, kw_only=True)
class Scored:
    """log_prob: (N,), of the tokens of a step. entropy: (N,). kl, anchor: (N,), from the base and from the anchor
    restricted to the same options, or None where it was not asked for. All in nats, of one control step."""

    log_prob: Tensor
    entropy: Tensor
    kl: Tensor | None
    anchor: Tensor | None


def new_caches(adapted: Adapted, rows: int) -> tuple[KVCache, KVCache]:
    """Caches of the base and of the adapted model for `rows` characters, to reuse from step to step."""
    return adapted.new_cache(rows), adapted.new_cache(rows)


def uniforms(adapted: Adapted, rows: int, generator: torch.Generator) -> Tensor:
    """What `draw` draws by: a number in [0, 1) for every choice of a control step, (rows, S, D)."""
    shape = rows, adapted.base.config.tokens_per_step, adapted.base.head.choices
    return torch.rand(shape, generator=generator, device=generator.device)


@torch.no_grad()
def draw(
    adapted: Adapted,
    state: Tensor,
    c: Tensor | None,
    uniform: Tensor | None,
    *,
    top_p: float = 0.9,
    least: int = 1,
    temperature: float = 1.0,
    guidance: float = 1.0,
    caches: tuple[KVCache, KVCache] | None = None,
) -> Drawn:
    """Draw the tokens of one control step for state (N, state_dim) and c (N, cond_dim).

    uniform: of `uniforms(adapted, N, generator)`; None takes the most probable option left. top_p: mass of the base's
    nucleus; 1 keeps every option; least: options it has at least. caches: of `new_caches(adapted, N)`. Looks at no
    tensor's value, so that a GPU can replay it (gpt.replay).
    """
    _check(adapted, temperature)
    base, rows = adapted.base, len(state)
    for_base, for_bent = caches or new_caches(adapted, rows)
    if for_base.rows != rows:
        raise ValueError(
            f"the caches hold {for_base.rows} rows and the state has {rows}; make new_caches(adapted, {rows})"
        )
    steps, choices, options = base.config.tokens_per_step, base.head.choices, base.head.options
    tokens = torch.empty(rows, steps, dtype=torch.int64, device=state.device)
    keep = torch.empty(rows, steps, choices, options, dtype=torch.bool, device=state.device)
    log_prob = torch.zeros(rows, steps, dtype=state.dtype, device=state.device)
    for j in range(steps):
        x = base.head.begin(base.begin(state, for_base) if j == 0 else base.advance(tokens[:, j - 1], for_base))
        h = adapted.begin(state, c, for_bent) if j == 0 else adapted.advance(tokens[:, j - 1], for_bent)
        y, token = adapted.head.begin(h), 0
        for d in range(choices):
            plain = base.head.logits(x, d) / temperature
            kept = nucleus(plain, top_p, least)
            logits = restrict(guided(plain, adapted.head.logits(y, d) / temperature, guidance), kept)
            chosen = logits.argmax(-1) if uniform is None else option_at(logits, uniform[:, j, d])
            log_prob[:, j] += logits.gather(-1, chosen[:, None]).squeeze(-1) - logits.logsumexp(-1)
            keep[:, j, d], token = kept, token * options + chosen
            x, y = base.head.push(x, d, chosen), adapted.head.push(y, d, chosen)
        tokens[:, j] = token
    return Drawn(tokens, keep, log_prob)


def score(
    adapted: Adapted,
    state: Tensor,
    c: Tensor | None,
    tokens: Tensor,
    keep: Tensor,
    *,
    temperature: float = 1.0,
    guidance: float = 1.0,
    reference: bool = False,
    anchor: Adapted | None = None,
    bonus: bool = True,
) -> Scored:
    """What the policy says now of tokens (N, S) drawn with the mask keep (N, S, D, K), differentiably.

    One teacher-forced pass. reference: with the KL from the base; anchor: with the KL from this adapted model; each at
    the cost of a pass without gradient. bonus: whether gradients flow through the entropy too; without, a tenth faster.
    """
    _check(adapted, temperature)
    logits, plain = adapted(state, c, tokens) / temperature, None
    if reference or guidance != 1.0:
        with torch.no_grad():
            plain = adapted.base(state, tokens) / temperature
        logits = guided(plain, logits, guidance)
    log_p = F.log_softmax(restrict(logits, keep), dim=-1)
    taken = log_p.gather(-1, adapted.base.split(tokens)[..., None])
    if not (bonus or reference or anchor is not None):
        log_p = log_p.detach()
    log_p = log_p.masked_fill(~keep, 0.0)  # where p = 0: p log p is 0, not nan
    p = log_p.exp() * keep

    def divergence(logits: Tensor) -> Tensor:
        log_q = F.log_softmax(restrict(logits, keep), dim=-1)
        return (p * (log_p - log_q.masked_fill(~keep, 0.0))).sum((1, 2, 3))

    pull = None
    if anchor is not None:
        with torch.no_grad():
            held = anchor(state, c, tokens) / temperature
        pull = divergence(held if plain is None else guided(plain, held, guidance))
    return Scored(
        log_prob=taken.sum((1, 2, 3)),
        entropy=-(p * log_p).sum((1, 2, 3)),
        kl=divergence(plain) if reference and plain is not None else None,
        anchor=pull,
    )


def guided(plain: Tensor, bent: Tensor, guidance: float) -> Tensor:
    """Logits that go `guidance` times as far from those of the base as the adapted ones do.

    Classifier-free guidance (Ho and Salimans 2021), with the base as the model that knows no condition.
    """
    return bent if guidance == 1.0 else plain + guidance * (bent - plain)


def _check(adapted: Adapted, temperature: float) -> None:
    if temperature <= 0.0:
        raise ValueError(f"temperature must be above 0, not {temperature}; for the most probable pass no uniform")
    drops = adapted.training and any(isinstance(m, torch.nn.Dropout) and m.p > 0.0 for m in adapted.gpt.modules())
    if drops:
        raise ValueError(
            "the adapted model is in training mode and drops units out, so its log-probabilities are not those of the "
            "policy that acts; call adapted.eval(), in which gradients flow as well"
        )
