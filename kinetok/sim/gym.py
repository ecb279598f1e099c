"""The tracking worlds as a Gymnasium vector environment, for learning libraries that speak that interface.

    worlds = TrackingVectorEnv(Env(EnvConfig(), task, rows=64))
    obs, infos = worlds.reset(seed=0)
    obs, reward, terminated, truncated, infos = worlds.step(worlds.action_space.sample())

Actions are PD targets in radians within +-pi. Finished rows are reset within step (SAME_STEP): their last
observations are in infos["final_obs"] and their last reward terms in infos["final_info"], each with its row mask
under the same name after an underscore. Needs the `gym` extra; nothing else in kinetok imports this file.
"""

from typing import Any

import numpy as np

from kinetok.sim.env import Env

try:
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("kinetok.sim.gym needs Gymnasium: pip install 'kinetok[gym]'") from error


class TrackingVectorEnv(VectorEnv):
    """`env.rows` worlds; close with close(), seed through reset. Rendering is kinetok.render's business."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 (Gymnasium's own name)

    def __init__(self, env: Env):
        self.env, self.num_envs = env, env.rows
        self.single_observation_space = Box(-np.inf, np.inf, (env.obs_size,), np.float32)
        self.single_action_space = Box(-np.pi, np.pi, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start every row anew; observations (N, O). A seed restarts the random stream; there are no options."""
        if options:
            raise ValueError(f"reset takes no options, got {sorted(options)}; rows cannot be reset one by one")
        super().reset(seed=seed)
        if seed is not None:
            self.env.rng = np.random.default_rng(seed)
        return self.env.reset(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step under PD targets (N, A): obs (N, O), reward, terminated, truncated (N,), infos."""
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(f"actions have shape {np.shape(actions)}; these worlds take {self.action_space.shape}")
        step = self.env.step(actions)
        done = step.terminated | step.truncated
        infos = _masked(step.terms, ~done)
        if len(step.done):
            final_obs = np.full(self.num_envs, None, dtype=object)
            for row, obs in zip(step.done, step.final_obs, strict=True):
                final_obs[row] = obs
            final = {"final_obs": final_obs, "_final_obs": done}
            infos |= final | {"final_info": _masked(step.terms, done), "_final_info": done.copy()}
        return step.obs, step.reward, step.terminated, step.truncated, infos


def _masked(terms: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form of per-row values: zero outside `rows` (N,), with the mask under "_name"."""
    values = {name: np.where(rows, term, 0) for name, term in terms.items()}
    return values | {f"_{name}": rows.copy() for name in terms}
