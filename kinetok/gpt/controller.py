"""The closed loop: state -> tokens -> codes -> action, and what it leads to.

    prior = Prior.from_pretrained("runs/prior")
    controller = PriorController(prior, generator=torch.Generator().manual_seed(0))
    action, tokens = controller.act(state)                       # (N, S) -> (N, nu) PD targets, (N, T)
    recording = roll(prior, rows=64, seconds=20, seed=0)

A `Prior` is a GPT with the tokenizer whose tokens it speaks and the states it may begin from, so that it runs
without any clip. Its artifact holds the GPT and the starts; the tokenizer stays an artifact of its own, found by
the path noted beside the weights or given by the caller, and refused unless it is the one trained with.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kinetok.checkpoint import Artifact, CheckpointError, load_artifact, locate, require_parent, save_artifact
from kinetok.config import from_dict, to_dict
from kinetok.gpt.data import Starts
from kinetok.gpt.model import GPT, GPTConfig
from kinetok.gpt.sample import sample
from kinetok.motion.character import Character
from kinetok.rl.rollout import seeded, torch_threads
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.free import Free
from kinetok.tokenizers.tokenizer import MotionTokenizer


@dataclass(frozen=True, kw_only=True, eq=False)
class Prior:
    """gpt, in eval mode; tokenizer: whose tokens it predicts, loaded from an artifact; tokenizer_path: where that
    lies, relative to the prior's directory, or a packaged name; clips: names of what it learned from; starts."""

    gpt: GPT
    tokenizer: MotionTokenizer
    tokenizer_path: str
    clips: tuple[str, ...]
    starts: Starts = field(repr=False)

    @property
    def character(self) -> Character:
        """The body it moves."""
        return Character.load(self.tokenizer.config.character)

    @property
    def fps(self) -> int:
        """Control steps per second."""
        return self.tokenizer.config.scene.control_hz

    def save_pretrained(self, path: Path | str, card: str) -> None:
        """Write the artifact directory: config.json, model.safetensors, README.md."""
        weights = {f"gpt.{name}": tensor for name, tensor in self.gpt.state_dict().items()}
        save_artifact(
            path,
            kind="prior",
            config={
                "gpt": to_dict(self.gpt.config),
                "tokenizer": self.tokenizer_path,
                "layout": to_dict(self.tokenizer.layout),
                "clips": list(self.clips),
            },
            tensors=weights | self.starts.tensors(),
            card=card,
            parents={"tokenizer": self.tokenizer.hash},
        )

    @staticmethod
    def from_pretrained(path: Path | str, tokenizer: MotionTokenizer | Path | str | None = None) -> "Prior":
        """Load a prior by directory or packaged name, with its tokenizer: `tokenizer`, itself or its directory, if
        given, else the one at the noted place."""
        artifact = load_artifact(path, kind="prior")
        noted = artifact.config["tokenizer"]
        if not isinstance(tokenizer, MotionTokenizer):
            place = _find(artifact.path, noted) if tokenizer is None else locate(tokenizer)
            tokenizer = MotionTokenizer.from_pretrained(place)
        else:
            place = "the tokenizer given"
        require_parent(artifact, "tokenizer", tokenizer.hash, place)
        gpt = GPT(from_dict(GPTConfig, artifact.config["gpt"]))
        gpt.load_state_dict(gpt_weights(artifact))
        return Prior(
            gpt=gpt.eval(),
            tokenizer=tokenizer,
            tokenizer_path=noted,
            clips=tuple(artifact.config["clips"]),
            starts=Starts.of(artifact.tensors),
        )


def gpt_weights(artifact: Artifact) -> dict[str, Tensor]:
    """The weights of the GPT in a prior's artifact, by their names in it."""
    return {name[4:]: tensor for name, tensor in artifact.tensors.items() if name.startswith("gpt.")}


def noted_path(tokenizer: Path | str, prior: Path | str) -> str:
    """What a prior notes of its tokenizer's place: the way there from its own directory, so that both may be moved
    together, or the name of a packaged one."""
    place = Path(tokenizer)
    return Path(os.path.relpath(place, prior)).as_posix() if place.is_dir() else str(tokenizer)


def _find(prior: Path, noted: str) -> Path:
    for place in (prior / noted, locate(noted)):
        if noted and place.is_dir():
            return place
    said = f"its tokenizer is not at {noted!r}" if noted else "it does not say where its tokenizer is"
    raise CheckpointError(f"{prior}: {said}; give the tokenizer's directory, --tokenizer DIR")


