"""The demo: everything from the package alone, in under two minutes on two cores and with no display.

    run_demo(Path("kinetok-demo"))

It tracks a packaged clip, prints its tokens, plays the tokens back without the clip, lets the prior move the
character by itself, has an adapter of the prior walk to targets, and writes a video of each and a small table. The
packaged clips are recordings of our own simulated roll-outs.
"""

import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from kinetok.adapters.rlft import play
from kinetok.adapters.skill import Skill
from kinetok.checkpoint import PACKAGED
from kinetok.evaluate import measure
from kinetok.gpt.controller import Prior, roll
from kinetok.metrics import mpjpe_mm
from kinetok.motion.kinematics import kinematics
from kinetok.motion.library import ClipLibrary
from kinetok.render.video import render_frames, render_task, write_strip, write_video
from kinetok.tokenizers.codec import decode_tokens, encode_clip

CLIPS = PACKAGED / "clips.safetensors"
PRIOR = "humanoid-gpt"
SKILL = "humanoid-target"


def run_demo(out: Path, *, seconds: float = 8.0, seed: int = 0, console: Console | None = None) -> dict[str, float]:
    """Write tracked.mp4, sampled.mp4, sampled.png (stills) and target.mp4 into `out`; returns the table's numbers."""
    console = console or Console()
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    prior = Prior.from_pretrained(PRIOR)
    tokenizer, body, fps = prior.tokenizer, prior.character, prior.fps
    library = ClipLibrary.open(CLIPS)
    clip = library.clip(0)

    console.print(f"[bold]1.[/] Tracking the packaged clip {clip.name!r} in simulation, token by token")
    stream = encode_clip(tokenizer, clip, seconds=min(seconds, clip.seconds))
    reference = clip.at(np.arange(len(stream.simulated)) / fps)
    error = mpjpe_mm(kinematics(body, stream.simulated, fps).xpos, kinematics(body, reference, fps).xpos)
    for step in range(3):
        console.print(f"   t = {step / fps:.2f} s   tokens {stream.tokens[step].tolist()}")
    console.print(f"   ... {len(stream.tokens)} steps of {stream.layout.tokens_per_step} tokens")

    console.print("[bold]2.[/] Playing the tokens back, without the clip")
    played = decode_tokens(tokenizer, stream)
    same = float(np.abs(played - stream.simulated).max())
    frames = render_frames(body, played, fps=fps, ghost=reference, caption=f"tokens of {clip.name} (ghost: the clip)")
    write_video(out / "tracked.mp4", frames, fps)

    console.print(f"[bold]3.[/] Sampling {seconds:g} s of new motion from the prior")
    recording = roll(prior, rows=8, seconds=seconds, seed=seed)
    best = int(np.argmax(np.linalg.norm(recording.pos[-1, :, 0, :2] - recording.pos[0, :, 0, :2], axis=-1)))
    frames = render_frames(body, recording.qpos[:, best], fps=fps, caption="sampled from the prior")
    write_video(out / "sampled.mp4", frames, fps)
    write_strip(out / "sampled.png", body, recording.qpos[: 4 * fps, best], columns=8)

    console.print(f"[bold]4.[/] Walking to targets for {2 * seconds:g} s, with an adapter of the prior")
    skill = Skill.from_pretrained(SKILL)
    done = play(skill.controller(seed), skill.task, skill.prior, episodes=16, seconds=2 * seconds, seed=seed, record=1)
    frames = render_task(body, done.qpos[:, 0], done.markers, fps=fps, caption="target")
    write_video(out / "target.mp4", frames, fps)

    sampled, reached = measure(recording), done.score.measures["success_rate"]
    numbers = {
        "tracked_mpjpe_mm": error,
        "replay_difference": same,
        "sampled_upright": sampled["survival_rate"],
        "sampled_path_m": sampled["path_m"],
        "targets_reached": reached,
        "seconds": time.monotonic() - started,
    }
    table = Table(show_header=False)
    table.add_row("tracked clip", f"{clip.name}, {len(stream.tokens) / fps:.1f} s")
    table.add_row("MPJPE of the tracked clip", f"{error:.0f} mm")
    table.add_row("replay from tokens alone differs by", f"{same:.1e}")
    table.add_row("tokens a second", f"{fps * stream.layout.tokens_per_step} of {stream.layout.vocabulary}")
    table.add_row(f"upright after {seconds:g} s of sampling", f"{100 * sampled['survival_rate']:.0f} % of 8")
    table.add_row("distance covered while sampling", f"{sampled['path_m']:.1f} m")
    table.add_row("targets reached", f"{100 * reached:.0f} % of {done.score.measures['counts']['success_rate']}")
    table.add_row("videos", f"{out / 'tracked.mp4'}, {out / 'sampled.mp4'}, {out / 'target.mp4'}")
    table.add_row("time", f"{numbers['seconds']:.0f} s")
    console.print(table)
    return numbers
