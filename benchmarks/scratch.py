"""A task without a prior: PPO over PD targets from nothing, in the worlds a fine-tuned skill is trained in.

    python benchmarks/scratch.py target --samples 3000000 --out scratch.json

The policy is a network from state and task to joint angles, with Gaussian noise, that knows neither clips nor tokens;
worlds, starts, rewards, evaluation and PPO are those of `kinetok finetune`. The figures are those of
`kinetok evaluate task`.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kinetok.adapters.finetune import FinetuneConfig, reshaped
from kinetok.adapters.rlft import TaskScore, play, task_of
from kinetok.checkpoint import flatten, load_state, save_state, unflatten
from kinetok.config import to_dict
from kinetok.gpt.controller import Prior
from kinetok.rl.nets import Critic, mlp
from kinetok.rl.normalize import RunningNorm
from kinetok.rl.policy import Gaussian
from kinetok.rl.ppo import PPOConfig
from kinetok.rl.training import Training
from kinetok.sim.env import Env
from kinetok.sim.tasks import TASKS
from kinetok.tokenizers.train import in_scene

JUDGE = 1_000_000  # added to the seed: the episodes that choose the best are not those reported


class Plain(nn.Module):
    """State and task (N, O) to PD targets (N, nu) around the mean pose of the prior's start states."""

    def __init__(self, prior: Prior, obs_size: int):
        super().__init__()
        body = prior.character
        ctrl = torch.from_numpy(body.pose_to_ctrl(prior.starts.qpos)).float()
        self.register_buffer("mean", ctrl.mean(0))
        self.register_buffer("scale", ctrl.std(0).clamp_min(0.1))
        self.norm = RunningNorm(obs_size)
        self.net = mlp([obs_size, 256, 128, body.nu], "silu", last_scale=0.01)

    def act(self, obs: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        return self.mean + self.scale * self.net(self.norm(obs)), torch.zeros(()), {}

    def observe(self, obs: Tensor) -> None:
        self.norm.observe(obs)


def scratch(
    task: str, samples: int, out: Path, *, seed: int = 0, threads: int = 0, episodes: int = 256
) -> dict[str, Any]:
    """Train for `samples` control steps in `out` and measure the best evaluation anew."""
    prior, config = Prior.from_pretrained("humanoid-gpt"), reshaped(FinetuneConfig(), task=task, adapter="cola")
    ppo = PPOConfig(gamma=config.ppo.gamma)
    world = in_scene(config.env, prior.tokenizer.config.scene)
    env = Env(world, task_of(config.task, prior, config.rows), rows=config.rows, threads=threads, seed=seed)
    torch.manual_seed(seed)
    actor = Plain(prior, env.obs_size)
    policy = Gaussian(actor, log_std=-1.6)
    run = Training(
        out=out, world=env, policy=policy, critic=Critic(env.obs_size, config.critic), config=ppo,
        modules={"actor": actor}, identity={"stage": to_dict(config) | {"samples": samples}}, kinds={}, seed=seed,
    )  # fmt: skip
    best = out / "best.safetensors"

    def evaluate(episodes: int, seed: int) -> TaskScore:
        told = {"episodes": episodes, "seconds": config.eval_seconds, "seed": seed, "threads": threads}
        return play(lambda obs: actor.act(obs)[0], config.task, prior, **told).score

    def spread(share: float) -> None:
        policy.log_std = -1.6 - 1.2 * share

    def keep(score: TaskScore) -> None:
        tensors, tree = flatten({"actor": dict(actor.state_dict())})
        save_state(best, tensors, {"tree": tree, "score": score.to_json()})

    run.train(
        samples=samples, eval_every=config.eval_every, keep=keep, schedule=spread, title=f"scratch {task}",
        evaluate=lambda: evaluate(config.eval_episodes, seed + JUDGE),
    )  # fmt: skip
    tensors, meta = load_state(best)
    actor.load_state_dict(unflatten(tensors, meta["tree"])["actor"])
    measures = evaluate(episodes, seed).measures
    return measures | {"task": task, "samples": samples, "seed": seed, "policy": "PD targets from scratch"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=list(TASKS))
    parser.add_argument("--samples", type=int, default=3_000_000)
    parser.add_argument("--run", type=Path, default=Path("runs/scratch"), help="run directory; an old one goes on")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0)
    told = parser.parse_args()
    found = scratch(told.task, told.samples, told.run, seed=told.seed, threads=told.threads)
    told.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
