"""Commands about motion and bodies: `kinetok clips ...`, `kinetok characters ...`."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from kinetok.cli.shared import (
    COUNT,
    DAY,
    EXPORTS,
    PATHS,
    SECONDS,
    VIDEOS,
    Chain,
    Number,
    check_suffix,
    each_clip,
    one_clip,
    option_seed,
    say,
    write_motion,
)

UNITS = ["m", "cm", "mm", "in", "cmu"]  # motion/formats/conventions.py


def option_told(command):
    """What files may not say: --fps, --dialect, --unit, --up."""
    for option in (
        click.option("--up", type=click.Choice(["y", "z"]), default=None, help="Axis that is up in BVH."),
        click.option("--unit", type=click.Choice(UNITS), default=None, help="Of BVH.  [default: told by rig or size]"),
        click.option("--dialect", default=None, help="Of robot CSV: lafan1, kimodo or bones-seed.  [default: told]"),
        click.option(
            "--fps",
            type=click.FloatRange(1, 1000),
            default=None,
            help="Frame rate of files that name none (robot CSV, AMC).",
        ),
    ):
        command = option(command)
    return command


def option_part(command):
    """--part, of which there may be many, as a dict."""

    def split(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> dict[str, str]:
        wrong = [pair for pair in given if not all(pair.partition("="))]
        if wrong:
            raise click.BadParameter(f"{wrong[0]!r}; give a part and a joint, e.g. left_thigh=Oberschenkel_L")
        return {part: joint for part, _, joint in (pair.partition("=") for pair in given)}

    return click.option(
        "--part",
        "parts",
        multiple=True,
        metavar="PART=JOINT",
        callback=split,
        help="A joint that no table of rigs knows, e.g. left_thigh=Oberschenkel_L.",
    )(command)


@click.group(cls=Chain)
def clips() -> None:
    """Look at motion files and gather them into one library."""


@clips.command("info")
@click.argument("paths", nargs=-1, required=True, type=PATHS)
def clips_info(paths: tuple[Path, ...]) -> None:
    """Frames, rate, duration and ground clearance of motion files, libraries or folders of them."""
    from kinetok.motion.character import Character
    from kinetok.motion.kinematics import lowest_point

    click.echo(f"{'name':<22}{'frames':>7}{'fps':>8}{'seconds':>9}{'loop':>6}{'lowest m':>10}{'path m':>8}  source")
    for clip in each_clip(paths):
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
@option_told
@option_part
def clips_check(
    paths: tuple[Path, ...], fix: bool, out: Path | None, character: str | None, parts: dict[str, str], **told: Any
) -> None:
    """Look for what is wrong with motion: lead-ins, jumps, spikes, units, up axis, floor, duplicates.

    What has one right repair is repaired by --fix (and by every command that reads recorded motion); the rest is
    refused with its frame and joint. Of two copies --fix keeps the longer one. Exits with 1 where anything was refused.
    """
    from kinetok.motion.check import check, report
    from kinetok.motion.duplicates import duplicates
    from kinetok.motion.formats import SAID, FormatError, files_of, read_file

    if fix != (out is not None):
        raise ValueError("--fix writes what it repairs: give both --fix and --out F.safetensors")
    read, left_out = [], []  # (file, motion), names
    for path in paths:
        try:
            files = files_of(path)
        except FormatError as error:
            files = []
            left_out.append(_refuse(path, error))
        for file, known in files:
            try:
                read += [(file, motion) for motion in read_file(file, known, **told)]
            except ValueError as error:
                left_out.append(_refuse(file, error))
    names = [motion.name for _, motion in read]
    labels = [f"{file} {name}" if names.count(name) > 1 else name for name, (file, _) in zip(names, read, strict=True)]
    good = []
    for label, (_, motion) in zip(labels, read, strict=True):
        findings = check(motion)
        label += f" from {motion.source}" if any(word in motion.source for word in SAID) else ""
        good.append(not any(f.severity == "refused" for f in findings))
        click.echo(f"{label}\n  " + report(findings).replace("\n", "\n  "))
    left_out += [label for label, kept in zip(labels, good, strict=True) if not kept]
    failed = bool(left_out)
    for pair in duplicates([motion for _, motion in read]):
        mirrored = ", mirrored" if pair.mirrored else ""
        click.echo(f"{labels[pair.part]} is in {labels[pair.whole]} from {pair.start:.2f} s on{mirrored}")
        if not pair.mirrored and good[pair.whole] and good[pair.part]:
            good[pair.part] = False
            left_out.append(f"{labels[pair.part]} (a copy)")
    if out is not None:
        write_fixed(
            out, [motion for (_, motion), kept in zip(read, good, strict=True) if kept], left_out, character, parts
        )
    if failed:
        raise click.exceptions.Exit(1)


def _refuse(path: Path, error: ValueError) -> str:
    """Say that a file cannot be read; its name."""
    click.echo(f"{path.name}\n  refused unreadable {error}")
    return path.name


def write_fixed(out: Path, motions: list, left_out: list[str], character: str | None, parts: dict[str, str]) -> None:
    """A library of the motions, mended."""
    from kinetok.motion.check import mend
    from kinetok.motion.library import ClipLibrary
    from kinetok.motion.retarget import retarget
    from kinetok.motion.skeleton import SkeletonMotion

    check_suffix(out, ".safetensors")
    if not motions:
        raise ValueError(f"--out {out}: every motion was refused, there is nothing to write")
    mended = [mend(motion)[0] for motion in motions]
    fitted = [
        retarget(m, character or "humanoid", parts=parts).clip if isinstance(m, SkeletonMotion) else m for m in mended
    ]
    ClipLibrary.write(out, fitted)
    click.echo(f"wrote {out}: {len(fitted)} clips; left out: {', '.join(sorted(left_out)) or 'none'}")


@clips.command("import")
@click.argument("paths", nargs=-1, required=True, type=PATHS)
@click.option(
    "--out",
    required=True,
    type=PATHS,
    help="The library to write, ending in .safetensors; with --append also a folder of parts.",
)
@click.option(
    "--character", default=None, help="Body to retarget to.  [default: humanoid for skeletons, for clips their own]"
)
@option_told
@option_part
@click.option("--half", is_flag=True, default=False, show_default=True, help="Half the bytes (float16), 0.7 mm off.")
@click.option("--append", is_flag=True, default=False, show_default=True, help="Add to the library that lies at --out.")
@click.option("--skip", is_flag=True, default=False, show_default=True, help="Leave out what is refused, and say why.")
def clips_import(
    paths: tuple[Path, ...],
    out: Path,
    character: str | None,
    parts: dict[str, str],
    half: bool,
    append: bool,
    skip: bool,
    **told: Any,
) -> None:
    """Read motion files of any known format, alone or in folders, and write one memory-mapped library.

    What has one right repair is repaired, and said; wrong units, axes and leaps of the root are refused. `kinetok clips
    check` says more and is stricter.

    \b
    BVH, ASF/AMC, AMASS npz, poselib npy          retargeted to --character
    DeepMimic txt, robot CSV, MimicKit, GMR, ...  of the body they were made for, or retargeted to --character
    """
    from kinetok.motion.library import ClipLibrary

    if out.suffix or not append:
        check_suffix(out, ".safetensors")
    read, left_out = [], []  # (name, seconds, body), errors
    taken = set(ClipLibrary.open(out).names) if append and out.exists() else set()
    if character and character.endswith(".xml"):
        character = str(Path(character).resolve())  # the library names it, wherever it is read

    def refuse(error: ValueError) -> None:
        left_out.append(error)
        say(f"left out {error}")

    def found():
        for clip in each_clip(paths, character, parts=parts, skip=refuse if skip else None, **told):
            read.append((clip.name, clip.seconds, clip.character))
            if clip.name in taken:
                free = next(name for k in itertools.count(2) if (name := f"{clip.name}-{k}") not in taken)
                say(f"{clip.source}: another clip is called {clip.name}, so this one is {free}")
                clip = replace(clip, name=free)
            taken.add(clip.name)
            if clip.character != read[0][2]:
                raise ValueError(
                    f"{read[0][0]} is of {read[0][2]!r}; {clip.name} is of {clip.character!r}: a library holds motion "
                    "of one body. Import each into a library of its own, or retarget all to one by --character"
                )
            yield clip

    if append:
        ClipLibrary.append(out, found(), dtype="float16" if half else None)
    else:
        ClipLibrary.write(out, found(), dtype="float16" if half else "float32")
    summary = f"{len(read)} clips, {sum(seconds for _, seconds, _ in read):.1f} s"
    summary += f"; {len(left_out)} files were refused" if left_out else ""
    click.echo(f"added to {out}: {summary}" if append else f"wrote {out}: {summary}")


@clips.command("split")
@click.argument("source", type=PATHS)
@click.option("--out", required=True, type=PATHS, help="Folder for train.safetensors and held_out.safetensors.")
@click.option("--share", default=0.1, show_default=True, help="Share of the clips to hold out, about.")
@click.option("--mirror", is_flag=True, default=False, show_default=True, help="With every clip's mirror image.")
@option_seed
def clips_split(source: Path, out: Path, share: float, mirror: bool, seed: int) -> None:
    """Part a library into clips to train on and clips to judge by; those of one source stay together.

    A hash of the source and the seed decides, so a clip keeps its side when others are added. Never holds more than
    one clip in memory.
    """
    from kinetok.motion.library import ClipLibrary

    if not source.is_dir() and source.suffix != ".safetensors":
        raise ValueError(f"{source} is no clip library; make one: kinetok clips import {source} --out F.safetensors")
    library = ClipLibrary.open(source, mirror=mirror)
    for name, part in zip(("train", "held_out"), library.split(share, seed), strict=True):
        ClipLibrary.write(out / f"{name}.safetensors", (part.clip(index) for index in range(len(part))))
        click.echo(f"wrote {out / name}.safetensors: {len(part)} clips, {part.seconds.sum():.1f} s")


@clips.command("cycle")
@click.argument("source", type=PATHS)
@click.option("--out", required=True, type=PATHS, help="The library to write, ending in .safetensors.")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
@click.option("--shortest", default=0.5, show_default=True, type=Number(0.2, 60), help="Seconds of a cycle at least.")
@click.option("--longest", default=2.5, show_default=True, type=Number(0.2, 60), help="Seconds of a cycle at most.")
def clips_cycle(source: Path, out: Path, name: str | None, shortest: float, longest: float) -> None:
    """Cut the most even gait cycle out of a recording and close it, so that it repeats: a loop, as `vary` wants it.

    \b
    kinetok clips import walk.bvh --out walk.safetensors
    kinetok clips cycle walk.safetensors --out walk-cycle.safetensors
    kinetok clips vary walk-cycle.safetensors --turn 80 --count 4 --out walk-varied.safetensors
    """
    from kinetok.motion.cycle import cycle

    check_suffix(out, ".safetensors")
    found = cycle(one_clip(source, name), shortest=shortest, longest=longest)
    say(f"{found.name}: {found.source}")
    write_motion(out, found)


@clips.command("vary")
@click.argument("source", type=PATHS)
@click.option("--out", required=True, type=PATHS, help="The library to write, ending in .safetensors.")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
@click.option("--seconds", default=60.0, show_default=True, type=SECONDS, help="Length of the motion.")
@click.option("--turn", default=60.0, show_default=True, type=Number(0, 720), help="Degrees per second at most.")
@click.option("--tempo", default=1.2, show_default=True, type=Number(1, 5), help="Times as fast or slow at most.")
@click.option(
    "--halt",
    default=0.0,
    show_default=True,
    type=Number(0, DAY),
    help="Seconds between two halts on average; 0 for none.",
)
@click.option("--into", default=None, help="A gait to go over into and back, in step: a file, or `stand`.")
@click.option("--change", default=3.0, show_default=True, help="Seconds from one share of that gait to the next.")
@click.option("--style", default=0.0, show_default=True, type=Number(0, 5), help="How far from the walker's own way.")
@click.option("--count", default=1, show_default=True, type=COUNT, help="Motions to make, of seeds one after another.")
@option_seed
def clips_vary(
    source: Path, out: Path, name: str | None, seconds, turn, tempo, halt, into: str | None, change, style, count, seed
) -> None:
    """Make long motions of a gait cycle: turning, hurrying, lingering, halting, and as other people would.

    \b
    A prior of straight walks has nothing to choose from; one of varied walks can be steered, and the more of them
    there are, the nearer is always one that turns as asked.
    kinetok clips vary walk.txt --turn 80 --count 6 --out walk-varied.safetensors
    kinetok clips vary walk.txt --into jog.txt --out walk-jog.safetensors
    kinetok clips vary walk.txt --into stand --out walk-stand.safetensors
    kinetok clips vary walk.txt --style 1 --count 16 --out walk-styles.safetensors
    """
    from kinetok.motion.style import restyle
    from kinetok.motion.vary import standing, vary

    check_suffix(out, ".safetensors")
    clip, other = one_clip(source, name), None
    if into is not None:
        other = standing(clip) if into == "stand" else one_clip(Path(into), None)
    told, varied = {"seconds": seconds, "turn": turn, "tempo": tempo, "halt": halt, "change": change}, []
    for drawn in range(seed, seed + count):
        gait, into_gait = clip, other
        if style:
            gait = restyle(clip, amount=style, seed=drawn)
            into_gait = restyle(other, amount=style, seed=drawn) if other else None
        varied.append(vary(gait, into=into_gait, seed=drawn, **told))
    if not clip.loop and varied[0].seconds < seconds - 0.1:
        say(
            f"{clip.name} is no loop: gone through once, {varied[0].seconds:.1f} s of the {seconds:g} asked for; "
            "`kinetok clips cycle` cuts a loop out of a gait"
        )
    if count > 1:
        varied = [replace(motion, name=f"{motion.name}-{number}") for number, motion in enumerate(varied, 1)]
    write_motion(out, *varied)


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
@click.option("--out", required=True, type=PATHS, help="Video to write, ending in .mp4 or .gif.")
@click.option("--name", default=None, help="Which clip of a library; default its only one.")
@click.option("--seconds", type=SECONDS, default=None, help="How much of it; default all, a loop three times.")
def clips_play(source: Path, out: Path, name: str | None, seconds: float | None) -> None:
    """Render a motion file to a video, as it was recorded and without physics."""
    from dataclasses import replace

    import numpy as np

    check_suffix(out, *VIDEOS)
    clip = one_clip(source, name)
    seconds = clip.seconds * (3 if clip.loop else 1) if seconds is None else seconds
    if not clip.loop and seconds > clip.seconds:
        say(f"{clip.name} is no loop and ends after {clip.seconds:.2f} s, so does the video")
        seconds = clip.seconds
    qpos = clip.at(np.arange(0, seconds, 1 / 30))
    write_motion(out, replace(clip, qpos=qpos, fps=30.0, loop=False), caption=clip.name)


@click.group(cls=Chain)
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
