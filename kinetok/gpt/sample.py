"""Drawing the tokens of one control step from a GPT, position after position, with a cache.

    tokens = sample(gpt, state, generator=generator)               # state (N, state_dim) -> (N, S) int64
    tokens = sample(gpt, state, greedy=True)
    keep = nucleus(logits, p=0.9)                                  # (N, V) bool

Nucleus sampling (Holtzman et al. 2020; GPC sec. 6): draw from the smallest set of tokens whose mass reaches
p. Departure: with the factorised head the nucleus is taken per scalar, given the scalars before it. There p
bounds each choice, not the token, of whose mass at least p**C is kept; p**(1/C) cuts about as much as p does
with the softmax head.

One uniform number per row and choice, through the inverse of the distribution function: on a CPU row i of a
call draws the same tokens whatever the rows after it, up to the rounding of matrix products. The tokens come
from restricted, renormalised distributions, and so do their log-probabilities: log_softmax of `restrict`.
Knows only ids: no codes, no motion.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kinetok.gpt.cache import KVCache
from kinetok.gpt.model import GPT

# Vocabularies up to this are sorted at once; in larger ones the top k are tried first.
SORT_UP_TO = 2048
TOP_K = (64, 256, 1024)


def nucleus(logits: Tensor, p: float, least: int = 1) -> Tensor:
    """The smallest set of options whose probability reaches p, `least` at least: logits (N, V) -> (N, V) bool.

    Among options of equal probability at the border the lower ids are kept. At p = 1 every option that is not
    impossible (logit -inf) stays. A large vocabulary is sorted in full only if 1024 options do not reach p.
    """
    if not 0.0 < p <= 1.0:
        raise ValueError(f"top_p must lie in (0, 1], not {p}; 1 keeps every token, greedy=True keeps the best")
    if p == 1.0:
        return logits > -torch.inf
    probs = F.softmax(logits, dim=-1, dtype=torch.float32)
    top, mass = _top(probs, p, least)
    # Option i is needed when those before it do not reach p yet; the first `least` always are.
    needed = (1 + (mass[:, :-1] < p).sum(-1, keepdim=True)).clamp_min(min(least, mass.shape[-1]))
    border = top.gather(-1, needed - 1)
    keep = probs >= border
    # Rare, and dear on a CPU; on a GPU asking whether it is so costs more than doing it.
    if probs.device.type != "cpu" or not torch.equal(keep.sum(-1, keepdim=True), needed):
        tied = probs == border
        above = (probs > border).sum(-1, keepdim=True)
        keep &= ~tied | (tied.cumsum(-1) <= needed - above)
    return keep


def _top(probs: Tensor, p: float, least: int) -> tuple[Tensor, Tensor]:
    """The k largest probabilities, falling, and their running sum, k so large that all rows reach p and `least`.

    On a GPU all of them: asking whether fewer are enough would wait for it, and a replayed graph cannot ask."""
    if probs.shape[-1] > SORT_UP_TO and probs.device.type == "cpu":
        for k in (k for k in TOP_K if k >= least):
            top = probs.topk(k, dim=-1).values
            mass = top.cumsum(-1)
            if bool((mass[:, -1] >= p).all()):
                return top, mass
    top = _falling(probs)
    return top, top.cumsum(-1)


def _falling(probs: Tensor) -> Tensor:
    """Each row sorted, largest first. On a CPU NumPy is ten times faster: torch sorts the ids along."""
    if probs.device.type == "cpu":
        return torch.from_numpy(np.sort(probs.detach().numpy(), axis=-1)).flip(-1)
    return probs.sort(dim=-1, descending=True).values


def restrict(logits: Tensor, keep: Tensor) -> Tensor:
    """The logits (N, V) of the distribution restricted to `keep` (N, V) bool: -inf elsewhere."""
    return logits.masked_fill(~keep, -torch.inf)


def draw(logits: Tensor, uniform: Tensor) -> Tensor:
    """The option at quantile `uniform` (N,) in [0, 1) of softmax(logits (N, V)): (N,) int64."""
    cumulative = F.softmax(logits, dim=-1).cumsum(-1)
    total = cumulative[:, -1:]
    # uniform * total may round up to total, where no option is left.
    target = torch.minimum(uniform[:, None] * total, torch.nextafter(total, torch.zeros_like(total)))
    return torch.searchsorted(cumulative, target, right=True).squeeze(-1)


@torch.inference_mode()
def sample(
    model: GPT,
    state: Tensor,
    *,
    generator: torch.Generator | None = None,
    top_p: float = 0.9,
    temperature: float = 1.0,
    greedy: bool = False,
    cache: KVCache | None = None,
) -> Tensor:
    """Draw the tokens of one control step: state (N, state_dim) -> tokens (N, S) int64.

    generator: source of the uniform numbers; needed unless `greedy`. top_p: mass of the nucleus, after the
    temperature has divided the logits. greedy: the most probable option each time. cache: one of
    `model.new_cache(N)` to reuse from step to step.
    """
    rows, head, steps = len(state), model.head, model.config.tokens_per_step
    _check(model, rows, generator, temperature, greedy, cache)
    if cache is None:
        cache = model.new_cache(rows)
    uniform = None
    if not greedy:
        uniform = torch.rand(rows, steps, head.choices, generator=generator, device=state.device)
    tokens = torch.empty(rows, steps, dtype=torch.int64, device=state.device)
    for j in range(steps):
        h = model.begin(state, cache) if j == 0 else model.advance(tokens[:, j - 1], cache)
        x, token = head.begin(h), 0
        for d in range(head.choices):
            logits = head.logits(x, d)
            if uniform is None:
                chosen = logits.argmax(-1)
            else:
                logits = logits / temperature
                chosen = draw(restrict(logits, nucleus(logits, top_p)), uniform[:, j, d])
            x, token = head.push(x, d, chosen), token * head.options + chosen
        tokens[:, j] = token
    return tokens


def _check(
    model: GPT,
    rows: int,
    generator: torch.Generator | None,
    temperature: float,
    greedy: bool,
    cache: KVCache | None,
) -> None:
    if generator is None and not greedy:
        raise ValueError("sampling needs generator=torch.Generator(...); or pass greedy=True")
    if temperature <= 0.0:
        raise ValueError(
            f"temperature must be above 0, not {temperature}; for the most probable tokens pass greedy=True"
        )
    if model.training and model.config.dropout > 0.0:
        raise ValueError("the model is in training mode and would drop units out; call model.eval() before sampling")
    if cache is not None and cache.rows != rows:
        raise ValueError(f"the cache holds {cache.rows} rows and the state has {rows}; make one with new_cache({rows})")
