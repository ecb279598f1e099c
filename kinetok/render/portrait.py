"""A character introduced: a picture of it standing, and its facts as text.

    write_portrait(Path("g1.png"), Character.load("g1"))       # from the front, from three quarters, from the side
    print(describe(Character.load("g1")))

The pose is the character's own standing pose (roles, "stand"), or its rest pose. No motion, no simulation.
"""

import os
from pathlib import Path

import matplotlib.image
import mujoco
import numpy as np

from kinetok.motion.character import Character
from kinetok.motion.roles import PARTS
from kinetok.render.video import _render

AZIMUTHS = (180.0, 138.0, 90.0)  # degrees; the camera looks towards -x, at its own left, towards +y
ELEVATION, MARGIN = -8.0, 1.35  # degrees; height of the picture in heights of the character


def write_portrait(path: Path | str, character: Character, *, size: tuple[int, int] = (320, 480)) -> None:
    """Write a PNG of three views of the character standing, side by side, each of size (width, height)."""
    path = Path(path)
    if path.suffix != ".png":
        raise ValueError(f"{path}: a portrait is a PNG; the name must end in .png")
    qpos = character.stand()
    height = character.span(qpos)[1]
    half_view = np.deg2rad(character.model.vis.global_.fovy) / 2
    cameras = []
    for azimuth in AZIMUTHS:
        camera = mujoco.MjvCamera()
        camera.lookat[:] = qpos[0], qpos[1], height / 2
        camera.distance = MARGIN * height / 2 / np.tan(half_view)
        camera.azimuth, camera.elevation = azimuth, ELEVATION
        cameras.append(camera)
    poses = np.tile(qpos, (len(cameras), 1))
    views = list(_render(character, poses, cameras, size, ghost=None, caption="", markers=None))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.png")
    matplotlib.image.imsave(temporary, np.concatenate(views, axis=1))
    os.replace(temporary, path)


def describe(character: Character) -> str:
    """Bodies, degrees of freedom, mass, height, roles and a table of the joints (rad, N m / rad, N m s / rad, N m)."""
    model, stand = character.model, character.stand()
    height = character.span(stand)[1]
    driven = len(set(character.dof.tolist()))
    lines = [
        f"{character.name}: {len(character.body_names)} bodies, {character.nv - 6} degrees of freedom beside the "
        f"root's, {driven} of them driven (nq {character.nq}, nv {character.nv}, nu {character.nu})",
        f"mass {model.body_mass.sum():.2f} kg, standing {height:.2f} m high, root at {stand[2]:.3f} m",
        "",
        *_roles(character),
        "",
        f"{'joint':<28}{'kind':<7}{'range':>15}{'kp':>8}{'kd':>8}{'torque':>8}",
    ]
    drives = {int(dof): u for u, dof in enumerate(character.dof)}
    for joint in range(1, model.njnt):
        u = drives.get(int(model.jnt_dofadr[joint]))
        low, high = model.jnt_range[joint]
        span = f"{low:.2f} .. {high:.2f}" if model.jnt_limited[joint] else "free"
        drive = () if u is None else (character.kp[u], character.kd[u], character.torque[u])
        kind = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
        lines.append(f"{model.joint(joint).name:<28}{kind:<7}{span:>15}" + "".join(f"{x:>8.4g}" for x in drive))
    return "\n".join(lines)


def _roles(character: Character) -> list[str]:
    """What the roles file says, and what it leaves open."""
    roles = character.roles
    lines = [
        f"{role:<10}{roles[role] if isinstance(roles[role], str) else ', '.join(roles[role])}"
        for role in roles
        if role not in ("mirror", "retarget", "stand")
    ]
    if "mirror" in roles:
        swap = roles["mirror"]["swap"]
        rule = swap if isinstance(swap, str) else f"{len(swap)} pairs of bodies"
        lines.append(f"{'mirror':<10}{rule}, through {roles['mirror']['plane']}")
    lines += [f"{'':<10}{part:<17}{character.body_names[body]}" for part, body in character.parts.items()]
    if character.parts:
        lines[-len(character.parts)] = f"{'retarget':<10}" + lines[-len(character.parts)].lstrip()
    open_roles = [role for role in ("feet", "hands", "head", "mirror", "retarget", "stand") if role not in roles]
    open_parts = [part for part in PARTS if part not in character.parts and not part.endswith("toe")]
    if open_roles:
        lines.append("no role named: " + ", ".join(open_roles))
    if open_parts and character.parts:
        lines.append("no part named: " + ", ".join(open_parts))
    return lines
