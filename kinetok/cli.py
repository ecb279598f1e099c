"""The command line. Each command is a thin call of one library function; `--help` teaches the chain:

clips -> tokenize fit -> pretrain -> sample, with evaluate at every link.
"""

import json
import os
import sys
from pathlib import Path

# Set before any library starts its threads: spinning OpenMP workers would steal the physics threads' cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import click

from kinetok import __version__


class Chain(click.Group):
    """Lists commands in the order of the chain, and turns the library's errors into one clear line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def invoke(self, ctx: click.Context):
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except Exception as error:
            from kinetok.checkpoint import CheckpointError

            expected = (ValueError, CheckpointError, OSError, FloatingPointError, ImportError)
            if os.environ.get("KINETOK_TRACEBACK") or not isinstance(error, expected):
                raise
            raise click.ClickException(str(error)) from error


NATURAL = click.IntRange(min=0)
option_seed = click.option(
    "--seed", default=0, show_default=True, type=NATURAL, help="Seeds weights, worlds and noise; the same repeats it."
)
option_threads = click.option(
    "--threads",
    default=0,
    show_default=True,
    type=NATURAL,
    help="Threads of physics and networks; 0 is every core. Physics is the same at any; a network's sums differ "
    "in the last bits.",
)


def configured(presets: str):
    """--preset, --set, --seed and --threads, the same on every training command."""

    def decorate(command):
        command = option_seed(option_threads(command))
        command = click.option(
            "--set",
            "settings",
            multiple=True,
            metavar="KEY=VALUE",
            help="Change one setting, e.g. teacher.samples=1000000.",
        )(command)
        return click.option("--preset", default=presets, show_default=True, help="Where the settings start from.")(
            command
        )

    return decorate


def load_clips(paths: tuple[Path, ...], character: str | None = None, fps: float | None = None):
    from kinetok.motion.formats import read_clips

    found = [clip for path in paths for clip in read_clips(path, character, fps=fps)]
    for clip in found:
        if "assumed" in clip.source:
            click.echo(f"{clip.name}: {clip.source}", err=True)
    return found


def check_suffix(out: Path, *allowed: str) -> None:
    """Refuse a file name before any work is done for it."""
    if out.suffix not in allowed:
        raise ValueError(f"--out {out}: the name must end in {' or '.join(allowed)}")


def show_json(data: dict, out: Path | None) -> None:
    text = json.dumps(data, indent=1)
    if out is None:
        click.echo(text)
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.tmp")
    temporary.write_text(text + "\n")
    temporary.replace(out)
    click.echo(f"wrote {out}")


PATHS = click.Path(path_type=Path)
EXPORTS = (".bvh", ".csv", ".npz")  # of programs other than this one


@click.group(cls=Chain, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="kinetok")
def main() -> None:
    """Motion of physically simulated characters, as tokens.

    \b
    kinetok demo                                         what it does, in a minute
    kinetok clips info walk.txt                          look at a motion
    kinetok tokenize fit --clips walk.txt --out runs/w   learn tokens through physics
    kinetok pretrain --tokenizer runs/w --clips walk.txt --out runs/g
    kinetok sample --prior runs/g --out sample.mp4       new motion, simulated
    """


@main.group(cls=Chain)
def clips() -> None:
    """Look at motion files and gather them into one library."""


@clips.command("info")
@click.argument("paths", nargs=-1, required=True, type=PATHS)
def clips_info(paths: tuple[Path, ...]) -> None:
    """Frames, rate, duration and ground clearance of motion files, libraries or folders of them."""
    from kinetok.motion.character import Character
    from kinetok.motion.kinematics import lowest_point

    click.echo(f"{'name':<22}{'frames':>7}{'fps':>8}{'seconds':>9}{'loop':>6}{'lowest m':>10}{'path m':>8}  source")
    for clip in load_clips(paths):
        low = lowest_point(Character.load(clip.character), clip.qpos).min()
        steps = ((clip.qpos[1:, :2] - clip.qpos[:-1, :2]) ** 2).sum(1) ** 0.5
        click.echo(
            f"{clip.name:<22}{len(clip.qpos):>7}{clip.fps:>8.2f}{clip.seconds:>9.2f}{'yes' if clip.loop else 'no':>6}"
            f"{low:>z10.3f}{steps.sum():>8.2f}  {clip.source}"
        )


@clips.command("check")
@click.argument("paths", nargs=-1, required=True, type=PATHS)
@click.option(
    "--fix",
    is_flag=True,
    default=False,
    show_default=True,
    help="Repair what has one right repair and write the rest with it; needs --out.",
)
@click.option("--out", default=None, type=PATHS, help="Library of the repaired motion, ending in .safetensors.")
@click.option("--character", default=None, help="Body to retarget foreign skeletons to.  [default: humanoid]")
@click.option("--fps", type=float, default=None, help="Frame rate of files that name none (robot CSV, AMC).")
def clips_check(paths: tuple[Path, ...], fix: bool, out: Path | None, character: str | None, fps: float | None) -> None:
    """Look for what is wrong with motion: lead-ins, jumps, spikes, units, up axis, floor, duplicates.

    What has one right repair is repaired by --fix (and by every command that reads recorded skeletons); the rest is
    refused with its frame and joint. Exits with 1 where anything was refused.
    """
    from kinetok.motion.check import check, report
    from kinetok.motion.duplicates import duplicates
    from kinetok.motion.formats import read

    if fix != (out is not None):
        raise ValueError("--fix writes what it repairs: give both --fix and --out F.safetensors")
    motions = [motion for path in paths for motion in read(path, fps=fps)]
    refused = set()
    for motion in motions:
        findings = check(motion)
        refused |= {motion.name} if any(f.severity == "refused" for f in findings) else set()
        click.echo(f"{motion.name}\n  " + report(findings).replace("\n", "\n  "))
    for pair in duplicates(motions):
        part, whole = motions[pair.part].name, motions[pair.whole].name
        click.echo(f"{part} is in {whole} from {pair.start:.2f} s on{', mirrored' if pair.mirrored else ''}")
    if out is not None:
        write_fixed(out, motions, refused, character)
    if refused:
        raise click.exceptions.Exit(1)


def write_fixed(out: Path, motions: list, refused: set[str], character: str | None) -> None:
    """A library of the motions that were not refused, mended."""
    from kinetok.motion.check import mend
    from kinetok.motion.library import ClipLibrary
    from kinetok.motion.retarget import retarget
    from kinetok.motion.skeleton import SkeletonMotion

    check_suffix(out, ".safetensors")
    mended = [mend(motion)[0] for motion in motions if motion.name not in refused]
    if not mended:
        raise ValueError(f"--out {out}: every motion was refused, there is nothing to write")
    fitted = [retarget(m, character or "humanoid").clip if isinstance(m, SkeletonMotion) else m for m in mended]
    ClipLibrary.write(out, fitted)
    click.echo(f"wrote {out}: {len(fitted)} clips; left out: {', '.join(sorted(refused)) or 'none'}")


@clips.command("import")
@click.argument("paths", nargs=-1, required=True, type=PATHS)
@click.option("--out", required=True, type=PATHS, help="The library to write, ending in .safetensors.")
@click.option("--character", default=None, help="Body to retarget foreign skeletons to.  [default: humanoid]")
@click.option("--fps", type=float, default=None, help="Frame rate of files that name none (robot CSV, AMC).")
def clips_import(paths: tuple[Path, ...], out: Path, character: str | None, fps: float | None) -> None:
    """Read motion files of any known format and write one memory-mapped library.

    \b
    BVH, ASF/AMC, AMASS npz, poselib npy          retargeted to --character
    DeepMimic txt, robot CSV, MimicKit, GMR, ...  of the body they were made for
    """
    from kinetok.motion.library import ClipLibrary

    check_suffix(out, ".safetensors")
    found = load_clips(paths, character, fps)
    ClipLibrary.write(out, found)
    click.echo(f"wrote {out}: {len(found)} clips, {sum(c.seconds for c in found):.1f} s")


@clips.command("vary")
@click.argument("source", type=PATHS)
@click.option("--out", required=True, type=PATHS, help="The library to write, ending in .safetensors.")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
@click.option("--seconds", default=60.0, show_default=True, help="Length of the motion.")
@click.option("--turn", default=60.0, show_default=True, help="Degrees per second it turns at most, to either side.")
@click.option("--tempo", default=1.2, show_default=True, help="How many times as fast or as slow it plays at most.")
@click.option("--halt", default=0.0, show_default=True, help="Seconds between two halts on average; 0 for none.")
@option_seed
def clips_vary(source: Path, out: Path, name: str | None, seconds, turn, tempo, halt, seed) -> None:
    """Make one long motion of a gait cycle: turning, hurrying, lingering, halting.

    \b
    A prior of straight walks has nothing to choose from; one of varied walks can be steered.
    kinetok clips vary walk.txt --halt 6 --out walk-varied.safetensors
    """
    from kinetok.motion.library import ClipLibrary
    from kinetok.motion.vary import vary

    check_suffix(out, ".safetensors")
    varied = vary(one_clip(source, name), seconds=seconds, turn=turn, tempo=tempo, halt=halt, seed=seed)
    ClipLibrary.write(out, [varied])
    click.echo(f"wrote {out}: {varied.name}, {varied.seconds:.1f} s")


@clips.command("export")
@click.argument("source", type=PATHS)
@click.option("--out", required=True, type=PATHS, help="File to write: .bvh, .csv (robot) or .npz (AMASS-like).")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
def clips_export(source: Path, out: Path, name: str | None) -> None:
    """Write a clip, recorded or simulated, for Blender (.bvh), a robot (.csv) or SMPL tools (.npz).

    \b
    .bvh   the character's own joints
    .csv   of the Unitree G1, at 30 fps
    .npz   SMPL's joints: the character's directions in the lengths of an average body
    """
    check_suffix(out, *EXPORTS)
    write_motion(out, one_clip(source, name))


@clips.command("play")
@click.argument("source", type=PATHS)
@click.option("--out", required=True, type=PATHS, help="Video to write, ending in .mp4.")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
@click.option("--seconds", type=float, default=None, help="How much of it; default all, a loop three times.")
def clips_play(source: Path, out: Path, name: str | None, seconds: float | None) -> None:
    """Render a motion file to a video, as it was recorded and without physics."""
    from dataclasses import replace

    import numpy as np

    check_suffix(out, ".mp4")
    clip = one_clip(source, name)
    seconds = seconds or clip.seconds * (3 if clip.loop else 1)
    qpos = clip.at(np.arange(0, seconds, 1 / 30))
    write_motion(out, replace(clip, qpos=qpos, fps=30.0, loop=False), caption=clip.name)


def one_clip(source: Path, name: str | None):
    """The clip of that name in a file or library, or its only one."""
    from kinetok.config import nearest

    found = load_clips((source,))
    names = [clip.name for clip in found]
    if name is None and len(found) > 1:
        raise ValueError(f"{source} holds {len(found)} clips; choose one with --name: {', '.join(names[:12])}")
    if name is not None and name not in names:
        raise ValueError(f"{source} holds no clip {name!r}{nearest(name, names)}")
    return found[names.index(name) if name else 0]


@main.group(cls=Chain)
def characters() -> None:
    """Look at characters: the built-in ones, or any MJCF with a roles file (docs/characters.md)."""


@characters.command("list")
def characters_list() -> None:
    """Names and sizes of the built-in characters."""
    from kinetok.motion.character import Character
    from kinetok.motion.character import characters as built_in

    click.echo(f"{'name':<12}{'bodies':>7}{'driven':>8}{'mass kg':>9}{'height m':>10}")
    for name in built_in():
        body = Character.load(name)
        height, mass = body.span(body.stand())[1], body.model.body_mass.sum()
        click.echo(f"{name:<12}{len(body.body_names):>7}{body.nu:>8}{mass:>9.2f}{height:>10.2f}")


@characters.command("show")
@click.argument("name")
@click.option("--out", default=None, type=PATHS, help="Also write a picture of it standing, ending in .png.")
def characters_show(name: str, out: Path | None) -> None:
    """Facts of a character: NAME is built in, the path of an MJCF, or menagerie:ROBOT."""
    from kinetok.motion.character import Character
    from kinetok.render.portrait import describe, write_portrait

    if out is not None:
        check_suffix(out, ".png")
    body = Character.load(name)
    click.echo(describe(body))
    if out is not None:
        write_portrait(out, body)
        click.echo(f"wrote {out}")


@main.group(cls=Chain)
def tokenize() -> None:
    """Learn motion tokens through physics, and use them."""


@tokenize.command("fit")
@click.option("--clips", "paths", multiple=True, required=True, type=PATHS, help="Motion file, library or folder.")
@click.option("--out", required=True, type=PATHS, help="Run directory; an interrupted run goes on from it.")
@click.option("--stages", default=None, help="Of teacher,distill,ppo; ppo alone is the paper's end-to-end form.")
@configured("one-clip")
def tokenize_fit(paths, out, stages, preset, settings, threads, seed) -> None:
    """Train a tokenizer: encoder, FSQ bottleneck and decoder, through the simulated tracking loop.

    \b
    Presets: one-clip (minutes), many-clips (hours), from-scratch (end-to-end PPO alone), tiny (tests).
    Example: kinetok tokenize fit --clips walk.txt --out runs/walk --set teacher.samples=1500000
    """
    from kinetok import presets
    from kinetok.config import override, pick
    from kinetok.tokenizers.fit import fit

    if stages:
        settings = (*settings, f"stages={stages}")
    config = override(pick(presets.FIT, preset, "preset")(), settings)
    fit(load_clips(paths), config, out, seed=seed, threads=threads)


@tokenize.command("encode")
@click.argument("clip", type=PATHS)
@click.option("--tokenizer", required=True, type=PATHS, help="Artifact directory or packaged name.")
@click.option("--out", required=True, type=PATHS, help="Token file to write, ending in .safetensors.")
@click.option("--seconds", type=float, default=None, help="How long to track; default once through the clip.")
def tokenize_encode(clip, tokenizer, out, seconds) -> None:
    """Write the tokens of a clip: (T, S) int64, one row per control step, with their layout."""
    from kinetok.tokenizers.codec import encode_clip
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    check_suffix(out, ".safetensors")
    found = load_clips((clip,))
    if len(found) > 1:
        raise ValueError(f"{clip} holds {len(found)} clips; encode one at a time")
    stream = encode_clip(MotionTokenizer.from_pretrained(tokenizer), found[0], seconds=seconds)
    stream.save(out)
    click.echo(f"wrote {out}: tokens {tuple(stream.tokens.shape)}, {stream.layout}")


@tokenize.command("decode")
@click.argument("tokens", type=PATHS)
@click.option("--tokenizer", required=True, type=PATHS, help="The tokenizer that wrote the tokens.")
@click.option("--out", required=True, type=PATHS, help=".safetensors (clip library), .mp4, .bvh, .csv or .npz.")
def tokenize_decode(tokens, tokenizer, out) -> None:
    """Play tokens in simulation from their first state; no reference is involved."""
    from kinetok.motion.clip import Clip
    from kinetok.tokenizers.codec import TokenStream, decode_tokens
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    check_suffix(out, ".safetensors", ".mp4", *EXPORTS)
    stream = TokenStream.load(tokens)
    model = MotionTokenizer.from_pretrained(tokenizer)
    qpos, character = decode_tokens(model, stream), model.config.character
    write_motion(out, Clip(name=stream.name, character=character, fps=stream.fps, qpos=qpos, source="simulated"))


def write_motion(out: Path, *clips, caption: str = "") -> None:
    """Write clips as a library, or one clip as a video or for other programs, by the file's suffix."""
    from dataclasses import replace

    from kinetok.motion.character import Character
    from kinetok.motion.export import skeleton_motion, smpl_motion
    from kinetok.motion.formats.amass import write_amass
    from kinetok.motion.formats.bvh import write_bvh
    from kinetok.motion.formats.robot_csv import write_robot_csv
    from kinetok.motion.library import ClipLibrary

    check_suffix(out, ".safetensors", ".mp4", *EXPORTS)
    clip, *others = clips
    character = Character.load(clip.character)
    if out.suffix == ".safetensors":
        ClipLibrary.write(out, clips)
    elif others:
        raise ValueError(f"--out {out}: {len(clips)} clips; of the files written here only .safetensors holds many")
    elif out.suffix == ".mp4":
        from kinetok.render.video import render_frames, write_video

        out.parent.mkdir(parents=True, exist_ok=True)
        write_video(out, render_frames(character, clip.qpos, fps=clip.fps, caption=caption), clip.fps)
    elif out.suffix == ".bvh":
        write_bvh(out, skeleton_motion(character, clip))
    elif out.suffix == ".npz":
        write_amass(out, smpl_motion(character, clip))
    else:
        if abs(clip.fps / 30 - 1) > 1e-3:  # the file carries no rate
            clip = replace(clip, loop=False).resample(30.0)
        write_robot_csv(out, clip)
    told = f"{len(clip.qpos)} frames at {clip.fps:g} fps"
    if others:
        told = f"{len(clips)} clips, {sum(c.seconds for c in clips):.1f} s"
    click.echo(f"wrote {out}: {told}")


