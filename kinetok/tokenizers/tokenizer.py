"""MotionTokenizer: encoder -> quantizer -> decoder, trained as one policy through the simulated tracking loop.

    tokenizer = MotionTokenizer.from_pretrained("humanoid-fsq")
    tokens = tokenizer.layout.to_tokens(tokenizer.encode(obs))     # from the reference window alone
    action = tokenizer.decode(codes, state)                        # PD targets in radians; no reference

GPC sec. 5 and app. B: z = E(window), code = Q(z), action = D(state, code). The encoder of a tokenizer sees the
reference window relative to the body, and more only where encoder_inputs says so; the decoder only the proprioceptive
state and the code. A *teacher* is the same class with the `continuous` quantizer; it alone may set `residual`, an
action around the reference's own PD target, which leaks the reference and is therefore refused for kinds that have
codes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from kinetok.checkpoint import load_artifact, save_artifact
from kinetok.config import ConfigError, from_dict, to_dict
from kinetok.motion.library import ClipLibrary
from kinetok.rl.nets import mlp
from kinetok.rl.normalize import RunningNorm
from kinetok.sim.scene import SceneConfig
from kinetok.tokenizers import build_quantizer
from kinetok.tokenizers.fsq import FSQConfig
from kinetok.tokenizers.layout import TokenLayout
from kinetok.tokenizers.quantizer import ContinuousConfig, Quantized

PARTS = ("state", "window", "error")


@dataclass(frozen=True, kw_only=True)
class TokenizerConfig:
    """character; future: reference frames in the window, in control steps; scene: the physics it was trained in;
    quantizer; scalars: FSQ scalars per token; encoder, decoder: hidden widths; encoder_inputs, decoder_inputs:
    parts of the observation; residual: act around the reference (teachers only)."""

    character: str = "humanoid"
    future: tuple[int, ...] = (1, 2, 5, 7, 12, 18, 25)
    scene: SceneConfig = SceneConfig()
    quantizer: FSQConfig | ContinuousConfig = FSQConfig()
    scalars: int = 3
    encoder: tuple[int, ...] = (256, 128)
    decoder: tuple[int, ...] = (256, 128)
    activation: str = "silu"
    encoder_inputs: tuple[str, ...] = ("window",)
    decoder_inputs: tuple[str, ...] = ("state",)
    residual: bool = False

    def __post_init__(self) -> None:
        for part in (*self.encoder_inputs, *self.decoder_inputs):
            if part not in PARTS:
                raise ConfigError(f"unknown observation part {part!r}; parts: {', '.join(PARTS)}")
        for name in ("encoder", "decoder"):
            if any(width < 1 for width in getattr(self, name)):
                raise ConfigError(f"{name} holds widths of layers, of at least 1 each, not {getattr(self, name)}")
        if self.quantizer.kind == "continuous":
            return
        if self.residual or self.decoder_inputs != ("state",):
            raise ConfigError(
                f"a {self.quantizer.kind!r} tokenizer's decoder sees the state and the code only; residual actions and "
                "decoder inputs other than 'state' are for continuous teachers, which may see the reference"
            )


class MotionTokenizer(nn.Module):
    """sizes: width of the observation's parts, as `sim.tasks.Tracking.layout` cuts it; actions: PD targets."""

    action_mean: Tensor
    action_scale: Tensor

    def __init__(self, config: TokenizerConfig, sizes: Mapping[str, int], actions: int):
        super().__init__()
        self.config, self.sizes, self.actions = config, dict(sizes), actions
        self.hash = ""  # of the artifact it was loaded from
        edge, self._cut = 0, {}
        for part in (*PARTS, "target"):
            self._cut[part] = slice(edge, edge + sizes[part])
            edge += sizes[part]
        self.quantizer = build_quantizer(config.quantizer)
        self.norm = RunningNorm(sum(sizes[part] for part in PARTS))
        width_in = sum(sizes[part] for part in config.encoder_inputs)
        self.encoder = mlp([width_in, *config.encoder, self.quantizer.dim_in], config.activation)
        width_in = sum(sizes[part] for part in config.decoder_inputs) + self.quantizer.dim_out
        self.decoder = mlp([width_in, *config.decoder, actions], config.activation, last_scale=0.01)
        self.register_buffer("action_mean", torch.zeros(actions))
        self.register_buffer("action_scale", torch.ones(actions))

    @property
    def layout(self) -> TokenLayout:
        """How codes become tokens; an error for continuous codes."""
        if not self.quantizer.levels:
            raise ConfigError("a continuous tokenizer has no tokens; fit one with an fsq quantizer")
        return TokenLayout.grouped(len(self.quantizer.levels), self.quantizer.levels[0], self.config.scalars)

    def _parts(self, obs: Tensor, parts: tuple[str, ...]) -> list[Tensor]:
        normal = self.norm(obs[..., : self._cut["target"].start])
        return [normal[..., self._cut[part]] for part in parts]

    def quantize(self, obs: Tensor) -> Quantized:
        """Observations (N, O) to quantized latents."""
        return self.quantizer(self.encoder(torch.cat(self._parts(obs, self.config.encoder_inputs), -1)))

    @torch.no_grad()
    def encode(self, obs: Tensor) -> Tensor:
        """Codes (N, dim) int64 of observations (N, O)."""
        return self.quantizer.encode(self.encoder(torch.cat(self._parts(obs, self.config.encoder_inputs), -1)))

    @torch.no_grad()
    def decode(self, codes: Tensor, state: Tensor) -> Tensor:
        """PD targets (N, nu) for codes (N, dim) in state (N, S): the low-level policy."""
        cut = self._cut["state"]
        normal = (state - self.norm.mean[cut]) * (self.norm.var[cut] + 1e-4).rsqrt()
        values = self.quantizer.decode(codes)
        return self._action(self.decoder(torch.cat([normal.clamp(-self.norm.clip, self.norm.clip), values], -1)))

    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Mean PD targets (N, nu) of observations (N, O), the quantizer's loss and metrics (rl.nets.Actor)."""
        quantized = self.quantize(obs)
        features = [*self._parts(obs, self.config.decoder_inputs), quantized.values]
        out = self.decoder(torch.cat(features, -1))
        if self.config.residual:
            return obs[..., self._cut["target"]] + out, quantized.loss, quantized.metrics
        return self._action(out), quantized.loss, quantized.metrics

    def _action(self, out: Tensor) -> Tensor:
        return self.action_mean + self.action_scale * out

    def observe(self, obs: Tensor) -> None:
        """Merge observations into the normaliser."""
        self.norm.observe(obs[..., : self._cut["target"].start])

    def save_pretrained(self, path: Path | str, card: str, parents: dict[str, str] | None = None) -> None:
        """Write the artifact directory: config.json, model.safetensors, README.md."""
        save_artifact(
            path,
            kind="tokenizer",
            config={"tokenizer": to_dict(self.config), "sizes": self.sizes, "actions": self.actions},
            tensors=dict(self.state_dict()),
            card=card,
            parents=parents,
        )

    @staticmethod
    def from_pretrained(path: Path | str) -> "MotionTokenizer":
        """Load an artifact directory; the weights are ready to use, in eval mode."""
        artifact = load_artifact(path, kind="tokenizer")
        config = from_dict(TokenizerConfig, artifact.config["tokenizer"])
        tokenizer = MotionTokenizer(config, artifact.config["sizes"], artifact.config["actions"])
        tokenizer.load_state_dict(artifact.tensors)
        tokenizer.hash = artifact.hash
        return tokenizer.eval()


def require_character(library: ClipLibrary, character: str) -> None:
    """Refuse clips of another character than a tokenizer's."""
    if library.character != character:
        raise ConfigError(
            f"clip {library.names[0]!r} is of {library.character!r}, the tokenizer of {character!r}; retarget it "
            f"first: kinetok clips import --character {character}"
        )
