"""What the commands share: options, the group that says errors in one line, reading clips and writing motion."""

import functools
import json
import os
from pathlib import Path

import click


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
            known = isinstance(error, (ValueError, OSError, FloatingPointError, ImportError, MemoryError))
            known |= type(error).__module__.startswith("kinetok.")
            if os.environ.get("KINETOK_TRACEBACK") or not known:
                raise
            short = "not enough memory for that: " if isinstance(error, MemoryError) else ""
            raise click.ClickException(short + str(error)) from error


NATURAL = click.IntRange(min=0)
COUNT = click.IntRange(min=1)


class Number(click.FloatRange):
    """A range that `nan` is not in."""

    def convert(self, value, param, ctx):
        number = super().convert(value, param, ctx)
        if number != number:
            self.fail(f"{value!r} is not a number", param, ctx)
        return number


DAY = 86_400
SECONDS = Number(min=0, max=DAY, min_open=True)
PUSH = Number(min=0, max=100)
SHARE = Number(min=0, max=1, min_open=True)
POSITIVE = Number(min=0, max=1000, min_open=True)
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


def _use_device(_: click.Context, __: click.Parameter, name: str) -> None:
    """Make the networks' device torch's default, for this process; the CPU needs no torch yet."""
    if name == "cpu":
        return
    import torch

    if name == "cuda" and "LOCAL_RANK" in os.environ:  # torchrun: one GPU for each process
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:  # what torch raises differs from build to build
        count = torch.cuda.device_count()
        found = ", ".join(["cpu", *(f"cuda:{k}" for k in range(count))])
        reason = str(error).splitlines()[0]
        raise click.BadParameter(
            f"torch cannot use {name!r} ({reason}); here there is {found}. A GPU needs a build of torch for it"
        ) from error
    torch.set_default_device(name)
    if torch.get_default_device().type == "cuda":
        torch.cuda.set_device(torch.get_default_device())


option_device = click.option(
    "--device",
    default="cpu",
    show_default=True,
    metavar="NAME",
    callback=_use_device,
    expose_value=False,
    help="Where the networks are: cpu, cuda, cuda:1. Physics stays on the cores (docs/gpu.md).",
)


def _told_where_it_goes_on(command):
    """Say, of a training that is stopped by Ctrl-C, how it goes on."""

    @functools.wraps(command)
    def told(*args, **kwargs):
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt:
            out = kwargs.get("out")
            kept = out is not None and any(Path(out).rglob("state*.safetensors"))
            raise click.ClickException(
                f"stopped; the same command goes on from the last state in {out}"
                if kept
                else "stopped before its first state was written; the same command begins anew"
            ) from None

    return told


def configured(presets: str):
    """--preset, --set, --seed, --threads and --device, the same on every training command."""

    def decorate(command):
        command = option_seed(option_threads(option_device(_told_where_it_goes_on(command))))
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


option_hours = click.option(
    "--hours",
    type=click.FloatRange(min=0, min_open=True),
    default=None,
    help="Draw so many hours of the clips by --seed; their libraries may be larger than memory.  [default: all]",
)


def say(line: str) -> None:
    """Tell the user what was repaired or assumed."""
    click.echo(line, err=True)


def each_clip(paths: tuple[Path, ...], character: str | None = None, **settings):
    """The clips of all paths one after the other; what was repaired or assumed is said on stderr."""
    from kinetok.motion import formats

    for path in paths:
        yield from formats.each_clip(path, character, say=say, **settings)


def load_clips(paths: tuple[Path, ...], hours: float | None = None, seed: int = 0):
    """All clips of the paths, or so many hours of them."""
    from kinetok.motion.formats import draw_clips

    return list(each_clip(paths)) if hours is None else draw_clips(paths, hours, seed, say=say)


def check_suffix(out: Path, *allowed: str) -> None:
    """Refuse a file name before any work is done for it."""
    if out.suffix not in allowed:
        raise ValueError(f"--out {out}: the name must end in {' or '.join(allowed)}")


def show_json(data: dict, out: Path | None) -> None:
    """Print it, or write it to a file; where that fails it is printed all the same."""
    text = json.dumps(data, indent=1)
    if out is None:
        click.echo(text)
        return
    temporary = out.with_name(f".{out.name}.tmp")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(text + "\n")
        temporary.replace(out)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        click.echo(text)
        raise ValueError(f"{out} could not be written ({error}); what it would hold is printed above") from error
    click.echo(f"wrote {out}")


def writable(_: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    """Callback of an option that names a file to write: refuse a folder, and a place where nothing can be written,
    before any work is done for it."""
    if path is None:
        return None
    if path.is_dir():
        raise click.BadParameter(f"{path} is a folder; give a file")
    there = next(parent for parent in path.absolute().parents if parent.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise click.BadParameter(f"nothing can be written to {there}; choose another place")
    return path


option_json = click.option(
    "--json", "out", default=None, type=click.Path(path_type=Path), callback=writable,
    help="Write the result here instead of printing it.",
)  # fmt: skip


PATHS = click.Path(path_type=Path)
VIDEOS = (".mp4", ".gif")  # render/video.py: ENCODERS, which takes numpy to import
EXPORTS = (".bvh", ".csv", ".npz")  # of programs other than this one
TASK_NAMES = "target|steering|path"


def one_clip(source: Path, name: str | None):
    """The clip of that name in a file or library, or its only one."""
    from kinetok.config import nearest
    from kinetok.motion.formats import open_library

    library = open_library(source)
    found = [] if library is not None else load_clips((source,))
    names = library.names if library is not None else tuple(clip.name for clip in found)
    if name is None and len(names) > 1:
        raise ValueError(f"{source} holds {len(names)} clips; choose one with --name: {', '.join(names[:12])}")
    if name is not None and name not in names:
        raise ValueError(f"{source} holds no clip {name!r}{nearest(name, names)}")
    if name is not None and names.count(name) > 1:
        raise ValueError(
            f"{source} holds {names.count(name)} clips named {name!r}; import them anew to tell them apart"
        )
    index = names.index(name) if name else 0
    return library.clip(index) if library is not None else found[index]


def write_motion(out: Path, *clips, caption: str = "") -> None:
    """Write clips as a library, or one clip as a video or for other programs, by the file's suffix."""
    from dataclasses import replace

    from kinetok.motion.character import Character
    from kinetok.motion.export import skeleton_motion, smpl_motion
    from kinetok.motion.formats.amass import write_amass
    from kinetok.motion.formats.bvh import write_bvh
    from kinetok.motion.formats.robot_csv import write_robot_csv
    from kinetok.motion.library import ClipLibrary

    check_suffix(out, ".safetensors", *VIDEOS, *EXPORTS)
    clip, *others = clips
    character = Character.load(clip.character)
    if out.suffix == ".safetensors":
        ClipLibrary.write(out, clips)
    elif others:
        raise ValueError(f"--out {out}: {len(clips)} clips; of the files written here only .safetensors holds many")
    elif out.suffix in VIDEOS:
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
