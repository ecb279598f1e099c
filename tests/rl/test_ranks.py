"""ranks.py: two processes that train together are one that has all the worlds; each goes on where it was."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from test_training import Found, Room, Run, Stage, untimed
from toy import Line

from kinetok.checkpoint import CheckpointError, load_state, unflatten
from kinetok.config import ConfigError
from kinetok.motion.library import ClipLibrary
from kinetok.presets import FIT
from kinetok.rl import ranks
from kinetok.rl.nets import Critic
from kinetok.rl.normalize import RunningNorm
from kinetok.rl.policy import Gaussian
from kinetok.rl.ppo import Optimizers, PPOConfig, update
from kinetok.rl.rollout import Rollout
from kinetok.tokenizers.fit import fit
from kinetok.tokenizers.tokenizer import MotionTokenizer

BOTH = 2
CLIPS = Path(__file__).parents[2] / "kinetok" / "assets" / "clips.safetensors"


def _begin(rank: int, task, out: Path, port: int, *given) -> None:
    told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": BOTH, "LOCAL_WORLD_SIZE": BOTH, "MASTER_PORT": port}
    os.environ |= {name: str(value) for name, value in told.items()} | {"MASTER_ADDR": "127.0.0.1"}
    torch.set_num_threads(1)
    with ranks.joined():
        torch.save(task(*given), out / f"{rank}.pt")
    # a thread of the group's that outlives it may abort the process as it ends, after all its work is done
    assert not [name for name in threads() if "gloo" in name]


def threads() -> list[str]:
    """Names of this process's threads, where the system tells them."""
    return [task.joinpath("comm").read_text() for task in Path("/proc/self/task").glob("*")]


def together(task, out: Path, *given) -> list:
    """What the task returns in each of two processes that torchrun could have started."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(_begin, (task, out, port, *given), nprocs=BOTH)
    return [torch.load(out / f"{rank}.pt", weights_only=True) for rank in range(BOTH)]


def test_alone_nothing_is_changed():
    tensor = torch.tensor([1.0, 3.0])
    ranks.average_((tensor,))
    ranks.alone("distillation")
    assert tensor.tolist() == [1.0, 3.0] and ranks.gathered(tensor) is tensor
    assert (ranks.size(), ranks.rank(), ranks.own(5), ranks.named("state"), ranks.share(3, "rows")) == (
        1, 0, 5, "state", 3,
    )  # fmt: skip


def calls():
    """What ranks tell each other."""
    mine = torch.tensor([float(ranks.rank()), 2.0])
    ranks.average_((mine,))
    assert mine.tolist() == [0.5, 2.0]
    assert ranks.gathered(torch.tensor([ranks.rank(), 7])).tolist() == [0, 7, 1, 7]
    assert ranks.first(lambda: {"by": ranks.rank()}) == {"by": 0}
    assert ranks.named("state") == ("state", "state-1")[ranks.rank()]
    assert (ranks.own(5) == 5) == (ranks.rank() == 0)
    assert ranks.share(4, "rows") == 2
    assert (ranks.threads(3), ranks.threads(0)) == (3, max((os.cpu_count() or 1) // 2, 1))
    with pytest.raises(ConfigError, match="rows is 3, which 2 processes cannot share evenly"):
        ranks.share(3, "rows")
    with pytest.raises(ConfigError, match="distillation is done by one process, and torchrun started 2"):
        ranks.alone("distillation")


def rollout_of(rows: slice) -> tuple[Rollout, torch.Tensor, torch.Tensor]:
    """Steps of eight rows that somebody took, of which these."""
    draw = torch.Generator().manual_seed(3)
    obs, action = torch.randn(4, 8, 2, generator=draw), torch.randn(4, 8, 1, generator=draw)
    log_prob = torch.randn(4, 8, generator=draw) * 0.1 - 1.0
    advantages, targets = torch.randn(4, 8, generator=draw), torch.randn(4, 8, generator=draw)
    taken = {"action": action[:, rows], "mean": 0.9 * action[:, rows], "log_prob": log_prob[:, rows]}
    none = torch.zeros(4, 8)[:, rows]
    rollout = Rollout(obs=obs[:, rows], taken=taken, rewards=none, values=none, next_values=none, done=none > 0,
                      last_obs=obs[-1, rows])  # fmt: skip
    return rollout, advantages[:, rows], targets[:, rows]


def learned() -> tuple[list[torch.Tensor], dict[str, float]]:
    """Weights and metrics after an update by the rollout, whole or this rank's half of it."""
    torch.manual_seed(0)
    rows = slice(4 * ranks.rank(), 4 * ranks.rank() + 4) if ranks.size() > 1 else slice(None)
    config = PPOConfig(horizon=4, epochs=2, minibatch=32, lr=1e-2, lr_max=1e-2)
    actor, critic = Line(0.1), Critic(2, [8])
    policy = Gaussian(actor, -0.5)
    rollout, advantages, targets = rollout_of(rows)
    optimizers, draws = Optimizers(policy, critic, config), torch.Generator().manual_seed(ranks.own(0))
    metrics = update(policy, critic, optimizers, rollout, advantages, targets, config, generator=draws)
    return [p.detach() for p in (*actor.parameters(), *critic.parameters())], metrics


