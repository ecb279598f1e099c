"""Left-right reflection of poses: an affine map of qpos, read off the MJCF.

    matrix, offset = mirror_map(model, counterparts, axis=1)
    mirrored = qpos @ matrix.T + offset

World: M = diag(1, -1, 1), the xz plane. A body b with the rest frame R_b (root at identity) has the mirror image c
with R_c = P R_b S_b, where P reflects the root's frame; so S_b = R_b' P R_c is the reflection that belongs to the body
frames, however they are turned. A joint's rotation Q about b's frame becomes S_b' Q S_b about c's: a hinge's angle
keeps or changes its sign, a ball joint's rotation vector v becomes -S_b' v, the root's rotation R becomes M R P.
Refused: a rest pose, joints or axes that are not mirror images within a millimetre or a milliradian.
"""

import mujoco
import numpy as np

from kinetok.config import ConfigError
from kinetok.rotation import multiply

CLOSE = 1e-3
SWAP = np.diag([1.0, -1.0, 1.0, -1.0])  # the quaternion of M R M, M = diag(1, -1, 1)


def mirror_map(model: mujoco.MjModel, images: list[int], axis: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """matrix (nq, nq) and offset (nq,) of the reflection; images: for each body but the world its image's index;
    axis: of the root's frame, which points sideways; name: of the character, for messages."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    mujoco.mj_kinematics(model, data)
    plane = np.eye(3)
    plane[axis, axis] = -1
    matrix, offset = np.zeros((model.nq, model.nq)), np.zeros(model.nq)
    matrix[:3, :3] = np.diag([1, -1, 1])
    matrix[3:7, 3:7] = _right(_side(axis)) @ SWAP
    images = [0, *(c + 1 for c in images)]
    for b, c in enumerate(images[1:], start=1):
        here, there = model.body(b).name, model.body(c).name
        if model.body_parentid[c] != images[model.body_parentid[b]] or images[c] != b:
            raise ConfigError(f"character {name!r}: the parents of {here!r} and {there!r} are not mirror images")
        if np.abs(data.xpos[c] - plane @ data.xpos[b]).max() > CLOSE:
            raise ConfigError(
                f"character {name!r}: at rest the body {there!r} is at {data.xpos[c].round(4).tolist()}, which is not "
                f"the mirror image of {here!r} at {data.xpos[b].round(4).tolist()}; the MJCF or 'mirror' is at fault"
            )
        own, image = _joints(model, b), _joints(model, c)
        if [model.jnt_type[j] for j in own] != [model.jnt_type[j] for j in image]:
            raise ConfigError(f"character {name!r}: the bodies {here!r} and {there!r} have unlike joints")
        turned = data.xmat[b].reshape(3, 3).T @ plane @ data.xmat[c].reshape(3, 3)
        for j, k in zip(own, image, strict=True):
            _joint(model, j, k, turned, matrix, offset, name)
    return matrix, offset


def _joints(model: mujoco.MjModel, body: int) -> list[int]:
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    return [j for j in joints if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]


def _joint(
    model: mujoco.MjModel, j: int, k: int, turned: np.ndarray, matrix: np.ndarray, offset: np.ndarray, name: str
) -> None:
    """Write into matrix and offset what joint k does when joint j is mirrored; turned (3, 3) is S of j's body."""
    p, q = model.jnt_qposadr[j], model.jnt_qposadr[k]
    axis = turned.T @ model.jnt_axis[j]
    if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL:
        matrix[q, p] = 1
        matrix[q + 1 : q + 4, p + 1 : p + 4] = -turned.T
        aligned = 1.0
    else:
        aligned = float(axis @ model.jnt_axis[k])
        sign = np.sign(aligned) * (1 if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else -1)
        matrix[q, p] = sign
        offset[q] = model.qpos0[q] - sign * model.qpos0[p]
    anchored = np.abs(turned.T @ model.jnt_pos[j] - model.jnt_pos[k]).max() < CLOSE
    if abs(aligned) < 1 - CLOSE**2 or not anchored:
        raise ConfigError(
            f"character {name!r}: the joints {model.joint(j).name!r} and {model.joint(k).name!r} are not mirror "
            "images: their axes or anchors differ"
        )


def _side(axis: int) -> np.ndarray:
    """Quaternion of M P, where P reflects the axis: the half turn about z or x, or none."""
    return np.array([[0.0, 0, 0, 1], [1.0, 0, 0, 0], [0.0, 1, 0, 0]])[axis]


def _right(q: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) of multiplication by the quaternion q (4,) from the right."""
    return multiply(np.eye(4), q).T
