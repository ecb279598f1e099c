"""A character: any MJCF read once, with the names, addresses, limits, gains and roles the rest of kinetok needs.

    humanoid = Character.load("humanoid")          # built in, see characters()
    robot = Character.load("my_robot.xml")         # roles in my_robot.json beside it, optional; see known_roles
    talos = Character.load("menagerie:pal_talos")  # with the package mujoco-menagerie, which downloads it
    humanoid.body_names, humanoid.nu, humanoid.kp, humanoid.parts["left_shin"], humanoid.mirror_qpos(qpos)

The MJCF holds one tree with a free root and position actuators (PD control with kp in the actuator and kd as
joint damping or actuator kv); floor, light and solver options belong to `sim.scene`. Refused: no free root, no
actuators, an actuator without a position gain, a floor. It does not know clips, simulation or learning.
"""

import functools
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from kinetok.config import ConfigError, nearest
from kinetok.motion.mirror import mirror_map
from kinetok.motion.roles import JOINTS, PARTS, PLANES, check_roles, counterparts, read_roles
from kinetok.rotation import from_rotvec, to_rotvec

try:
    import mujoco_menagerie as menagerie
except ImportError:
    menagerie = None  # pyright: ignore[reportAssignmentType]

BUILT_IN = ("humanoid", "g1")
ASSETS = Path(__file__).parent / "assets"
MENAGERIE = "menagerie:"


def characters() -> list[str]:
    """Names of the built-in characters."""
    return list(BUILT_IN)


@dataclass(frozen=True, kw_only=True, eq=False)
class Character:
    """Immutable description of a body.

    Fields: name; xml: the MJCF text; roles: {"feet": [...], "hands": [...], "head": ...} by body name, see roles.py;
    model: the compiled MjModel of the character alone (no floor); body_names (B,) without the world;
    parents (B,) index into body_names, -1 for the root; kp, kd, torque (nu,) in N m / rad, N m s / rad, N m;
    ball (nj, 2): for each ball joint its first qpos and first actuator column; hinge (nj, 2) likewise; dof (nu,):
    the degree of freedom each actuator drives.
    """

    name: str
    xml: str = field(repr=False)
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
        """The built-in character of that name, the one in the MJCF file at that path, or one of the menagerie."""
        if name in BUILT_IN:
            path = ASSETS / f"{name}.xml"
            return from_mjcf(name, path.read_text(), read_roles(path.with_suffix(".json")), f"{name}.json")
        path = _from_menagerie(name) if name.startswith(MENAGERIE) else Path(name)
        if path.suffix != ".xml":
            raise ConfigError(
                f"unknown character {name!r}{nearest(name, BUILT_IN)}; built in: {', '.join(BUILT_IN)}; "
                "or give the path of an MJCF file ending in .xml"
            )
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such MJCF file")
        roles = path.with_suffix(".json")
        found = from_mjcf(path.stem, read_mjcf(path), read_roles(roles) if roles.exists() else {}, str(roles))
        return found if roles.exists() else replace(found, roles=known_roles(found.model))

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

    @functools.cached_property
    def parts(self) -> dict[str, int]:
        """Parts of a body (roles.PARTS: "pelvis", "left_thigh", ...) as indices into body_names, as far as the roles
        name them. A part is the body that turns with that segment."""
        named = self.roles.get("retarget", {})
        return {part: self.body_names.index(named[part]) for part in PARTS if part in named}

    def part(self, name: str) -> int:
        """Index into body_names of one part, named as in `parts` or by the joint at its upper end ("left_knee")."""
        side, _, joint = name.partition("_")
        name = f"{side}_{JOINTS[joint]}" if joint in JOINTS else name
        if name not in PARTS:
            raise ConfigError(f"unknown part {name!r}; one of: {', '.join(PARTS)}{nearest(name, PARTS)}")
        if name not in self.parts:
            raise ConfigError(
                f"character {self.name!r}: no body is named for {name!r}; named: {', '.join(self.parts) or 'none'}; "
                f'add "retarget": {{"{name}": <body>}} to its roles file; bodies: {", ".join(self.body_names)}'
            )
        return self.parts[name]

    def mirror_qpos(self, qpos: np.ndarray) -> np.ndarray:
        """Poses (..., nq) reflected left to right through the world's xz plane; sides change places."""
        matrix, offset = self._mirror
        return (qpos @ matrix.T + offset).astype(qpos.dtype, copy=False)

    @functools.cached_property
    def _mirror(self) -> tuple[np.ndarray, np.ndarray]:
        if "mirror" not in self.roles:
            raise ConfigError(
                f"character {self.name!r} names no 'mirror', which says which of its bodies are left and right; "
                'add "mirror": {"swap": "left_ <-> right_", "plane": "xz"} to its roles file'
            )
        images = counterparts(self.roles, list(self.body_names), f"character {self.name!r}")
        return mirror_map(self.model, images, PLANES[self.roles["mirror"]["plane"]], self.name)

    def stand(self) -> np.ndarray:
        """The standing pose (nq,): joint angles of the role "stand", those it leaves out at rest; the lowest geom that
        collides touches the floor."""
        qpos = self.model.qpos0.copy()
        for name, angle in self.roles.get("stand", {}).items():
            joint = self.model.joint(name)
            ball = joint.type[0] == mujoco.mjtJoint.mjJNT_BALL
            values = from_rotvec(np.array(angle, dtype=float)) if ball else np.ravel(angle)
            qpos[joint.qposadr[0] : joint.qposadr[0] + len(values)] = values
        qpos[2] -= self.span(qpos)[0]
        return qpos

    def span(self, qpos: np.ndarray) -> tuple[float, float]:
        """Heights in metres of the lowest and the highest point of the geoms that collide, in pose qpos (nq,)."""
        far, flip = 100.0, [0, 1, 0, 0]
        spec, plane = mujoco.MjSpec.from_string(self.xml), mujoco.mjtGeom.mjGEOM_PLANE
        for name, z, quat in (("span low", -far, [1, 0, 0, 0]), ("span high", far, flip)):
            spec.worldbody.add_geom(name=name, type=plane, size=[0, 0, 1], pos=[0, 0, z], quat=quat, contype=0)
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        low, high = model.geom("span low").id, model.geom("span high").id
        geoms = set(np.flatnonzero(_meets_floor(model)).tolist()) - {low, high}
        gap = [min(mujoco.mj_geomDistance(model, data, p, g, 2 * far, None) for g in geoms) for p in (low, high)]
        return gap[0] - far, far - gap[1]

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


