"""A frozen GPT bent to a task: the GPT, an adapter, and the way the task observation c enters.

    adapted = Adapted(prior.gpt, CoLAConfig(rank=16, alpha=32), cond_dim=2)
    logits = adapted(state, c, tokens)                     # state (N, state_dim), c (N, 2), tokens (N, S)
    h = adapted.begin(state, c, cache)                     # decoding, as of a GPT
    with adapted.disable():
        reference = adapted(state, c, tokens)              # the GPT itself
    adapted.save_pretrained("runs/target", base="humanoid-gpt")
    adapted = Adapted.from_pretrained("runs/target", prior.gpt)

At the start it computes what the GPT does, for every kind and every c. The GPT is frozen and shared, never
changed: `adapted.base` is the object that was given. What is saved are the adapter's own tensors, in peft's files
and under peft's names; a LoRA or DoRA without a task observation opens in peft. Refuses to load beside another
GPT than it was trained with. Knows no simulator and no reward.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kinetok.adapters import ADAPTERS, AdapterConfig, CoLAConfig, DoRAConfig, FullConfig, LoRAConfig
from kinetok.adapters.cola import UNMERGEABLE, Film
from kinetok.adapters.condition import Conditioner, Token, TokenEncoder
from kinetok.adapters.inject import Condition, match, merged
from kinetok.checkpoint import ADAPTER, CheckpointError, load_artifact, require_parent, save_artifact
from kinetok.config import from_dict, nearest, pick, to_dict
from kinetok.gpt.cache import KVCache
from kinetok.gpt.model import GPT, FactorisedHead, GPTConfig, SoftmaxHead

PEFT = "base_model.model."  # how peft begins the name of a tensor
CARD = """# {kind} adapter for `{base}`

Bends a kinetok motion prior (GPT {hash}) to a task: {trainable:,} parameters beside {frozen:,} frozen ones
({share:.2%}). It reads {reads}.

    {config}

    from kinetok.adapters.adapted import Adapted
    adapted = Adapted.from_pretrained("PATH", prior.gpt)

