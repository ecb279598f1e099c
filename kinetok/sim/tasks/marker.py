"""Marker: a thing to draw beside the character. It has no body in the simulation; render draws it.

Marker(shape="disc", pos=(2.0, 0.0, 0.0), radius=0.5, rgba=GOAL)
Marker(shape="arrow", pos=(0.0, 0.0, 1.0), end=(0.8, 0.0, 1.0), radius=0.03, rgba=SIDE)
"""

from dataclasses import dataclass
from typing import Literal

GOAL = (0.90, 0.22, 0.20, 1.0)  # what is asked now
DONE = (0.16, 0.66, 0.36, 1.0)  # and done
AHEAD = (0.98, 0.62, 0.20, 1.0)  # what will be asked
SIDE = (0.12, 0.45, 0.85, 1.0)  # what is asked besides

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Marker:
    """shape: a ball at pos, a flat disc around pos, a pole or an arrow from pos to end; pos, end, radius: metres, world
    frame; rgba: 0 to 1."""

    shape: Literal["ball", "disc", "pole", "arrow"]
    pos: Point
    radius: float
    rgba: tuple[float, float, float, float]
    end: Point | None = None

    def __post_init__(self) -> None:
        if (self.end is not None) != (self.shape in ("pole", "arrow")):
            said = "needs an" if self.end is None else "has no"
            raise ValueError(f"marker {self.shape!r} {said} end: {self}")
