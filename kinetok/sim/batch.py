"""The only border to mujoco.batch: float64 rows in, float32 body states out, failures as row ids.

    sim = BatchSim(model, rows=512, threads=2)
    sim.set_state(ids, qpos, qvel)
    failed = sim.step(ctrl, substeps=4)            # ids of rows MuJoCo could not step; they need a reset
    state = sim.state()                            # BodyState of all rows, fresh

Rows are independent and their results are bit-identical at any thread count. A row whose physics blows up is
reported, never silently reset (MuJoCo resets such a row and raises a warning counter; both that and raised
errors count as failed). It knows no clip, task or reward.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

VEL = mujoco.mjtStage.mjSTAGE_VEL
# BADCTRL among them: MuJoCo replaces controls that are not numbers by zero and goes on.
BLOW_UPS = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC", "CTRL")]


@dataclass(frozen=True, kw_only=True)
class BodyState:
    """World-frame state of N rows, float32: pos (N, B, 3) m, mat (N, B, 3, 3), linear and angular (N, B, 3),
    root quaternion (N, 4)."""

    pos: np.ndarray
    mat: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    quat: np.ndarray

    def rows(self, ids: np.ndarray) -> "BodyState":
        """The state of rows ids only."""
        return BodyState(
            pos=self.pos[ids],
            mat=self.mat[ids],
            linear=self.linear[ids],
            angular=self.angular[ids],
            quat=self.quat[ids],
        )

    def assign_(self, ids: np.ndarray, other: "BodyState") -> None:
        """Overwrite rows ids with another state's rows."""
        for name in ("pos", "mat", "linear", "angular", "quat"):
            getattr(self, name)[ids] = getattr(other, name)


class BatchSim:
    """`rows` simulations of one model on `threads` threads (0: all cores)."""

    def __init__(self, model: mujoco.MjModel, rows: int, threads: int = 0):
        self.model, self.rows = model, rows
        # Persistent: a step goes on from the kinematics that the last one ended with, instead of computing them again.
        self._batch = Batch(model, rows, threads, persistent=True)
        self.qpos, self.qvel, self._ctrl = (self._batch.bind(n) for n in ("qpos", "qvel", "ctrl"))
        self._xpos, self._xmat, self._cvel, self._com = (
            self._batch.bind(n) for n in ("xpos", "xmat", "cvel", "subtree_com")
        )
        self._bodies = model.nbody - 1
        self._rest = self._batch.state[0].copy()

    def set_state(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put rows ids (n,) into poses qpos (n, nq) and velocities qvel (n, nv) and refresh their body states."""
        self._batch.state[ids] = self._rest  # what reset does, without a second call to the threads
        self.qpos[ids], self.qvel[ids] = qpos, qvel
        self._batch.forward(ids, stage=VEL)

    def add_velocity(self, ids: np.ndarray, delta: np.ndarray) -> None:
        """Push rows ids: add delta (n, 3) m/s to the root's linear velocity. Body states follow at the next step."""
        self.qvel[ids, :3] += delta

    def set_friction(self, floor: np.ndarray) -> None:
        """Sliding friction (N,) of the floor, geom 0, in each row."""
        self._batch.expand("geom_friction")[:, 0, 0] = floor

    def step(self, ctrl: np.ndarray, substeps: int) -> np.ndarray:
        """Advance all rows by `substeps` physics steps under ctrl (N, nu); returns ids (k,) of the failed rows."""
        self._ctrl[:] = ctrl
        before = self._blow_ups()
        raised = np.empty(0, dtype=int)
        try:
            self._batch.step(nstep=substeps, stage=VEL)
        except SimulationError as error:
            raised = np.asarray(error.ids)
        return np.union1d(raised, np.flatnonzero(self._blow_ups() > before))

    def _blow_ups(self) -> np.ndarray:
        return self._batch.warning[:, BLOW_UPS, 1].sum(1)  # (N, warning, [last info, count])

    def state(self, ids: np.ndarray | None = None) -> BodyState:
        """Fresh body states of all rows, or of rows ids."""
        rows = slice(None) if ids is None else ids
        pos = self._xpos[rows, 1:]
        cvel = self._cvel[rows, 1:].astype(np.float32)
        arm = (pos - self._com[rows, 1:2]).astype(np.float32)
        angular, linear = cvel[..., :3], cvel[..., 3:]
        return BodyState(
            pos=pos.astype(np.float32),
            mat=self._xmat[rows, 1:].astype(np.float32).reshape(len(pos), self._bodies, 3, 3),
            linear=linear + cross(angular, arm),
            angular=angular,
            quat=self.qpos[rows, 3:7].astype(np.float32),
        )


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product (..., 3); np.cross spends most of its time moving axes."""
    out = np.empty_like(a)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out
