"""The prior of GPC: a small GPT that, given the state of a character, predicts the tokens of a control step.

    gpt = GPT(GPTConfig(state_dim=350, tokens_per_step=8, scalars=3, levels=9))
    gpt.set_state_statistics_(mean, std)
    loss, metrics = gpt.loss(state, tokens)            # state (N, state_dim), tokens (N, 8) int64 in 0..728
    tokens = sample(gpt, state, generator=generator)   # sample.py

Position 0 reads the encoded state, position j the token t_{j-1}; position j predicts t_j (GPC eq. 5).

A token is predicted as D choices of K each, so that both heads look the same from outside. The softmax head
(the paper's) makes one choice among V = L**C. The factorised head makes C choices among L, scalar after
scalar, each given those before: p(t | h) = prod_c p(d_c | h, d_{<c}), the exact joint distribution without a
V-wide layer.

Departures from GPC sec. 6 and app. C
- Pre-norm blocks (the paper uses PyTorch's transformer module, whose default is post-norm).
- A token is embedded as a sum over C tables of L rows, other tables at each position, not by one of V rows.
- The state is normalised by stored statistics and clipped to +-10 standard deviations before its MLP.
- The loss is the mean over the tokens of a step, eq. 6 is the sum. Label smoothing is per choice.

Refuses tokens out of range and shapes that do not fit. Knows ids only: no motion, no simulator, no rewards.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from kinetok.config import pick
from kinetok.gpt.cache import KVCache

STATE_CLIP = 10.0


@dataclass(frozen=True, kw_only=True)
class GPTConfig:
    """The shape of a prior. `scalars`, `levels` and `tokens_per_step` are those of the TokenLayout.

    state_dim: width of the state.
    tokens_per_step: S. scalars: C per token. levels: L values per scalar.
    width: of the residual stream. layers, heads: of the transformer.
    ff: width of the MLPs; None means 4 * width.
    dropout: on the residual branches.
    head: "softmax" (the paper's, V-wide) or "factorised" (scalar by scalar).
    head_width: inner width of the factorised head; the softmax head has none.
    """

    state_dim: int
    tokens_per_step: int
    scalars: int
    levels: int
    width: int = 192
    layers: int = 4
    heads: int = 4
    ff: int | None = None
    dropout: float = 0.0
    head: Literal["softmax", "factorised"] = "softmax"
    head_width: int = 128

    def __post_init__(self) -> None:
        for name, count in vars(self).items():
            if name not in ("dropout", "head") and count is not None and count < 1:
                raise ValueError(f"GPTConfig needs {name} >= 1, not {count}")
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"GPTConfig needs dropout in [0, 1), not {self.dropout}")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} must be a multiple of heads {self.heads}")

    @property
    def vocabulary(self) -> int:
        """V = L**C."""
        return self.levels**self.scalars


class Block(nn.Module):
    """One pre-norm transformer block: x + attention(norm x), then x + MLP(norm x)."""

    def __init__(self, config: GPTConfig):
        super().__init__()
        width, ff = config.width, 4 * config.width if config.ff is None else config.ff
        self.heads = config.heads
        self.attention_norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.ff_norm = nn.LayerNorm(width)
        self.up = nn.Linear(width, ff)
        self.down = nn.Linear(ff, width)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x: Tensor, cache: KVCache | None = None, layer: int = 0) -> Tensor:
        """x (N, S, width) -> (N, S, width), causal. With a cache, x (N, 1, width) is the next position."""
        qkv = rearrange(self.qkv(self.attention_norm(x)), "n s (three h e) -> three n h s e", three=3, h=self.heads)
        q, k, v = qkv.unbind()
        if cache is not None:
            k, v = cache.append(layer, k, v)
        y = F.scaled_dot_product_attention(q, k, v, is_causal=cache is None)
        x = x + self.dropout(self.proj(rearrange(y, "n h s e -> n s (h e)")))
        return x + self.dropout(self.down(F.gelu(self.up(self.ff_norm(x)))))


class SoftmaxHead(nn.Module):
    """One choice (D = 1) among all V tokens."""

    def __init__(self, config: GPTConfig):
        super().__init__()
        self.choices, self.options = 1, config.vocabulary
        self.out = nn.Linear(config.width, config.vocabulary)

    def forward(self, h: Tensor, chosen: Tensor) -> Tensor:
        """h (..., width), chosen (..., 1) -> logits (..., 1, V)."""
        return self.out(h)[..., None, :]

    def begin(self, h: Tensor) -> Tensor:
        """h (N, width) -> x, what `logits` and `push` carry from choice to choice."""
        return h

    def logits(self, x: Tensor, choice: int) -> Tensor:
        """Logits (N, V) of choice number `choice`."""
        return self.out(x)

    def push(self, x: Tensor, choice: int, chosen: Tensor) -> Tensor:
        """x after `chosen` (N,) was taken as choice number `choice`."""
        return x


class FactorisedHead(nn.Module):
    """C choices among L, one small net: p(d_c | h, d_{<c}) = softmax(net(A h + b_c + sum_{i<c} E_i d_i))."""

    def __init__(self, config: GPTConfig):
        super().__init__()
        inner = config.head_width
        self.choices, self.options = config.scalars, config.levels
        self.lift = nn.Linear(config.width, inner)
        self.place = nn.Parameter(0.02 * torch.randn(config.scalars, inner))
        self.embed = nn.Embedding((config.scalars - 1) * config.levels, inner)
        self.norm = nn.LayerNorm(inner)
        self.up = nn.Linear(inner, 2 * inner)
        self.down = nn.Linear(2 * inner, inner)
        self.out = nn.Linear(inner, config.levels)

    def forward(self, h: Tensor, chosen: Tensor) -> Tensor:
        """h (..., width), chosen digits (..., C) -> logits (..., C, L); those of digit c read digits < c."""
        tables = torch.arange(self.choices - 1, device=h.device) * self.options
        before = F.pad(self.embed(chosen[..., :-1] + tables).cumsum(-2), (0, 0, 1, 0))
        return self._read(self.lift(h)[..., None, :] + before + self.place)

    def begin(self, h: Tensor) -> Tensor:
        """h (N, width) -> x, what `logits` and `push` carry from choice to choice."""
        return self.lift(h)

    def logits(self, x: Tensor, choice: int) -> Tensor:
        """Logits (N, L) of digit number `choice`."""
        return self._read(x + self.place[choice])

    def push(self, x: Tensor, choice: int, chosen: Tensor) -> Tensor:
        """x after `chosen` (N,) was taken as digit number `choice`; nothing reads the last digit."""
        return x if choice == self.choices - 1 else x + self.embed(chosen + choice * self.options)

    def _read(self, x: Tensor) -> Tensor:
        return self.out(x + self.down(F.gelu(self.up(self.norm(x)))))


HEADS = {"softmax": SoftmaxHead, "factorised": FactorisedHead}


class GPT(nn.Module):
    """p(t_0 .. t_{S-1} | state) = prod_j p(t_j | state, t_{<j}) (GPC eq. 5). See the head of this file."""

    state_mean: Tensor
    state_std: Tensor
    places: Tensor
    tables: Tensor

    def __init__(self, config: GPTConfig):
        super().__init__()
        self.config = config
        width, S, C, L = config.width, config.tokens_per_step, config.scalars, config.levels
        self.register_buffer("state_mean", torch.zeros(config.state_dim))
        self.register_buffer("state_std", torch.ones(config.state_dim))
        self.register_buffer("places", torch.tensor([L**c for c in reversed(range(C))]), persistent=False)
        self.register_buffer("tables", L * rearrange(torch.arange(S * C), "(s c) -> s c", c=C), persistent=False)
        self.state_encoder = nn.Sequential(nn.Linear(config.state_dim, width), nn.GELU(), nn.Linear(width, width))
        # Table (j, c) embeds digit c of token t_j; t_{S-1} is never an input.
        self.embed = nn.Embedding((S - 1) * C * L, width)
        self.position = nn.Parameter(torch.zeros(S, width))
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.head = pick(HEADS, config.head, "GPT head")(config)
        self._initialise_()

    def _initialise_(self) -> None:
        """GPT-2: normal(0, 0.02), biases 0, and branches into the stream scaled by 1/sqrt(2 layers)."""
        for name, parameter in self.named_parameters():
            if name.startswith("head."):
                continue  # PyTorch's own: at 0.02 the digits chosen so far would be drowned by h
            if name.endswith("bias"):
                nn.init.zeros_(parameter)
            elif "norm" not in name:
                branch = name.endswith(("proj.weight", "down.weight")) and name.startswith("blocks")
                nn.init.normal_(parameter, std=0.02 / math.sqrt(2 * self.config.layers) if branch else 0.02)

    def set_state_statistics_(self, mean: Tensor, std: Tensor) -> None:
        """Store mean and std (state_dim,) of the training states; below 1e-4 a feature counts as constant."""
        self.state_mean.copy_(mean)
        self.state_std.copy_(torch.where(std < 1e-4, torch.ones_like(std), std))

    def digits(self, tokens: Tensor) -> Tensor:
        """tokens (...) -> their scalars (..., C) in 0..L-1, the most significant first."""
        return tokens[..., None] // self.places % self.config.levels

    def split(self, tokens: Tensor) -> Tensor:
        """tokens (...) -> the head's choices (..., D): the token itself, or its digits."""
        return tokens[..., None] if self.head.choices == 1 else self.digits(tokens)

    def hidden(self, state: Tensor, tokens: Tensor) -> Tensor:
        """state (N, state_dim), tokens (N, S) -> h (N, S, width); h[:, j] has read the state and t_{<j}."""
        self._check(state, tokens)
        before = self.embed(self.digits(tokens[:, :-1]) + self.tables[:-1]).sum(-2)
        x = torch.cat([self._encode(state)[:, None], before], dim=1) + self.position
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def forward(self, state: Tensor, tokens: Tensor) -> Tensor:
        """state (N, state_dim), tokens (N, S) -> logits (N, S, D, K) of choice d of token j.

        Softmax head: (N, S, 1, V). Factorised head: (N, S, C, L).
        """
        return self.head(self.hidden(state, tokens), self.split(tokens))

    def log_prob(self, state: Tensor, tokens: Tensor) -> Tensor:
        """log p(t_j | state, t_{<j}), (N, S), in nats."""
        log_p = F.log_softmax(self(state, tokens), dim=-1)
        return log_p.gather(-1, self.split(tokens)[..., None]).squeeze(-1).sum(-1)

    def loss(self, state: Tensor, tokens: Tensor, label_smoothing: float = 0.0) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross-entropy per token (GPC eq. 6 over S); a share `label_smoothing` of the target is uniform.

        Metrics, detached: `cross_entropy` without the smoothing, in nats per token; `accuracy`, the share of
        tokens that greedy decoding would have chosen given the true ones before.
        """
        logits, target = self(state, tokens), self.split(tokens)
        log_p = F.log_softmax(logits, dim=-1)
        nll = -log_p.gather(-1, target[..., None]).squeeze(-1)
        smoothed = torch.lerp(nll, -log_p.mean(-1), label_smoothing) if label_smoothing else nll
        metrics = {
            "cross_entropy": nll.detach().sum(-1).mean(),
            "accuracy": (logits.detach().argmax(-1) == target).all(-1).float().mean(),
        }
        return smoothed.sum(-1).mean(), metrics

    def new_cache(self, rows: int) -> KVCache:
        """A cache for one control step of `rows` characters."""
        config, weight = self.config, self.position
        return KVCache(
            layers=config.layers,
            rows=rows,
            heads=config.heads,
            positions=config.tokens_per_step,
            head_dim=config.width // config.heads,
            dtype=weight.dtype,
            device=weight.device,
        )

    @torch.no_grad()
    def begin(self, state: Tensor, cache: KVCache) -> Tensor:
        """Reset the cache and read the state (N, state_dim) -> h (N, width), which predicts t_0."""
        cache.reset()
        return self._advance(self._encode(state), cache)

    @torch.no_grad()
    def advance(self, token: Tensor, cache: KVCache) -> Tensor:
        """Read the next token (N,) -> h (N, width), which predicts the one after it."""
        if not 0 < cache.length < cache.positions:
            raise ValueError(
                f"cannot advance a cache of {cache.positions} positions with {cache.length} filled; "
                "each control step starts with begin(state, cache) and takes one token fewer than positions"
            )
        tables = self.tables[cache.length - 1]
        return self._advance(self.embed(self.digits(token) + tables).sum(-2), cache)

    def _advance(self, x: Tensor, cache: KVCache) -> Tensor:
        x = (x + self.position[cache.length])[:, None]
        for layer, block in enumerate(self.blocks):
            x = block(x, cache, layer)
        cache.length += 1
        return self.norm(x[:, 0])

    def _encode(self, state: Tensor) -> Tensor:
        normalised = (state - self.state_mean) / self.state_std
        return self.state_encoder(normalised.clamp(-STATE_CLIP, STATE_CLIP))

    def _check(self, state: Tensor, tokens: Tensor) -> None:
        config = self.config
        if state.ndim != 2 or state.shape[1] != config.state_dim:
            raise ValueError(f"state has shape {tuple(state.shape)}; it must be (N, {config.state_dim})")
        if tokens.shape != (len(state), config.tokens_per_step):
            expected = (len(state), config.tokens_per_step)
            raise ValueError(f"tokens have shape {tuple(tokens.shape)}; they must be {expected}, (N, S)")
        if tokens.numel() and (tokens.min() < 0 or tokens.max() >= config.vocabulary):
            found = int(tokens.min() if tokens.min() < 0 else tokens.max())
            raise ValueError(f"token {found} is out of range; tokens lie in 0..{config.vocabulary - 1}")