@main.command()
@click.option("--tokenizer", required=True, type=PATHS, help="Artifact directory or packaged name.")
@click.option("--clips", "paths", multiple=True, required=True, type=PATHS, help="Motion file, library or folder.")
@click.option("--out", required=True, type=PATHS, help="Run directory; an interrupted run goes on from it.")
@configured("laptop")
def pretrain(tokenizer, paths, out, preset, settings, threads, seed) -> None:
    """Train the prior: a GPT over the tokens of the frozen tracker's own roll-outs.

    \b
    Example: kinetok pretrain --tokenizer runs/walk --clips walk.txt --out runs/prior
    """
    from kinetok import presets
    from kinetok.config import override, pick
    from kinetok.gpt.pretrain import pretrain as train
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    config = override(pick(presets.PRETRAIN, preset, "preset")(), settings)
    train(
        MotionTokenizer.from_pretrained(tokenizer),
        load_clips(paths),
        config,
        out,
        tokenizer_path=tokenizer,
        seed=seed,
        threads=threads,
    )


TASK_NAMES = "target|steering|path"


@main.command()
@click.option("--prior", default=None, type=PATHS, help="Directory or packaged name.  [default: humanoid-gpt]")
@click.option("--task", default=None, metavar=TASK_NAMES, help="What to do.  [default: target, or that of --from]")
@click.option(
    "--adapter", default=None, metavar="cola|lora|dora|full", help="What bends it.  [default: cola, or that of --from]"
)
@click.option("--method", default="rl", show_default=True, help="Of sft,hindsight,rl, in this order.")
@click.option(
    "--clips", "paths", multiple=True, type=PATHS, help="Motions for sft and hindsight: file, library or folder."
)
@click.option("--from", "start", default=None, type=PATHS, help="A fine-tuned skill whose adapter rl begins with.")
@click.option("--out", required=True, type=PATHS, help="Run directory; an interrupted run goes on from it.")
@configured("laptop")
def finetune(prior, task, adapter, method, paths, start, out, preset, settings, threads, seed) -> None:
    """Bend the frozen prior to a task with a small adapter: by reward (rl), by examples (sft), or one after the other.

    \b
    Presets: laptop (2 million steps on two cores), paper (GPC's sizes), tiny (tests).
    kinetok finetune --task target --out runs/target
    kinetok finetune --task steering --method sft,rl --clips zombie_walk.txt --out runs/zombie
    kinetok finetune --from runs/target --set task.distance=2,8 --out runs/further
    kinetok sample --adapter runs/target --out target.mp4
    """
    from dataclasses import replace

    from kinetok import presets
    from kinetok.adapters.finetune import Skill, reshaped
    from kinetok.adapters.finetune import finetune as bend
    from kinetok.config import override, pick
    from kinetok.gpt.controller import Prior

    config = pick(presets.FINETUNE, preset, "preset")()
    if start is None:
        base = prior or "humanoid-gpt"
        model = Prior.from_pretrained(base)
    else:
        skill = Skill.from_pretrained(start, prior)
        model, base = skill.prior, skill.base
        config = replace(config, task=skill.task, adapter=skill.adapted.config)
    config = reshaped(config, task=task or config.task.kind, adapter=adapter or config.adapter.kind)
    config = override(replace(config, methods=tuple(method.split(","))), settings)
    bend(model, config, out, base=base, clips=load_clips(paths), start=start, seed=seed, threads=threads)


