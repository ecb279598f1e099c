"""New motion: `kinetok sample`, of a prior or of a skill."""

import json
from pathlib import Path

import click

from kinetok.cli.shared import (
    COUNT,
    PATHS,
    POSITIVE,
    PUSH,
    SECONDS,
    SHARE,
    VIDEOS,
    check_suffix,
    option_device,
    option_seed,
    show_json,
    write_motion,
)


@click.command()
@click.option("--prior", default=None, type=PATHS, help="Directory or packaged name.  [default: humanoid-gpt]")
@click.option("--adapter", default=None, type=PATHS, help="A fine-tuned skill to play instead of the prior alone.")
@click.option("--tokenizer", default=None, type=PATHS, help="Where its tokenizer is, if not where it was trained.")
@click.option("--out", required=True, type=PATHS, help="Video to write (.mp4, .gif); motion and metrics go beside it.")
@click.option("--seconds", default=10.0, show_default=True, type=SECONDS, help="Length of the motion.")
@click.option(
    "--top-p", default=None, type=SHARE, help="Nucleus of the next tokens.  [default: 0.9, or the skill's own]"
)
@click.option("--temperature", default=None, type=POSITIVE, help="Above 1 is bolder, below 1 more usual.  [default: 1]")
@click.option(
    "--count", default=1, show_default=True, type=COUNT, help="Characters; each becomes a clip, the first the video."
)
@click.option(
    "--push", default=0.0, type=PUSH, help="Push the character, in m/s: at 6.7 s, with --adapter every two seconds."
)
@option_seed
@option_device
def sample(prior, adapter, tokenizer, out, seconds, top_p, temperature, count, push, seed) -> None:
    """New motion from the prior, simulated: a video, OUT.safetensors (the clips) and OUT.json (metrics).

    With --adapter the character does its task, and the video shows what is asked of it; the nucleus and the
    temperature are those it was trained with, unless you say otherwise.
    """
    check_suffix(out, *VIDEOS)
    _refuse_another_motion(out)
    drawn = {name: value for name, value in (("top_p", top_p), ("temperature", temperature)) if value is not None}
    if adapter is not None:
        return sample_skill(adapter, prior, tokenizer, out, drawn, seconds=seconds, count=count, push=push, seed=seed)
    from kinetok.evaluate import measure
    from kinetok.gpt.controller import Prior, roll
    from kinetok.motion.clip import Clip

    prior = prior or "humanoid-gpt"
    drawn = {"top_p": 0.9, "temperature": 1.0} | drawn
    model = Prior.from_pretrained(prior, tokenizer)
    character = model.tokenizer.config.character
    top_p, temperature = drawn["top_p"], drawn["temperature"]
    recording = roll(model, rows=count, seconds=seconds, top_p=top_p, temperature=temperature, push=push, seed=seed)
    motion = [
        Clip(name=f"sample{i}", character=character, fps=recording.fps, qpos=recording.qpos[:, i], source=str(prior))
        for i in range(count)
    ]
    write_motion(out, motion[0])
    write_motion(out.with_suffix(".safetensors"), *motion)
    show_json(measure(recording) | {"seed": seed, "prior": str(prior), **drawn}, out.with_suffix(".json"))


def _refuse_another_motion(out: Path) -> None:
    """Refuse where the clips would go over a library that no earlier `sample` has written: it has no figures."""
    clips, figures = out.with_suffix(".safetensors"), out.with_suffix(".json")
    try:
        known = "seed" in json.loads(figures.read_text()) if figures.exists() else not clips.exists()
    except (OSError, ValueError):
        known = False
    if not known:
        there = clips if clips.exists() else figures
        raise ValueError(
            f"--out {out}: its motion goes to {clips} and its figures to {figures}, and {there} is another file; "
            "choose another name"
        )


def sample_skill(adapter, prior, tokenizer, out: Path, drawn: dict, *, seconds, count, push, seed) -> None:
    """`sample --adapter`: the first character's video with markers, every character's clip, and the scores.

    drawn: settings of how tokens are drawn that replace the skill's own.
    """
    from dataclasses import replace

    from kinetok.adapters.rlft import play
    from kinetok.adapters.skill import Skill
    from kinetok.config import to_dict
    from kinetok.motion.clip import Clip
    from kinetok.render.video import render_task, write_video

    skill = Skill.from_pretrained(adapter, prior, tokenizer)
    skill = replace(skill, policy=replace(skill.policy, **drawn))
    played = play(
        skill.controller(seed), skill.task, skill.prior,
        episodes=count, seconds=seconds, push=push, seed=seed, record=count,
    )  # fmt: skip
    body, name, character = skill.prior.character, skill.task.kind, skill.prior.tokenizer.config.character
    frames = render_task(body, played.qpos[:, 0], played.markers, fps=played.fps, caption=name)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_video(out, frames, played.fps)
    click.echo(f"wrote {out}: {len(played.qpos)} frames at {played.fps:g} fps")
    motion = [
        Clip(name=f"{name}{i}", character=character, fps=played.fps, qpos=played.qpos[:, i], source=str(adapter))
        for i in range(count)
    ]
    write_motion(out.with_suffix(".safetensors"), *motion)
    told = {"task": name, "push_mps": push, "seed": seed, "adapter": str(adapter)} | to_dict(skill.policy)
    show_json(played.score.measures | told, out.with_suffix(".json"))