Refuses another GPT than the one it was trained with. Licence: Apache-2.0.
"""


@dataclass(frozen=True, kw_only=True)
class AdaptedConfig:
    """adapter: its kind and shape. cond_dim: width of the task observation, 0 for none."""

    adapter: AdapterConfig
    cond_dim: int


class Adapted(nn.Module):
    """`base`, frozen, and `gpt`, the same model bent by `config`, which reads c (N, cond_dim) where cond_dim > 0.

    c enters LoRA, DoRA and full fine-tuning as a task token, CoLA by gamma and beta and, unless
    `config.task_token` is False, as a task token too. Starts in eval mode, in which gradients flow and nothing is
    dropped; supervised fine-tuning with dropout calls `train()`.
    """

    def __init__(self, gpt: GPT, config: AdapterConfig, cond_dim: int = 0):
        super().__init__()
        if cond_dim < 0:
            raise ValueError(f"an adapter needs cond_dim >= 0, not {cond_dim}; 0 means no task observation")
        _, bend = pick(ADAPTERS, config.kind, "adapter")
        self.config, self.cond_dim = config, cond_dim
        self.base = gpt.requires_grad_(False)
        self.condition = Condition()
        self.gpt: GPT = bend(gpt, config, self.condition if cond_dim else None)  # type: ignore[operator]
        self.conditioner = self._conditioner() if cond_dim else None
        if self.conditioner is not None and self.conditioner.token is not None:
            self.gpt.state_encoder = TokenEncoder(self.gpt.state_encoder, self.condition)
        self._disabled = False
        self.eval()

    def _conditioner(self) -> Conditioner:
        config, film, token = self.config, None, None
        if isinstance(config, CoLAConfig):
            film = Film(self.cond_dim, config.hidden, config.rank, match(config.targets, self.base))
        if not isinstance(config, CoLAConfig) or config.task_token:
            token = Token(self.cond_dim, config.hidden, self.base.config.width)
        return Conditioner(self.cond_dim, token=token, film=film)

    @property
    def head(self) -> SoftmaxHead | FactorisedHead:
        """The head of the model that computes now: of the bent one, or inside `disable` of the base."""
        return self._active.head

    @property
    def _active(self) -> GPT:
        return self.base if self._disabled else self.gpt

    @contextmanager
    def disable(self) -> Iterator[None]:
        """Inside the block the base computes, at its own cost; c is checked and not read."""
        before, self._disabled = self._disabled, True
        try:
            yield
        finally:
            self._disabled = before

    def train(self, mode: bool = True) -> "Adapted":
        """Training mode, in which dropout acts; the base stays in eval mode."""
        super().train(mode)
        self.base.eval()
        return self

    def forward(self, state: Tensor, c: Tensor | None, tokens: Tensor) -> Tensor:
        """state (N, state_dim), c (N, cond_dim), tokens (N, S) -> logits (N, S, D, K), as of the GPT."""
        with self._reading(state, c):
            return self._active(state, tokens)

    def loss(
        self, state: Tensor, c: Tensor | None, tokens: Tensor, label_smoothing: float = 0.0
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross-entropy per token and metrics, as of the GPT: what supervised fine-tuning minimises."""
        with self._reading(state, c):
            return self._active.loss(state, tokens, label_smoothing)

    def new_cache(self, rows: int) -> KVCache:
        """A cache for one control step of `rows` characters."""
        return self.base.new_cache(rows)

    @torch.no_grad()
    def begin(self, state: Tensor, c: Tensor | None, cache: KVCache) -> Tensor:
        """Reset the cache and read state and c -> h (N, width), which predicts t_0. c stays set for `advance`."""
        self._read(state, c)
        return self._active.begin(state, cache)

    @torch.no_grad()
    def advance(self, token: Tensor, cache: KVCache) -> Tensor:
        """Read the next token (N,) -> h (N, width), which predicts the one after it."""
        return self._active.advance(token, cache)

    def observe(self, c: Tensor) -> None:
        """Merge task observations (..., cond_dim) into the statistics that normalise c; call between updates."""
        if self.conditioner is not None:
            self.conditioner.observe(c)

    def trainable(self) -> list[nn.Parameter]:
        """The parameters to optimise: all of the adapter's and none of the base's."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def adapter_state(self) -> dict[str, Tensor]:
        """The adapter's own tensors by name: those of peft's layers under peft's names, then `conditioner.*`."""
        own = {id(parameter) for parameter in self.trainable()}
        tensors = {PEFT + name: p.detach() for name, p in self.gpt.named_parameters() if id(p) in own}
        if self.conditioner is not None:
            tensors |= {f"conditioner.{name}": tensor for name, tensor in self.conditioner.state_dict().items()}
        return tensors

    @torch.no_grad()
    def load_adapter_state_(self, tensors: dict[str, Tensor]) -> None:
        """Take over what `adapter_state` of an adapter of the same shape gave."""
        mine = self.adapter_state()
        for name in mine.keys() ^ tensors.keys():
            said = "lacks" if name in mine else "has no place for"
            raise CheckpointError(f"the adapter {said} the tensor {name!r}{nearest(name, mine)}")
        for name, tensor in mine.items():
            if tensors[name].shape != tensor.shape:
                shapes = f"{tuple(tensors[name].shape)}, not {tuple(tensor.shape)}"
                raise CheckpointError(f"the tensor {name!r} of the adapter has shape {shapes}")
            tensor.copy_(tensors[name])

    def merge(self) -> GPT:
        """A plain GPT, sharing nothing, that computes what the adapted one does.

        Refuses where there is none: with a task observation, and for CoLA.
        """
        if isinstance(self.config, CoLAConfig):
            raise ValueError(UNMERGEABLE)
        if self.cond_dim:
            raise ValueError(
                f"this adapter reads a task observation of width {self.cond_dim}, which a plain GPT does not take; "
                "only an adapter with cond_dim=0 can be merged"
            )
        return merged(self.gpt)

    def save_pretrained(
        self,
        path: Path | str,
        *,
        base: str,
        card: str | None = None,
        skill: dict | None = None,
        parents: dict[str, str] | None = None,
    ) -> None:
        """Write the adapter directory: adapter_config.json, adapter_model.safetensors, README.md.

        base: name or place of the prior that was bent, noted for readers; card: the README, None for a short one;
        skill: what skill.Skill says of the task, JSON; parents: role -> hash of what else it was made from.
        """
        identity, config = fingerprint(self.base), AdaptedConfig(adapter=self.config, cond_dim=self.cond_dim)
        trainable, frozen, share = parameters_of(self)
        reads = f"a task observation of {self.cond_dim} numbers" if self.cond_dim else "no task observation"
        if card is None:
            said = {"kind": self.config.kind, "base": base, "hash": identity[:12], "trainable": trainable}
            card = CARD.format(**said, frozen=frozen, share=share, reads=reads, config=json.dumps(to_dict(self.config)))
        save_artifact(
            path,
            kind="adapter",
            config={"adapted": to_dict(config), "skill": skill},
            tensors=self.adapter_state(),
            card=card,
            parents={"gpt": identity, **(parents or {})},
            files=ADAPTER,
            extra=self._for_peft(base),
        )

    @staticmethod
    def from_pretrained(
        path: Path | str, gpt: GPT, *, base: Path | str = "the GPT given", rebase: bool = False
    ) -> "Adapted":
        """Load an adapter beside the GPT it was trained with, or, to `rebase` it, beside another one of the same shape.
        base: where `gpt` came from, for messages."""
        artifact = load_artifact(path, "adapter", ADAPTER)
        if not rebase:
            require_parent(artifact, "gpt", fingerprint(gpt), base)
        config = from_dict(AdaptedConfig, artifact.config["adapted"], str(artifact.path / ADAPTER.config))
        adapted = Adapted(gpt, config.adapter, config.cond_dim)
        adapted.load_adapter_state_(artifact.tensors)
        return adapted

    def _for_peft(self, base: str) -> dict:
        """peft's keys. A peft_type that peft knows is written only where peft computes the same."""
        config = self.config
        kind = {"cola": "COLA", "full": "FULL"}.get(config.kind, "TASK_TOKEN_LORA" if self.cond_dim else "LORA")
        keys = {"peft_type": kind, "base_model_name_or_path": base, "task_type": None, "inference_mode": True}
        if isinstance(config, FullConfig):
            return keys
        keys |= {"r": config.rank, "lora_alpha": config.alpha, "target_modules": match(config.targets, self.base)}
        if isinstance(config, CoLAConfig):
            return keys
        dropout = config.dropout if isinstance(config, LoRAConfig) else 0.0
        return keys | {"lora_dropout": dropout, "bias": "none", "use_dora": isinstance(config, DoRAConfig)}

    @contextmanager
    def _reading(self, state: Tensor, c: Tensor | None) -> Iterator[None]:
        self._read(state, c)
        try:
            yield
        finally:
            self.condition.clear()

    def _read(self, state: Tensor, c: Tensor | None) -> None:
        found = (len(state), 0) if c is None else tuple(c.shape)
        if found != (len(state), self.cond_dim):
            expected = (len(state), self.cond_dim)
            said = "is missing" if c is None else f"has shape {found}"
            raise ValueError(f"the task observation c {said}; it must be {expected}, (N, cond_dim)")
        if self.conditioner is not None and c is not None and not self._disabled:
            self.conditioner.fill(self.condition, c)