@main.command()
@click.option("--prior", default=None, type=PATHS, help="Directory or packaged name.  [default: humanoid-gpt]")
@click.option("--adapter", default=None, type=PATHS, help="A fine-tuned skill to play instead of the prior alone.")
@click.option("--tokenizer", default=None, type=PATHS, help="Where its tokenizer is, if not where it was trained.")
@click.option("--out", required=True, type=PATHS, help="Video to write; the motion and metrics go beside it.")
@click.option("--seconds", default=10.0, show_default=True, help="Length of the motion.")
@click.option(
    "--top-p", default=None, type=float, help="Nucleus of the next tokens.  [default: 0.9, or the skill's own]"
)
@click.option("--temperature", default=None, type=float, help="Above 1 is bolder, below 1 more usual.  [default: 1]")
@click.option("--count", default=1, show_default=True, help="Characters; each becomes a clip, the first the video.")
@click.option("--push", default=0.0, help="Push the character, in m/s: at 6.7 s, with --adapter every two seconds.")
@option_seed
def sample(prior, adapter, tokenizer, out, seconds, top_p, temperature, count, push, seed) -> None:
    """New motion from the prior, simulated: OUT.mp4, OUT.safetensors (the clips) and OUT.json (metrics).

    With --adapter the character does its task, and the video shows what is asked of it; the nucleus and the
    temperature are those it was trained with, unless you say otherwise.
    """
    check_suffix(out, ".mp4")
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


