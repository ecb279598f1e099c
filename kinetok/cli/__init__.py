"""The command line. Each command is a thin call of one library function; `--help` teaches the chain:

clips -> tokenize fit -> pretrain -> sample, with evaluate at every link.
"""

import os
from pathlib import Path

# Set before any library starts its threads: spinning OpenMP workers would steal the physics threads' cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import click

from kinetok import __version__
from kinetok.cli.clips import characters, clips
from kinetok.cli.evaluate import evaluate
from kinetok.cli.learn import finetune, pretrain
from kinetok.cli.sample import sample
from kinetok.cli.shared import PATHS, Chain, option_seed
from kinetok.cli.tokenize import tokenize


@click.group(cls=Chain, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="kinetok")
def main() -> None:
    """Motion of physically simulated characters, as tokens.

    \b
    kinetok demo                                         what it does, in half a minute
    kinetok clips info walk.txt                          look at a motion
    kinetok tokenize fit --clips walk.txt --out runs/w   learn tokens through physics
    kinetok pretrain --tokenizer runs/w --clips walk.txt --out runs/g
    kinetok sample --prior runs/g --out sample.mp4       new motion, simulated
    """


@click.command()
@click.option("--out", default=Path("kinetok-demo"), show_default=True, type=PATHS, help="Folder for the videos.")
@click.option("--seconds", default=8.0, show_default=True, help="Length of each video.")
@option_seed
def demo(out, seconds, seed) -> None:
    """Track a packaged clip, show its tokens, sample new motion, walk to targets, in half a minute."""
    from kinetok.demo import run_demo

    run_demo(out, seconds=seconds, seed=seed)


for command in (clips, characters, tokenize, pretrain, finetune, sample, evaluate, demo):
    main.add_command(command)