class PriorController:
    """Draws the tokens of each control step from a prior and decodes them.

    top_p, temperature, greedy: as in gpt.sample; generator: needed unless greedy. One controller serves one number
    of rows at a time and reuses its cache.
    """

    def __init__(
        self,
        prior: Prior,
        *,
        top_p: float = 0.9,
        temperature: float = 1.0,
        greedy: bool = False,
        generator: torch.Generator | None = None,
    ):
        self.prior, self.layout = prior, prior.tokenizer.layout
        self.top_p, self.temperature, self.greedy, self.generator = top_p, temperature, greedy, generator
        self._cache = prior.gpt.new_cache(1)

    @torch.no_grad()
    def act(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """PD targets (N, nu) and the tokens (N, T) int64 behind them, for states (N, S)."""
        if self._cache.rows != len(state):
            self._cache = self.prior.gpt.new_cache(len(state))
        tokens = sample(
            self.prior.gpt,
            state,
            generator=self.generator,
            top_p=self.top_p,
            temperature=self.temperature,
            greedy=self.greedy,
            cache=self._cache,
        )
        return self.prior.tokenizer.decode(self.layout.to_codes(tokens), state), tokens


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """T control steps of N rows of a character, frame t as it was when tokens t were chosen.

    qpos (T, N, nq) float64; pos (T, N, B, 3) float32, metres; tokens (T, N, S) int32 below vocabulary; blown_up (N,)
    bool: MuJoCo could not go on and the row began anew; start (N,): index into the prior's starts; fps.
    """

    character: str
    qpos: np.ndarray
    pos: np.ndarray
    tokens: np.ndarray
    blown_up: np.ndarray
    start: np.ndarray
    vocabulary: int
    fps: int


def roll(
    prior: Prior,
    *,
    rows: int = 64,
    seconds: float = 20.0,
    starts: np.ndarray | None = None,
    seed: int = 0,
    push: float = 0.0,
    push_at: int = 200,
    top_p: float = 0.9,
    temperature: float = 1.0,
    threads: int = 0,
) -> Recording:
    """Let `rows` characters move freely for `seconds`, without resets.

    starts (rows,): indices into prior.starts; None draws them. push: m/s added to the root's horizontal velocity at
    step push_at, in directions that depend on seed and row alone (GPC app. C.3). The result depends on `seed` and
    not on `threads`.
    """
    steps = round(seconds * prior.fps)
    if push and push_at >= steps:
        raise ValueError(f"the push comes at step {push_at} of {steps}; roll longer than {push_at / prior.fps:.1f} s")
    body = prior.character
    task = Free(body, prior.starts.qpos, prior.starts.qvel, rows=rows, starts=starts)
    config = EnvConfig(scene=prior.tokenizer.config.scene, episode_seconds=seconds + 1)
    env = Env(config, task, rows=rows, threads=threads, seed=seed)
    generator = seeded(seed)
    controller = PriorController(prior, top_p=top_p, temperature=temperature, generator=generator)
    angle = np.random.default_rng([seed, 1]).uniform(0, 2 * np.pi, rows)
    impulse = push * np.stack([np.cos(angle), np.sin(angle), np.zeros(rows)], axis=1)
    qpos, pos = np.empty((steps, rows, body.nq)), np.empty((steps, rows, len(body.body_names), 3), np.float32)
    tokens = np.empty((steps, rows, prior.gpt.config.tokens_per_step), np.int32)
    blown_up = np.zeros(rows, bool)
    obs = env.reset()
    drawn = task.drawn.copy()
    with torch_threads(1):
        for t in range(steps):
            qpos[t], pos[t] = env.sim.qpos, env.sim.state().pos
            if push and t == push_at:
                env.sim.add_velocity(np.arange(rows), impulse)
            action, chosen = controller.act(torch.as_tensor(obs))
            tokens[t] = chosen.numpy(force=True)
            step = env.step(action.numpy(force=True))
            blown_up |= step.terminated
            obs = step.obs
    return Recording(
        character=prior.tokenizer.config.character,
        qpos=qpos,
        pos=pos,
        tokens=tokens,
        blown_up=blown_up,
        start=drawn,
        vocabulary=controller.layout.vocabulary,
        fps=prior.fps,
    )