def sample_skill(adapter, prior, tokenizer, out: Path, drawn: dict, *, seconds, count, push, seed) -> None:
    """`sample --adapter`: the first character's video with markers, every character's clip, and the scores.

    drawn: settings of how tokens are drawn that replace the skill's own.
    """
    from dataclasses import replace

    from kinetok.adapters.finetune import Skill
    from kinetok.adapters.rlft import play
    from kinetok.config import to_dict
    from kinetok.motion.clip import Clip
    from kinetok.render.video import render_frames, write_video

    skill = Skill.from_pretrained(adapter, prior, tokenizer)
    skill = replace(skill, policy=replace(skill.policy, **drawn))
    played = play(
        skill.controller(seed), skill.task, skill.prior,
        episodes=count, seconds=seconds, push=push, seed=seed, record=count,
    )  # fmt: skip
    body, name = skill.prior.character, skill.task.kind
    frames = render_frames(
        body, played.qpos[:, 0], fps=played.fps, markers=played.markers, caption=name, distance=4.5, elevation=-28
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_video(out, frames, played.fps)
    click.echo(f"wrote {out}: {len(played.qpos)} frames at {played.fps:g} fps")
    motion = [
        Clip(name=f"{name}{i}", character=body.name, fps=played.fps, qpos=played.qpos[:, i], source=str(adapter))
        for i in range(count)
    ]
    write_motion(out.with_suffix(".safetensors"), *motion)
    told = {"task": name, "push_mps": push, "seed": seed, "adapter": str(adapter)} | to_dict(skill.policy)
    show_json(played.score.measures | told, out.with_suffix(".json"))


@main.group(cls=Chain)
def evaluate() -> None:
    """Numbers with a seed: how well a tracker tracks, and how long a prior lives."""


@evaluate.command("tracking")
@click.option("--tokenizer", default="humanoid-fsq", show_default=True, type=PATHS, help="Directory or packaged name.")
@click.option("--clips", "paths", multiple=True, required=True, type=PATHS, help="Motion file, library or folder.")
@click.option("--json", "out", default=None, type=PATHS, help="Write the result here instead of printing it.")
@click.option("--episodes", default=8, show_default=True, help="Per clip, from phases spread over it.")
@click.option("--push", default=0.0, help="Push the root every two seconds by so many m/s.")
@option_threads
@option_seed
def evaluate_tracking(tokenizer, paths, out, episodes, push, threads, seed) -> None:
    """Success rate and MPJPE of a tokenizer (or a teacher) on clips, by clip and overall."""
    from kinetok.evaluate import evaluate_tracking as score
    from kinetok.tokenizers.tokenizer import MotionTokenizer

    model = MotionTokenizer.from_pretrained(tokenizer)
    show_json(score(model, load_clips(paths), episodes=episodes, push=push, threads=threads, seed=seed), out)


@evaluate.command("prior")
@click.option("--prior", default="humanoid-gpt", show_default=True, type=PATHS, help="Directory or packaged name.")
@click.option("--tokenizer", default=None, type=PATHS, help="Where its tokenizer is, if not where it was trained.")
@click.option("--json", "out", default=None, type=PATHS, help="Write the result here instead of printing it.")
@click.option("--episodes", default=64, show_default=True, help="Motions to sample.")
@click.option("--seconds", default=20.0, show_default=True, help="Length of each; a fall ends it.")
@click.option("--push", default=0.0, help="Push every character once, at step 200, by so many m/s.")
@click.option("--top-p", default=0.9, show_default=True, help="Nucleus of the next-token distribution.")
@option_threads
@option_seed
def evaluate_prior(prior, tokenizer, out, episodes, seconds, push, top_p, threads, seed) -> None:
    """Survival, diversity and smoothness of motion sampled from a prior, from random reference states."""
    from kinetok.evaluate import evaluate_prior as score
    from kinetok.gpt.controller import Prior

    model = Prior.from_pretrained(prior, tokenizer)
    show_json(score(model, episodes=episodes, seconds=seconds, push=push, top_p=top_p, threads=threads, seed=seed), out)


@evaluate.command("task")
@click.option("--adapter", default=None, type=PATHS, help="A fine-tuned skill; without it, the prior alone.")
@click.option(
    "--prior", default=None, type=PATHS, help="Its prior, if not at the place it notes; or which prior alone."
)
@click.option("--tokenizer", default=None, type=PATHS, help="Where its tokenizer is, if not where it was trained.")
@click.option("--task", default=None, metavar=TASK_NAMES, help="What to do.  [default: the skill's own; alone: target]")
@click.option("--json", "out", default=None, type=PATHS, help="Write the result here instead of printing it.")
@click.option("--episodes", default=256, show_default=True, help="Characters, each for --seconds.")
@click.option("--seconds", default=20.0, show_default=True, help="Length of each; a target comes every 6 to 8 s.")
@click.option("--push", default=0.0, help="Push the root every two seconds by so many m/s.")
@option_threads
@option_seed
def evaluate_task(adapter, prior, tokenizer, task, out, episodes, seconds, push, threads, seed) -> None:
    """How well a skill does its task: success, final distance, errors, return and survival, as the task defines."""
    from kinetok.evaluate import evaluate_task as score

    told = {"episodes": episodes, "seconds": seconds, "push": push, "threads": threads, "seed": seed}
    show_json(score(adapter, prior, task, tokenizer=tokenizer, **told), out)


@main.command()
@click.option("--out", default=Path("kinetok-demo"), show_default=True, type=PATHS, help="Folder for the videos.")
@click.option("--seconds", default=8.0, show_default=True, help="Length of each video.")
@option_seed
def demo(out, seconds, seed) -> None:
    """Track a packaged clip, show its tokens, sample new motion; two videos and a table, in under two minutes."""
    from kinetok.demo import run_demo

    run_demo(out, seconds=seconds, seed=seed)


if __name__ == "__main__":
    sys.exit(main())