def from_mjcf(name: str, xml: str, roles: dict, roles_file: str = "roles") -> Character:
    """Read an MJCF text; errors name the character and what its MJCF lacks. roles_file: for messages."""
    try:
        model = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise ConfigError(f"character {name!r}: MuJoCo cannot read its MJCF: {error}") from error
    _check_tree(name, model)
    kp = _position_gains(name, model)
    ball, hinge, dof = _actuated(name, model)
    check_roles(roles, model, roles_file)
    return Character(
        name=name,
        xml=xml,
        roles=roles,
        model=model,
        body_names=tuple(model.body(i).name for i in range(1, model.nbody)),
        parents=tuple(int(p) - 1 for p in model.body_parentid[1:]),
        kp=kp,
        kd=model.dof_damping[dof] - model.actuator_biasprm[:, 2],
        torque=_torque_limits(model),
        ball=ball,
        hinge=hinge,
        dof=dof,
    )


def _torque_limits(model: mujoco.MjModel) -> np.ndarray:
    """N m (nu,) that each actuator can give: by its own forcerange or its joint's actuatorfrcrange, inf for neither."""
    joint = model.actuator_trnid[:, 0]
    own = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    return np.minimum(own, np.where(model.jnt_actfrclimited[joint], model.jnt_actfrcrange[joint, 1], np.inf))


def known_roles(model: mujoco.MjModel) -> dict:
    """The roles of the built-in character that a model is by its names: it has every body and joint that they name, as
    the Unitree G1 of the menagerie, of mjlab and of others has; {} where there is none."""
    for name in BUILT_IN:
        roles = read_roles(ASSETS / f"{name}.json")
        try:
            check_roles(roles, model, name)
        except ConfigError:
            continue
        return roles
    return {}


def read_mjcf(path: Path) -> str:
    """The MJCF text at path, complete in itself: includes are expanded, mesh and texture folders made absolute."""
    text = path.read_text(encoding="utf-8")
    if not re.search(r"\bfile\w*\s*=", text):
        return text
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"{path}: MuJoCo cannot read it: {error}") from error
    folder = path.parent.resolve()
    spec.meshdir, spec.texturedir = str(folder / spec.meshdir), str(folder / spec.texturedir)
    return spec.to_xml()


