"""A character: any MJCF read once, with the names, addresses, limits, gains and roles the rest of kinetok needs.

    humanoid = Character.load("humanoid")          # built in
    robot = Character.load("my_robot.xml")         # roles in my_robot.json beside it, optional
    humanoid.body_names, humanoid.nu, humanoid.kp

The MJCF holds one tree with a free root and position actuators (PD control with kp in the actuator and kd as
joint damping or actuator kv); floor, light and solver options belong to `sim.scene`. Refused: no free root, no
actuators, an actuator without a position gain. It does not know clips, simulation or learning.
"""

import functools
import json
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np

from kinetok.config import ConfigError, nearest
from kinetok.rotation import to_rotvec

BUILT_IN = ("humanoid",)


@dataclass(frozen=True, kw_only=True, eq=False)
class Character:
    """Immutable description of a body.

    Fields: name; xml: the MJCF text; roles: {"feet": [...], "hands": [...], "head": ...} by body name;
    model: the compiled MjModel of the character alone (no floor); body_names (B,) without the world;
    parents (B,) index into body_names, -1 for the root; kp, kd, torque (nu,) in N m / rad, N m s / rad, N m;
    ball (nj, 2): for each ball joint its first qpos and first actuator column; hinge (nj, 2) likewise; dof (nu,):
    the degree of freedom each actuator drives.
    """

    name: str
    xml: str
    roles: dict
    model: mujoco.MjModel = field(repr=False)
    body_names: tuple[str, ...]
    parents: tuple[int, ...]
    kp: np.ndarray = field(repr=False)
    kd: np.ndarray = field(repr=False)
    torque: np.ndarray = field(repr=False)
    ball: np.ndarray = field(repr=False)
    hinge: np.ndarray = field(repr=False)
    dof: np.ndarray = field(repr=False)

    @staticmethod
    @functools.lru_cache(maxsize=16)
    def load(name: str) -> "Character":
        """The built-in character of that name, or the one in the MJCF file at that path."""
        if name in BUILT_IN:
            folder = resources.files("kinetok.motion") / "assets"
            xml, roles = (folder / f"{name}.xml").read_text(), json.loads((folder / f"{name}.json").read_text())
            return from_mjcf(name, xml, roles)
        path = Path(name)
        if path.suffix != ".xml":
            raise ConfigError(
                f"unknown character {name!r}{nearest(name, BUILT_IN)}; built in: {', '.join(BUILT_IN)}; "
                "or give the path of an MJCF file ending in .xml"
            )
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such MJCF file")
        roles_path = path.with_suffix(".json")
        roles = json.loads(roles_path.read_text()) if roles_path.exists() else {}
        return from_mjcf(path.stem, path.read_text(), roles)

    @property
    def nq(self) -> int:
        return self.model.nq

    @property
    def nv(self) -> int:
        return self.model.nv

    @property
    def nu(self) -> int:
        return self.model.nu

    def bodies(self, role: str) -> list[int]:
        """Indices into body_names of the bodies that play a role ("feet", "hands", "head")."""
        if role not in self.roles:
            raise ConfigError(f"character {self.name!r} names no {role!r}; roles known: {sorted(self.roles)}")
        names = self.roles[role]
        return [self.body_names.index(n) for n in ([names] if isinstance(names, str) else names)]

    def pose_to_ctrl(self, qpos: np.ndarray) -> np.ndarray:
        """PD targets (..., nu) whose rest is the pose qpos (..., nq): angles, and rotation vectors of ball joints."""
        ctrl = np.empty((*qpos.shape[:-1], self.nu), dtype=qpos.dtype)
        for q, u in self.hinge:
            ctrl[..., u] = qpos[..., q]
        if len(self.ball):
            columns = self.ball[:, 0, None] + np.arange(4)
            vectors = to_rotvec(qpos[..., columns])
            ctrl[..., self.ball[:, 1, None] + np.arange(3)] = vectors
        return ctrl


def from_mjcf(name: str, xml: str, roles: dict) -> Character:
    """Read an MJCF text; errors name the character and what its MJCF lacks."""
    model = mujoco.MjModel.from_xml_string(xml)
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ConfigError(f"character {name!r}: the first joint must be a free joint (<freejoint/> in the root body)")
    if model.nu == 0:
        raise ConfigError(f"character {name!r}: no actuators; add <position> actuators, they are the PD targets")
    kp = model.actuator_gainprm[:, 0].copy()
    if (kp <= 0).any() or not np.allclose(model.actuator_biasprm[:, 1], -kp):
        bad = model.actuator(int(np.argmax(~np.isclose(model.actuator_biasprm[:, 1], -kp)))).name
        raise ConfigError(f"character {name!r}: actuator {bad!r} is not a <position> actuator; PD control needs one")
    ball, hinge, dof = [], [], np.empty(model.nu, dtype=int)
    for u in range(model.nu):
        joint = model.actuator_trnid[u, 0]
        q, d = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            axis = u - ball[-1][1] if ball and ball[-1][0] == q else 0
            if axis > 2 or not np.array_equal(model.actuator_gear[u, :3], np.eye(3)[axis]):
                raise ConfigError(
                    f"character {name!r}: actuator {model.actuator(u).name!r} of a ball joint; that needs three "
                    'in a row, with gear "1 0 0", "0 1 0" and "0 0 1"'
                )
            dof[u] = d + axis
            if axis == 0:
                ball.append((q, u))
        else:
            hinge.append((q, u))
            dof[u] = d
    names = tuple(model.body(i).name for i in range(1, model.nbody))
    return Character(
        name=name,
        xml=xml,
        roles=roles,
        model=model,
        body_names=names,
        parents=tuple(int(p) - 1 for p in model.body_parentid[1:]),
        kp=kp,
        kd=model.dof_damping[dof] - model.actuator_biasprm[:, 2],
        torque=np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf),
        ball=np.array(ball, dtype=int).reshape(-1, 2),
        hinge=np.array(hinge, dtype=int).reshape(-1, 2),
        dof=dof,
    )
