"""Scorecard: how well a policy does a task, summed up step by step.

    task, env = ..., Env(EnvConfig(autoreset=False), task, rows=64)
    card, obs = Scorecard(rows=64, control_hz=30), env.reset()
    for _ in range(600):
        step = env.step(policy(obs))
        card.add(step.reward, step.terminated, step.failed, task.measure(env.sim.state()))
    card.summary()                                               # JSON-able, see Scorecard.summary

Without autoreset a row that has fallen goes on: it still misses targets and strays, unless it gets up. It knows no
task: the names are those of `measure`, and a value that is NaN is one not defined at that step.
"""

from typing import Any

import numpy as np


class Scorecard:
    """Sums over the control steps of `rows` worlds that began together."""

    def __init__(self, *, rows: int, control_hz: int):
        self.rows, self.control_hz, self.steps = rows, control_hz, 0
        self._reward = np.zeros(rows)
        self._return = np.zeros(rows)
        self._fell, self._down, self._failed = (np.zeros(rows, dtype=bool) for _ in range(3))
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def add(
        self, reward: np.ndarray, terminated: np.ndarray, failed: np.ndarray, measures: dict[str, np.ndarray]
    ) -> None:
        """One control step: reward, terminated (N,) and failed (k,) of the environment, and measures (N,) of the task,
        after it. A row whose simulation failed is put on its feet again by MuJoCo; it counts as down from then on."""
        for name, values in {"reward": reward, "terminated": terminated, **measures}.items():
            if np.shape(values) != (self.rows,):
                raise ValueError(f"{name} has shape {np.shape(values)}; this scorecard is of {self.rows} rows")
        self.steps += 1
        self._failed[failed] = True
        terminated = terminated | self._failed
        self._reward += np.where(terminated, 0.0, reward)
        self._return += np.where(self._fell, 0.0, reward)
        self._fell, self._down = self._fell | terminated, terminated
        for name, values in measures.items():
            known = values[~np.isnan(values)]
            self._sums[name] = self._sums.get(name, 0.0) + float(known.sum(dtype=np.float64))
            self._counts[name] = self._counts.get(name, 0) + len(known)

    def summary(self) -> dict[str, Any]:
        """Means: every measure over the rows and steps where it is defined (None where it never was, counts says how
        many those are); reward a step, none while a row is down; return, the rewards up to a row's first failure;
        survival_rate (GPC app. C.3: not down at the last step, whatever came before) and never_fell_rate."""
        if not self.steps:
            raise ValueError("nothing to sum up; add a step first")
        means = {name: self._sums[name] / count if count else None for name, count in self._counts.items()}
        return means | {
            "reward": float(self._reward.mean() / self.steps),
            "return": float(self._return.mean()),
            "survival_rate": float(1 - self._down.mean()),
            "never_fell_rate": float(1 - self._fell.mean()),
            "episodes": self.rows,
            "seconds": self.steps / self.control_hz,
            "counts": dict(self._counts),
        }
