"""One file per task. The table holds those that ask for something, keyed by the `kind` of a config."""

import numpy as np

from kinetok.config import pick
from kinetok.motion.character import Character
from kinetok.sim.tasks.free import Free
from kinetok.sim.tasks.marker import Marker
from kinetok.sim.tasks.path import Path, PathConfig
from kinetok.sim.tasks.scorecard import Scorecard
from kinetok.sim.tasks.steering import Steering, SteeringConfig
from kinetok.sim.tasks.target import Target, TargetConfig
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig

TASKS = {
    "target": (TargetConfig, Target),
    "steering": (SteeringConfig, Steering),
    "path": (PathConfig, Path),
}

GoalConfig = TargetConfig | SteeringConfig | PathConfig
Goal = Target | Steering | Path


def build_task(
    config: GoalConfig,
    character: Character,
    qpos: np.ndarray,
    qvel: np.ndarray,
    *,
    rows: int,
    starts: np.ndarray | None = None,
    control_hz: int = 30,
) -> Goal:
    """The task that `config` describes, picked by `config.kind`; starts as in `Free`."""
    _, task = pick(TASKS, config.kind, "task")
    return task(config, character, qpos, qvel, rows=rows, starts=starts, control_hz=control_hz)


__all__ = [
    "TASKS",
    "Free",
    "Goal",
    "GoalConfig",
    "Marker",
    "Path",
    "PathConfig",
    "ReferenceTable",
    "Scorecard",
    "Steering",
    "SteeringConfig",
    "Target",
    "TargetConfig",
    "Tracking",
    "TrackingConfig",
    "build_task",
]
