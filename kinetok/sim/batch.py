"""The only border to mujoco.batch: float64 rows in, float32 body states out, failures as row ids.

    sim = BatchSim(model, rows=512, threads=2)
    sim.set_state(ids, qpos, qvel)
    failed = sim.step(ctrl, substeps=4)            # ids of rows MuJoCo could not step; they need a reset
    state = sim.state()                            # BodyState of all rows, fresh

Rows are independent and their results are bit-identical at any thread count. A row whose physics blows up is
reported, never silently reset (MuJoCo resets such a row and raises a warning counter; both that and raised
errors count as failed). It knows no clip, task or reward.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from llvmlite.binding import load_library_permanently
from mujoco.batch import Batch, SimulationError
from numba import types

from kinetok.sim.kernels import kernel

FEW = 64  # rows that are not worth another thread
Rows = np.ndarray | slice  # ids (n,), or a run of rows
ALL = slice(None)
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

    @property
    def moving(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What every body has: pos, mat, linear, angular."""
        return self.pos, self.mat, self.linear, self.angular

    def rows(self, ids: Rows) -> "BodyState":
        """The state of rows ids only; of a slice of them without a copy."""
        return BodyState(
            pos=self.pos[ids],
            mat=self.mat[ids],
            linear=self.linear[ids],
            angular=self.angular[ids],
            quat=self.quat[ids],
        )

    def assign_(self, ids: np.ndarray, other: "BodyState") -> None:
        """Overwrite rows ids with another state's rows."""
        for name, values in vars(self).items():
            values[ids] = getattr(other, name)


def _mujoco() -> Path:
    """MuJoCo's library, which lies in its package under another name on each system."""
    here = Path(mujoco.__file__).parent
    for name in ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll"):
        for path in here.glob(name):
            return path
    raise ImportError(f"{here}: MuJoCo's own library is not in its package; pip install --force-reinstall mujoco")


# Called by address from compiled loops: the package binds these functions for one MjData at a time.
load_library_permanently(str(_mujoco()))
MODEL_DATA = types.void(types.intp, types.intp)
mj_kinematics, mj_com_pos, mj_com_vel = (
    types.ExternalFunction(name, MODEL_DATA) for name in ("mj_kinematics", "mj_comPos", "mj_comVel")
)


Look = Callable[[slice, BodyState], None]


