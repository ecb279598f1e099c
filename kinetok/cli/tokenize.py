"""Commands about tokens: `kinetok tokenize fit|encode|decode`."""

import click

from kinetok.cli.shared import (
    EXPORTS,
    PATHS,
    SECONDS,
    VIDEOS,
    Chain,
    check_suffix,
    configured,
    load_clips,
    one_clip,
    option_hours,
    say,
    write_motion,
)


@click.group(cls=Chain)
def tokenize() -> None:
    """Learn motion tokens through physics, and use them."""


@tokenize.command("fit")
@click.option("--clips", "paths", multiple=True, required=True, type=PATHS, help="Motion file, library or folder.")
@option_hours
@click.option("--out", required=True, type=PATHS, help="Run directory; an interrupted run goes on from it.")
@click.option("--stages", default=None, help="Of teacher,distill,ppo; ppo alone is the paper's end-to-end form.")
@configured("one-clip")
def tokenize_fit(paths, hours, out, stages, preset, settings, threads, seed) -> None:
    """Train a tokenizer: encoder, FSQ bottleneck and decoder, through the simulated tracking loop.

    \b
    Presets: one-clip (minutes), many-clips (hours), generalist (one teacher
    for many), robust (a teacher that withstands pushes, from another one),
    experts (one for each clip, from the packaged teacher, or from others:
    --set teacher_start=runs/hard/teachers),
    from-scratch (end-to-end PPO alone), tiny (tests).
    Examples: kinetok tokenize fit --clips walk.txt --out runs/walk --set teacher.samples=1500000
    kinetok tokenize fit --clips walk.txt --out runs/robust --preset robust --set start=humanoid-teacher
    PPO in four processes: torchrun --nproc-per-node 4 -m kinetok.cli tokenize fit --stages ppo --clips ... --out ...
    """
    from kinetok import presets
    from kinetok.config import override, pick
    from kinetok.rl.ranks import joined
    from kinetok.tokenizers.fit import fit

    if stages:
        settings = (*settings, f"stages={stages}")
    config = override(pick(presets.FIT, preset, "preset")(), settings)
    clips = load_clips(paths, hours, seed)
    with joined():
        fit(clips, config, out, seed=seed, threads=threads)


@tokenize.command("encode")
@click.argument("clip", type=PATHS)
@click.option("--tokenizer", required=True, type=PATHS, help="Artifact directory or packaged name.")
@click.option("--out", required=True, type=PATHS, help="Token file to write, ending in .safetensors.")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
@click.option("--seconds", type=SECONDS, default=None, help="How long to track; default once through the clip.")
def tokenize_encode(clip, tokenizer, out, name, seconds) -> None:
    """Write the tokens of a clip: (T, S) int64, one row per control step, with their layout."""
    from kinetok.tokenizers.codec import encode_clip
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    check_suffix(out, ".safetensors")
    motion = one_clip(clip, name)
    stream = encode_clip(MotionTokenizer.from_pretrained(tokenizer), motion, seconds=seconds)
    stream.save(out)
    steps, positions = stream.tokens.shape
    click.echo(f"wrote {out}: {steps} control steps of {positions} tokens, from {stream.layout.vocabulary} each")
    if stream.lost:
        say(
            f"{motion.name}: the track was lost after {steps / stream.fps:.1f} s, and the tokens end there. `kinetok "
            "evaluate tracking` tells what this tokenizer follows; `kinetok tokenize fit` teaches one this motion"
        )


@tokenize.command("decode")
@click.argument("tokens", type=PATHS)
@click.option("--tokenizer", required=True, type=PATHS, help="The tokenizer that wrote the tokens.")
@click.option("--out", required=True, type=PATHS, help=".safetensors (clip library), .mp4, .gif, .bvh, .csv or .npz.")
def tokenize_decode(tokens, tokenizer, out) -> None:
    """Play tokens in simulation from their first state; no reference is involved."""
    from kinetok.motion.clip import Clip
    from kinetok.tokenizers.codec import TokenStream, decode_tokens
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    check_suffix(out, ".safetensors", *VIDEOS, *EXPORTS)
    if out.exists() and out.resolve() == tokens.resolve():
        raise ValueError(f"--out {out} holds the tokens themselves; choose another name")
    stream = TokenStream.load(tokens)
    model = MotionTokenizer.from_pretrained(tokenizer)
    qpos, character = decode_tokens(model, stream), model.config.character
    write_motion(out, Clip(name=stream.name, character=character, fps=stream.fps, qpos=qpos, source="simulated"))
