"""From a foreign motion to a clip of a character, with an account of what was lost.

    result = retarget(read_bvh(Path("walk.bvh")), "humanoid")
    result.clip, result.report.residual_mean

The steps: tell the rig's parts (motion/rigs.py), measure the character (body.py), read the actor's directions
(source.py). Where the skeleton is the character's own, joint angles are copied (direct.py); else make targets in its
proportions with feet on the ground (targets.py) and solve by inverse kinematics (solve.py). Assess (report.py). Rest
poses at the beginning of a file are not looked for: see motion/check.py. Refused: rigs whose parts cannot be told,
characters that do not name theirs.
"""

from dataclasses import dataclass, replace

from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.retarget.body import measure
from kinetok.motion.retarget.direct import copy_joints
from kinetok.motion.retarget.report import RetargetReport, assess
from kinetok.motion.retarget.solve import clear_floor, solve
from kinetok.motion.retarget.source import read_actor, resample
from kinetok.motion.retarget.targets import make_plan
from kinetok.motion.rigs import find_rig
from kinetok.motion.skeleton import SkeletonMotion


@dataclass(frozen=True, kw_only=True)
class Retargeted:
    """clip: the motion on the character; report: how well it fits."""

    clip: Clip
    report: RetargetReport


def retarget(
    motion: SkeletonMotion,
    character: str,
    *,
    fps: float | None = 30.0,
    parts: dict[str, str] | None = None,
    direct: bool = True,
) -> Retargeted:
    """Fit a motion to a character, at fps frames per second (None: the motion's own rate).

    parts: generic part -> joint name of the motion's skeleton, for rigs that are not known; see motion/rigs.py.
    direct: copy the angles where the skeleton is the character's own; False solves for them there as well.
    """
    rig = find_rig(motion, parts)
    figure = measure(Character.load(character))
    actor = read_actor(motion, rig, fps)
    copied = copy_joints(resample(motion, fps), rig, figure) if direct else None
    if copied:
        qpos, scaled, scale = copied.qpos, copied.places, copied.scale
        rig = replace(rig, how=f"{rig.how}, joint by joint")
    else:
        plan = make_plan(actor, figure)
        qpos = clear_floor(figure.character, solve(figure, plan, actor.fps), actor.fps)
        scaled, scale = plan.scaled, plan.scale
    clip = Clip(name=motion.name, character=character, fps=actor.fps, qpos=qpos, source=motion.source)
    return Retargeted(clip=clip, report=assess(clip, motion, rig, actor, figure, scaled=scaled, scale=scale))
