"""Presets: plain functions of no arguments that return a whole configuration. `tiny` runs any stage in seconds.

    config = pick(FIT, "one-clip", "preset")()

Any leaf is then changed by `--set key=value`.
"""

from dataclasses import replace

from kinetok.adapters.cola import CoLAConfig
from kinetok.adapters.finetune import FinetuneConfig
from kinetok.adapters.hindsight import HindsightConfig
from kinetok.adapters.rlft import TokenPolicyConfig
from kinetok.adapters.sft import SFTConfig
from kinetok.gpt.pretrain import PretrainConfig
from kinetok.gpt.refine import RefineConfig
from kinetok.rl.ppo import PPOConfig
from kinetok.sim.env import EnvConfig
from kinetok.sim.reward import TrackingReward
from kinetok.sim.tasks.target import TargetConfig
from kinetok.sim.tasks.tracking import Failure
from kinetok.tokenizers.distill import DistillStage
from kinetok.tokenizers.fit import FitConfig
from kinetok.tokenizers.fsq import FSQConfig
from kinetok.tokenizers.quantizer import ContinuousConfig
from kinetok.tokenizers.tokenizer import TokenizerConfig
from kinetok.tokenizers.train import PPOStage


def one_clip() -> FitConfig:
    """One motion in minutes on two cores: a small teacher, a small student, no polishing."""
    return FitConfig(
        stages=("teacher", "distill"),
        teacher=PPOStage(
            samples=1_500_000,
            eval_every=65_000,
            eval_episodes=32,
            stop_success=1.0,
            stop_mpjpe_mm=32.0,
            patience=6,
            env=EnvConfig(reset_noise=0.01),
        ),
        distill=DistillStage(samples=150_000, eval_every=12_800, eval_episodes=32),
    )


def many_clips() -> FitConfig:
    """Dozens of motions in hours on two cores: an expert per clip, robust to pushes, and a wider student."""
    return FitConfig(
        tokenizer=TokenizerConfig(quantizer=FSQConfig(dim=12, levels=9), encoder=(512, 256), decoder=(512, 256)),
        teacher=PPOStage(
            samples=2_000_000,
            stop_success=1.0,
            stop_mpjpe_mm=30.0,
            patience=3,
            env=EnvConfig(reset_noise=0.02, push=0.5),
        ),
        distill=DistillStage(samples=5_000_000, rows=512, updates=2, minibatch=1024, memory=262_144, transitions=0.15,
                             reach_at_end=0.6, eval_every=500_000, eval_episodes=4, save_every=1_000_000,
                             env=EnvConfig(reset_noise=0.02, push=0.5)),
    )  # fmt: skip


def generalist() -> FitConfig:
    """One continuous expert of many clips, to teach others: what `teachers` know, gone on with by PPO on all clips."""
    return FitConfig(
        stages=("distill", "ppo"),
        tokenizer=replace(FitConfig().teacher_tokenizer, encoder=(512,), decoder=(256,),
                          encoder_inputs=("state", "window", "error")),
        distill=DistillStage(samples=1_000_000, rows=512, transitions=0.15, reach_at_end=0.6, eval_every=250_000,
                             eval_episodes=4, save_every=1_000_000, env=EnvConfig(reset_noise=0.02, push=0.3)),
        # The rate begins low and finds its own: at 4e-4 the first update after the critic's warm-up costs 7 to 12 nats.
        ppo=PPOStage(samples=8_000_000, eval_every=300_000, eval_episodes=4, critic_warmup=10, arrivals=0.25,
                     env=EnvConfig(reset_noise=0.02, push=0.3), ppo=PPOConfig(lr=1e-5)),
    )  # fmt: skip


def robust() -> FitConfig:
    """An expert that is not thrown over: PPO under pushes of up to 1.5 m/s, from one that can follow the clips.

    Where a push has moved the root to does not end an episode, and costs little: keeping upright comes first. Half
    again as hard as what it is to withstand: pushed by 1 m/s at most, it withstands half of those (docs/log.md).
    """
    return replace(
        generalist(),
        stages=("ppo",),
        ppo=PPOStage(
            samples=3_000_000, eval_every=500_000, eval_episodes=32, eval_push=1.0, critic_warmup=10,
            failure=Failure(largest=9.0, mean=0.4, slack=3.0), reward=TrackingReward(position=(0.5, -20.0)),
            env=EnvConfig(reset_noise=0.02, push=1.5, push_seconds=1.5),
            ppo=PPOConfig(lr=1e-5, gamma=0.98, horizon=32, minibatch=2048),
        ),
    )  # fmt: skip


def experts() -> FitConfig:
    """An expert for each motion, that begins as the packaged teacher, or with `teacher_start` as those in a folder.

    Much noise and little at the end, for a step is bounded in units of it; a kernel on the bodies' places that still
    pays at 50 mm; and episodes that go on at first with a body a metre from its place, for who is stopped there never
    learns to land, and end at last where the evaluation has them fail (docs/log.md, "An expert for each motion",
    "Where the bodies are", "Noise first, then precision").
    """
    return replace(
        many_clips(),
        stages=("teacher",),
        teacher_tokenizer=generalist().tokenizer,
        teacher_start="humanoid-teacher",
        teacher=PPOStage(
            samples=2_500_000, eval_every=250_000, eval_episodes=16, critic_warmup=10, log_std=(-2.3, -3.2),
            failure=Failure(largest=0.6, mean=0.3), leniency=2.0,
            reward=TrackingReward(position=(1.0, -100.0), height=(0.2, -40.0)), env=EnvConfig(reset_noise=0.01),
            ppo=PPOConfig(lr=1e-5),
        ),
    )  # fmt: skip