def _from_menagerie(name: str) -> Path:
    """The MJCF of "menagerie:ROBOT" or "menagerie:ROBOT/VARIANT", downloaded unless it is in the package's cache."""
    if menagerie is None:
        raise ConfigError(f"{name}: the menagerie's models come with a package: pip install mujoco-menagerie")
    robot, _, entry = name.removeprefix(MENAGERIE).partition("/")
    try:
        found = menagerie.get(robot)
        return found.xml(entry or found.default_model)
    except menagerie.DownloadError as error:
        raise ConfigError(
            f"{name}: the download failed: {error}; connect to the network, or set MENAGERIE_ROOT to a checkout of "
            "mujoco_menagerie"
        ) from error
    except (menagerie.MenagerieError, OSError) as error:
        raise ConfigError(f"{name}: {error}") from error


def _meets_floor(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms collide with the floor of sim.scene, whose contype and conaffinity are 1."""
    return (model.geom_contype & 1) | (model.geom_conaffinity & 1) == 1


def _check_tree(name: str, model: mujoco.MjModel) -> None:
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE or model.jnt_bodyid[0] != 1:
        raise ConfigError(f"character {name!r}: the first joint must be a free joint (<freejoint/> in the root body)")
    roots = [model.body(i).name for i in range(1, model.nbody) if model.body_parentid[i] == 0]
    if len(roots) > 1:
        raise ConfigError(f"character {name!r}: bodies {', '.join(map(repr, roots))} in the world; it must be one tree")
    if model.body_geomnum[0]:
        floor = model.geom(model.body_geomadr[0]).name
        raise ConfigError(f"character {name!r}: its world has a geom ({floor!r}); leave out the floor, scenes have one")
    if not _meets_floor(model).any():
        raise ConfigError(f'character {name!r}: no geom collides with the floor; give its feet conaffinity="1"')


def _position_gains(name: str, model: mujoco.MjModel) -> np.ndarray:
    """kp (nu,) of the position actuators; any other kind of actuator is refused."""
    if model.nu == 0:
        raise ConfigError(f"character {name!r}: no actuators; add <position> actuators, they are the PD targets")
    kp = model.actuator_gainprm[:, 0].copy()
    wrong = (kp <= 0) | ~np.isclose(model.actuator_biasprm[:, 1], -kp)
    elsewhere = model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT
    if elsewhere.any():
        bad = model.actuator(int(np.argmax(elsewhere))).name
        raise ConfigError(
            f"character {name!r}: actuator {bad!r} does not drive a joint; leave it out, or give it joint="
        )
    if not wrong.any():
        return kp
    bad = int(np.argmax(wrong))
    joint = model.joint(model.actuator_trnid[bad, 0])
    stiffness, damping = model.jnt_stiffness[joint.id].flat[0], model.dof_damping[joint.dofadr[0]].flat[0]
    hint = ""
    if stiffness > 0:
        hint = (
            f"; the stiffness {stiffness:g} and damping {damping:g} of its joint are a spring here: if they are meant "
            "as PD gains, move them into the actuator as kp and kv"
        )
    raise ConfigError(
        f"character {name!r}: actuator {model.actuator(bad).name!r} is not a <position> actuator; PD control "
        f'needs <position joint="{joint.name}" kp="..." kv="..." forcerange="..."/>{hint}'
    )


def _actuated(name: str, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ball (nj, 2), hinge (nj, 2) and dof (nu,) of a Character."""
    ball, hinge, dof = [], [], np.empty(model.nu, dtype=int)
    for u in range(model.nu):
        joint = model.actuator_trnid[u, 0]
        q, d = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            raise ConfigError(f"character {name!r}: actuator {model.actuator(u).name!r} drives the root, which is free")
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
            if model.actuator_gear[u, 0] != 1:
                raise ConfigError(
                    f"character {name!r}: actuator {model.actuator(u).name!r} has gear {model.actuator_gear[u, 0]:g}; "
                    "PD targets are joint angles, so put it into kp and leave the gear at 1"
                )
            hinge.append((q, u))
            dof[u] = d
    return np.array(ball, dtype=int).reshape(-1, 2), np.array(hinge, dtype=int).reshape(-1, 2), dof
