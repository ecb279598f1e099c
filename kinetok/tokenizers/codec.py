"""Clips to tokens and back, through physics.

    stream = encode_clip(tokenizer, clip)          # the tracker follows the clip and its tokens are written down
    qpos = decode_tokens(tokenizer, stream)        # the tokens alone, played from the clip's first state

The encoder looks at the reference relative to the simulated body, so encoding is a simulation; it is without
noise, and decoding the same tokens from the same state repeats it exactly, at any thread count. A stream is a
safetensors file with tokens (T, S) int64, the first state, and the layout, frame rate and parent in its metadata.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kinetok.checkpoint import CheckpointError, load_state, save_state
from kinetok.config import ConfigError, from_dict, to_dict
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.rl.rollout import torch_threads
from kinetok.sim.batch import BatchSim
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.observe import state_features
from kinetok.sim.scene import build_scene
from kinetok.sim.tasks.tracking import Failure, ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.layout import TokenLayout
from kinetok.tokenizers.tokenizer import MotionTokenizer, require_character


@dataclass(frozen=True, kw_only=True)
class TokenStream:
    """tokens (T, S) int64; layout; qpos (nq,), qvel (nv,): the state before the first token; fps: control rate;
    name of the clip; tokenizer: hash of the artifact that wrote it; simulated (T + 1, nq): the poses it reached; lost:
    whether it ends where the track was lost."""

    tokens: Tensor
    layout: TokenLayout
    qpos: np.ndarray
    qvel: np.ndarray
    fps: float
    name: str
    tokenizer: str
    simulated: np.ndarray
    lost: bool = False

    def save(self, path: Path | str) -> None:
        """Write one safetensors file, whole or not at all."""
        path = Path(path)
        tensors = {"tokens": self.tokens}
        for name in ("qpos", "qvel", "simulated"):
            tensors[name] = torch.from_numpy(np.ascontiguousarray(getattr(self, name)))
        meta = {"kind": "tokens", "layout": to_dict(self.layout), "fps": self.fps, "name": self.name}
        save_state(path, tensors, meta | {"tokenizer": self.tokenizer, "lost": self.lost})

    @staticmethod
    def load(path: Path | str) -> "TokenStream":
        """Read a file written by `save`; anything else is a CheckpointError."""
        path = Path(path)
        tensors, meta = load_state(path)
        if meta.get("kind") != "tokens":
            raise CheckpointError(f"{path} holds no tokens; write one with `kinetok tokenize encode`")
        arrays = {name: tensors[name].numpy(force=True) for name in ("qpos", "qvel", "simulated")}
        return TokenStream(
            tokens=tensors["tokens"],
            layout=from_dict(TokenLayout, meta["layout"]),
            fps=meta["fps"],
            name=meta["name"],
            tokenizer=meta["tokenizer"],
            lost=meta.get("lost", False),
            **arrays,
        )


def encode_clip(tokenizer: MotionTokenizer, clip: Clip, *, seconds: float | None = None) -> TokenStream:
    """Track the clip from its first frame for `seconds` (default: once through) and write down the tokens.

    Raises ConfigError where the clip is of another character; a track that is lost ends the stream there.
    """
    config = tokenizer.config
    library = ClipLibrary.of([clip])
    require_character(library, config.character)
    layout = tokenizer.layout
    seconds = clip.seconds if seconds is None else seconds
    if not seconds * config.scene.control_hz >= 1 - 1e-6:
        raise ValueError(
            f"{seconds:g} seconds of clip {clip.name!r} hold no control step of 1/{config.scene.control_hz} s"
        )
    table = ReferenceTable(library, control_hz=config.scene.control_hz, seconds=seconds + 1)
    tracking = TrackingConfig(future=config.future, failure=Failure(largest=np.inf, mean=0.5))
    task = Tracking(tracking, table, rows=1, starts=np.zeros(1, dtype=int))
    env = Env(EnvConfig(scene=config.scene, autoreset=False), task, rows=1, threads=1)
    obs = torch.as_tensor(env.reset())
    first = env.sim.qpos[0].copy(), env.sim.qvel[0].copy()
    tokens, simulated = [], [first[0]]
    with torch.no_grad(), torch_threads(1):
        for _ in range(min(int(seconds * table.control_hz + 1e-6), int(table.last[0] - table.first[0]))):
            codes = tokenizer.encode(obs)
            action = tokenizer.decode(codes, obs[:, task.layout["state"]])
            tokens.append(layout.to_tokens(codes)[0])
            step = env.step(action.numpy(force=True))
            obs = torch.as_tensor(step.obs)
            simulated.append(env.sim.qpos[0].copy())
            if step.terminated[0]:
                break
    return TokenStream(
        tokens=torch.stack(tokens),
        layout=layout,
        qpos=first[0],
        qvel=first[1],
        fps=float(config.scene.control_hz),
        name=clip.name,
        tokenizer=tokenizer.hash,
        simulated=np.array(simulated),
        lost=bool(step.terminated[0]),
    )


def decode_tokens(tokenizer: MotionTokenizer, stream: TokenStream) -> np.ndarray:
    """Poses (T + 1, nq) of the character that plays a stream's tokens in simulation from the stream's state.

    Raises ConfigError where another tokenizer wrote the stream: the same tokens would mean another motion.
    """
    if stream.layout != tokenizer.layout:
        raise ConfigError(
            f"the tokens have {stream.layout}, the tokenizer has {tokenizer.layout}; use its own tokenizer"
        )
    if stream.tokenizer != tokenizer.hash:
        raise ConfigError(
            f"the tokens of {stream.name!r} were written by tokenizer {stream.tokenizer[:12] or '(unsaved)'}, this is "
            f"{tokenizer.hash[:12] or '(unsaved)'}; use the tokenizer that wrote them"
        )
    character = Character.load(tokenizer.config.character)
    sim = BatchSim(build_scene(character, tokenizer.config.scene), 1, 1)
    sim.set_state(np.zeros(1, dtype=int), stream.qpos[None], stream.qvel[None])
    poses = [sim.qpos[0].copy()]
    codes = stream.layout.to_codes(stream.tokens)
    with torch_threads(1):
        for step in range(len(codes)):
            state = torch.as_tensor(state_features(sim.state()))
            action = tokenizer.decode(codes[step : step + 1], state)
            if len(sim.step(action.numpy(force=True), tokenizer.config.scene.substeps)):
                raise FloatingPointError(f"the simulation blew up at token step {step} of {len(codes)}")
            poses.append(sim.qpos[0].copy())
    return np.array(poses)