def seen() -> dict[str, torch.Tensor]:
    """Statistics of two batches, whole or this rank's halves of them."""
    norm = RunningNorm(3)
    for seed in range(2):
        batch = torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(seed)) * 3 + 1
        norm.observe(batch[3 * ranks.rank() :][:3] if ranks.size() > 1 else batch)
    return norm.state_dict()


def trained(out: Path, samples: int) -> dict[str, torch.Tensor]:
    """What a run of both is after so many samples, of which the first rank alone evaluates and keeps."""
    run, asked = Run(out, stage=Stage(samples=samples)), []
    run.training.world = Room(seed=ranks.own(0))

    def evaluate() -> Found:
        asked.append(ranks.rank())
        return Found(float(samples + len(asked)))

    run.training.train(
        samples=samples, eval_every=256, evaluate=evaluate, keep=lambda score: run.kept.append(0), quiet=True
    )
    assert bool(asked) == bool(run.kept) == (ranks.rank() == 0)
    return run.actor.state_dict() | {"draws": run.training.generator.get_state()}


def moments(out: Path) -> None:
    """States that were not saved together are refused by both."""
    trained(out, 512)
    own = out / f"{ranks.named('state')}.safetensors"
    older = own.read_bytes()
    trained(out, 1024)
    if ranks.rank() == 1:
        own.write_bytes(older)
    with pytest.raises(CheckpointError, match="are of 1024 and 512 samples: they were not saved together"):
        trained(out, 2048)


def everything(out: Path) -> dict:
    calls()
    moments(out / "moments")
    whole, _ = trained(out / "whole", 1024), trained(out / "cut", 512)
    return {"update": learned(), "seen": seen(), "whole": whole, "cut": trained(out / "cut", 1024)}


def test_two_processes_are_one_that_has_all_the_worlds(tmp_path):
    one, two = together(everything, tmp_path, tmp_path)
    (weights, found), (others, also) = one["update"], two["update"]
    expected, metrics = learned()
    assert all(torch.equal(a, b) for a, b in zip(weights, others, strict=True)) and found == also
    for a, b in zip(weights, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)
    assert found == pytest.approx(metrics, rel=1e-4, abs=1e-6)
    for name, value in seen().items():
        torch.testing.assert_close(one["seen"][name], value)
        assert torch.equal(one["seen"][name], two["seen"][name])
    for rank in (one, two):  # resumed, each of them is where it was
        assert all(torch.equal(rank["whole"][name], rank["cut"][name]) for name in rank["whole"])
    assert torch.equal(one["whole"]["line.weight"], two["whole"]["line.weight"])
    assert not torch.equal(one["whole"]["draws"], two["whole"]["draws"])
    assert len(untimed(tmp_path / "whole")) == 8
    with pytest.raises(CheckpointError, match="ranks"):  # one process cannot go on from what two did
        Run(tmp_path / "cut", stage=Stage(samples=2048)).train()


def test_torchrun_trains_a_tokenizer(tmp_path, monkeypatch):
    ClipLibrary.write(tmp_path / "one.safetensors", [ClipLibrary.open(CLIPS).clip(0)])
    told = ["tokenize", "fit", "--preset", "tiny", "--clips", f"{tmp_path}/one.safetensors", "--out", f"{tmp_path}/run"]
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "kinetok.cli"]
    done = subprocess.run([*run, *told, "--stages", "ppo"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count("best stage: ppo") == 1
    MotionTokenizer.from_pretrained(tmp_path / "run")
    states = [load_state(tmp_path / "run" / "ppo" / f"{name}.safetensors") for name in ("state", "state-1")]
    one, two = (unflatten(tensors, meta["tree"])["actor"] for tensors, meta in states)
    assert one and all(torch.equal(one[name], two[name]) for name in one)
    assert states[0][1]["progress"] == states[1][1]["progress"]
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ConfigError, match="a teacher for each clip is done by one process"):
        fit([ClipLibrary.open(CLIPS).clip(0)], FIT["tiny"](), tmp_path / "teachers")
