"""What the tests of the commands share: a command as it is typed, and a motion file to give it."""

import json
from pathlib import Path

import numpy as np
from click.testing import CliRunner, Result

from kinetok.cli import main


def frames(count: int = 16) -> list[list[float]]:
    """DeepMimic rows: duration, position (y up), root, chest, neck, right leg and arm, left leg and arm.

    The figure stands and its left shoulder swings by half a radian.
    """
    identity = [1.0, 0.0, 0.0, 0.0]
    rows = []
    for t in np.linspace(0, 1, count):
        half = 0.25 * np.sin(2 * np.pi * t)
        limbs = [*identity, 0.0, *identity, *identity, 0.2, *identity, 0.0, *identity]
        arm = [float(np.cos(half)), float(np.sin(half)), 0.0, 0.0, 0.2]
        rows.append([1 / 30, 0.0, 0.9, 0.0, *identity, *identity, *identity, *limbs, *arm])
    return rows


def write_clip(path: Path, rows: list[list[float]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"Loop": "none", "Frames": rows}))
    return path


def kinetok(*args: object) -> Result:
    return CliRunner().invoke(main, [str(arg) for arg in args], catch_exceptions=False)


FIT = ("tokenize", "fit", "--preset", "tiny", "--clips")