class BatchSim:
    """`rows` simulations of one model on `threads` threads (0: all cores).

    After a step a batch's body states are one substep old. It can bring them up to date together with contacts and
    forces, which nobody asks for; so MuJoCo's kinematics are called here for each row, in a fifth of the time.
    """

    def __init__(self, model: mujoco.MjModel, rows: int, threads: int = 0):
        self.model, self.rows = model, rows
        self._batch = Batch(model, rows, threads)
        self.qpos, self.qvel, self._ctrl = (self._batch.bind(n) for n in ("qpos", "qvel", "ctrl"))
        self._rest = self._batch.state[0].copy()
        self._blow_ups = self._counted()
        self._data = [mujoco.MjData(model) for _ in range(self._batch.nthread)]
        self._pool = ThreadPoolExecutor(self._batch.nthread)
        self._now = self._blank(rows)
        self._refresh(np.arange(rows), self._now)

    def set_state(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put rows ids (n,) into poses qpos (n, nq) and velocities qvel (n, nv) and refresh their body states."""
        self._batch.state[ids] = self._rest  # what reset does, without a second call to the threads
        self.qpos[ids], self.qvel[ids] = qpos, qvel
        fresh = self._blank(len(ids))
        self._refresh(np.asarray(ids), fresh)
        self._now.assign_(ids, fresh)

    def add_velocity(self, ids: np.ndarray, delta: np.ndarray) -> None:
        """Push rows ids: add delta (n, 3) m/s to the root's linear velocity. Body states follow at the next step."""
        self.qvel[ids, :3] += delta

    def set_friction(self, floor: np.ndarray) -> None:
        """Sliding friction (N,) of the floor, geom 0, in each row."""
        self._batch.expand("geom_friction")[:, 0, 0] = floor

    def step(self, ctrl: np.ndarray, substeps: int, look: Look | None = None) -> np.ndarray:
        """Advance all rows by `substeps` physics steps under ctrl (N, nu); returns ids (k,) of the failed rows.

        look(rows, body) is called by every thread with its run of the rows and their body states, while they are in
        its cache.
        """
        self._ctrl[:] = ctrl
        raised = np.empty(0, dtype=int)
        try:
            self._batch.step(nstep=substeps)
        except SimulationError as error:
            raised = np.asarray(error.ids)
        self._now = self._blank(self.rows)
        self._refresh(np.arange(self.rows), self._now, look)
        before, self._blow_ups = self._blow_ups, self._counted()
        return np.union1d(raised, np.flatnonzero(self._blow_ups > before))

    def _counted(self) -> np.ndarray:
        return self._batch.warning[:, BLOW_UPS, 1].sum(1)  # (N, warning, [last info, count])

    def state(self, ids: Rows = ALL) -> BodyState:
        """Body states of all rows or a run of them, as they are until the next step, or a copy of those of ids (n,);
        not to be written to."""
        return self._now.rows(ids)

    def _blank(self, rows: int) -> BodyState:
        shape = rows, self.model.nbody - 1
        return BodyState(
            pos=np.empty((*shape, 3), np.float32),
            mat=np.empty((*shape, 3, 3), np.float32),
            linear=np.empty((*shape, 3), np.float32),
            angular=np.empty((*shape, 3), np.float32),
            quat=np.empty((rows, 4), np.float32),
        )

    def _refresh(self, ids: np.ndarray, body: BodyState, look: Look | None = None) -> None:
        """Write the body states of rows ids (n,) to body, in parts side by side, each with an MjData of its own."""
        parts = min(len(self._data), len(ids) // FEW + 1)
        edges = [len(ids) * part // parts for part in range(parts + 1)]

        def work(part: int) -> None:
            data, rows = self._data[part], slice(edges[part], edges[part + 1])
            own = data.qpos, data.qvel, data.xpos, data.xmat, data.cvel, data.subtree_com
            some = body.rows(rows)
            out = some.pos, some.mat, some.linear, some.angular, some.quat
            _evaluate(self.model._address, data._address, *own, self.qpos, self.qvel, ids[rows], *out)
            if look:
                look(rows, some)

        others = [self._pool.submit(work, part) for part in range(1, parts)]
        work(0)
        for other in others:
            other.result()


@kernel
def _evaluate(model, data, q, v, xpos, xmat, cvel, com, qpos, qvel, rows, pos, mat, linear, angular, quat):
    """Body states of `rows` of qpos and qvel, through an MjData at address `data` whose arrays are q to com."""
    for n in range(len(rows)):
        row = rows[n]
        q[:], v[:], quat[n] = qpos[row], qvel[row], qpos[row, 3:7]
        mj_kinematics(model, data)
        mj_com_pos(model, data)
        mj_com_vel(model, data)
        for b in range(pos.shape[1]):
            # cvel: angular, then linear velocity of what of the body is at the whole's centre of mass
            wx, wy, wz = cvel[b + 1, 0], cvel[b + 1, 1], cvel[b + 1, 2]
            x, y, z = xpos[b + 1, 0] - com[1, 0], xpos[b + 1, 1] - com[1, 1], xpos[b + 1, 2] - com[1, 2]
            linear[n, b, 0] = cvel[b + 1, 3] + wy * z - wz * y
            linear[n, b, 1] = cvel[b + 1, 4] + wz * x - wx * z
            linear[n, b, 2] = cvel[b + 1, 5] + wx * y - wy * x
            for i in range(3):
                angular[n, b, i], pos[n, b, i] = cvel[b + 1, i], xpos[b + 1, i]
                for j in range(3):
                    mat[n, b, i, j] = xmat[b + 1, 3 * i + j]