def from_scratch() -> FitConfig:
    """The paper's form: end-to-end PPO through the bottleneck from random weights, nothing else.

    With the latent of unit size (FSQ's `unit`): without, every code goes to its end, and one seed took twice as
    long.
    """
    return FitConfig(
        stages=("ppo",),
        tokenizer=TokenizerConfig(quantizer=FSQConfig(unit=True)),
        ppo=PPOStage(samples=3_000_000, log_std=(-2.3, -2.9), stop_success=1.0, stop_mpjpe_mm=40.0, eval_every=125_000,
                     eval_episodes=32),
    )  # fmt: skip


def tiny() -> FitConfig:
    """Seconds, for tests: nothing it makes can walk."""
    small = TokenizerConfig(quantizer=FSQConfig(dim=6, levels=5), encoder=(32,), decoder=(32,), future=(1, 2, 5))
    teacher = TokenizerConfig(
        quantizer=ContinuousConfig(dim=16),
        future=(1,),
        encoder=(32,),
        decoder=(),
        encoder_inputs=("window", "error"),
        decoder_inputs=(),
        residual=True,
    )
    stage = PPOStage(
        samples=1024, rows=32, eval_every=512, eval_episodes=2, critic=(32,), ppo=PPOConfig(horizon=8, minibatch=128)
    )
    return FitConfig(
        tokenizer=small,
        teacher_tokenizer=teacher,
        teacher=stage,
        distill=DistillStage(samples=640, rows=32, minibatch=64, memory=512, eval_every=320, eval_episodes=2),
        ppo=stage,
        workers=1,
    )


FIT = {
    "one-clip": one_clip,
    "many-clips": many_clips,
    "generalist": generalist,
    "robust": robust,
    "experts": experts,
    "from-scratch": from_scratch,
    "tiny": tiny,
}


def laptop() -> PretrainConfig:
    """A prior in ten minutes on two cores, half of it recorded while wandering, and not refined."""
    return PretrainConfig(
        width=128,
        layers=3,
        samples=600_000,
        code_noise=0.05,
        reach_at_end=0.6,
        wander=1.0,
        env=EnvConfig(reset_noise=0.02, push=0.3),
    )


def paper() -> PretrainConfig:
    """GPC's published size (table 10), for a GPU."""
    return PretrainConfig(width=1024, layers=6, heads=4, samples=20_000_000, iterations=200_000, ema=0.9)


def tiny_prior() -> PretrainConfig:
    """Seconds, for tests."""
    return PretrainConfig(
        width=16,
        layers=1,
        heads=2,
        samples=640,
        rows=32,
        iterations=20,
        batch=32,
        warmup=2,
        eval_every=10,
        refine=RefineConfig(rounds=1, rows=8, seconds=1.0, iterations=4, batch=16, episodes=4, survive=1.0),
    )


PRETRAIN = {"laptop": laptop, "paper": paper, "tiny": tiny_prior}


def laptop_skill() -> FinetuneConfig:
    """Demonstrations in eight minutes of one core, then reward in fifty-six of two, of which the critic has the first
    two to itself; after half of it, it does most of what it will: docs/tutorial.md."""
    return FinetuneConfig(
        task=TargetConfig(full=0.3),  # where a reward is flat nothing keeps a body from drifting out (docs/skills.md)
        adapter=CoLAConfig(rank=32, alpha=64.0),
        hindsight=HindsightConfig(rounds=2, iterations=600, samples=400_000, memory=6, restless=(0.4, 6.0)),
        policy=TokenPolicyConfig(top_p=0.97, least=8, temperature=0.8),
        samples=3_932_160,
        eval_every=196_608,
        eval_episodes=96,
        critic_warmup=15,
        ema=0.99,
        ppo=replace(FinetuneConfig().ppo, target_kl=0.01, lr_max=1e-3, critic_lr=2e-3, lam=0.97),
    )


def gpu_skill() -> FinetuneConfig:
    """The laptop's rollouts in half as many steps of twice as many worlds, and twice as many of them: for
    --device cuda and some cores. Larger rollouts are not worth their time: what bounds a step is how far the policy
    may move (docs/gpu.md)."""
    laptop = laptop_skill()
    return replace(
        laptop,
        samples=4_194_304,
        rows=1024,
        eval_every=1_048_576,
        save_every=2_097_152,
        ppo=replace(laptop.ppo, horizon=16),
    )


def paper_skill() -> FinetuneConfig:
    """GPC's published adapter (table 12), for a GPU."""
    return FinetuneConfig(adapter=CoLAConfig(rank=64, alpha=128.0), samples=100_000_000, rows=4096)


def tiny_skill() -> FinetuneConfig:
    """Seconds, for tests."""
    return FinetuneConfig(
        adapter=CoLAConfig(rank=2, alpha=4.0, hidden=8),
        sft=SFTConfig(samples=320, rows=16, iterations=10, batch=32, eval_every=5),
        hindsight=HindsightConfig(rounds=2, rows=16, seconds=2.0, iterations=10, batch=32, samples=640),
        samples=512,
        rows=32,
        eval_every=256,
        save_every=1,
        eval_episodes=4,
        eval_seconds=1.0,
        critic=(16,),
        critic_warmup=0,
        ppo=PPOConfig(horizon=8, minibatch=64, epochs=1),
    )


FINETUNE = {"laptop": laptop_skill, "gpu": gpu_skill, "paper": paper_skill, "tiny": tiny_skill}
