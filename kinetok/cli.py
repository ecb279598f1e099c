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
        from kinetok.checkpoint import CheckpointError

        try:
            return super().invoke(ctx)
        except (ValueError, CheckpointError, FileNotFoundError, FloatingPointError, ImportError) as error:
            if os.environ.get("KINETOK_TRACEBACK"):
                raise
            raise click.ClickException(str(error)) from error


def configured(presets: str):
    """--preset, --set, --seed and --threads, the same on every training command."""

    def decorate(command):
        command = click.option("--seed", default=0, show_default=True, help="Seeds weights, worlds and noise.")(command)
        command = click.option(
            "--threads", default=0, help="Threads of physics and networks; 0 is every core. Changes speed only."
        )(command)
        command = click.option(
            "--set",
            "settings",
            multiple=True,
            metavar="KEY=VALUE",
            help="Change one setting, e.g. teacher.samples=1e6.",
        )(command)
        return click.option("--preset", default=presets, show_default=True, help="Where the settings start from.")(
            command
        )

    return decorate


def load_clips(paths: tuple[Path, ...]):
    from kinetok.motion.formats import read_clips

    return [clip for path in paths for clip in read_clips(path)]


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
            f"{low:>10.3f}{steps.sum():>8.2f}  {clip.source}"
        )


@clips.command("import")
@click.argument("paths", nargs=-1, required=True, type=PATHS)
@click.option("--out", required=True, type=PATHS, help="The library to write, ending in .safetensors.")
def clips_import(paths: tuple[Path, ...], out: Path) -> None:
    """Read motion files of any known format and write one memory-mapped library."""
    from kinetok.motion.library import ClipLibrary

    found = load_clips(paths)
    ClipLibrary.write(out, found)
    click.echo(f"wrote {out}: {len(found)} clips, {sum(c.seconds for c in found):.1f} s")


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
    from dataclasses import replace

    from kinetok import presets
    from kinetok.config import override, pick
    from kinetok.tokenizers.fit import fit

    config = override(pick(presets.FIT, preset, "preset")(), settings)
    if stages:
        config = replace(config, stages=tuple(stages.split(",")))
    fit(load_clips(paths), config, out, seed=seed, threads=threads)


if __name__ == "__main__":
    sys.exit(main())