class Parameters(NamedTuple):
    """trainable, base: numbers of parameters. share: trainable / base."""

    trainable: int
    base: int
    share: float


class AdapterPart:
    """The adapter of an adapted model alone, as a run saves and restores it (resume.Part)."""

    def __init__(self, adapted: Adapted):
        self.adapted = adapted

    def state_dict(self) -> dict[str, Tensor]:
        return self.adapted.adapter_state()

    def load_state_dict(self, state: dict[str, Tensor], /) -> None:
        self.adapted.load_adapter_state_(state)


def parameters_of(adapted: Adapted) -> Parameters:
    """How many parameters the adapter trains beside how many of the base."""
    trainable = sum(parameter.numel() for parameter in adapted.trainable())
    base = sum(parameter.numel() for parameter in adapted.base.parameters())
    return Parameters(trainable, base, trainable / base)


def parameters_at_paper_size(config: AdapterConfig, cond_dim: int = 2, state_dim: int = 350) -> Parameters:
    """`parameters_of` a GPT of GPC's size (app. C table 10), without allocating it.

    The paper gives no state_dim; its token embedding has V rows (60 million parameters), ours is a sum of tables.
    """
    with torch.device("meta"):
        shape = GPTConfig(
            state_dim=state_dim, tokens_per_step=8, scalars=5, levels=9, width=1024, layers=6, heads=4, ff=4096
        )
        return parameters_of(Adapted(GPT(shape), config, cond_dim))


def fingerprint(gpt: GPT) -> str:
    """sha256, in hex, of a GPT's config and of every tensor it would save: equal for equal models."""
    digest = hashlib.sha256(json.dumps(to_dict(gpt.config)).encode())
    for name, tensor in sorted(gpt.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().view(torch.uint8).numpy().data)
    return digest.hexdigest()
