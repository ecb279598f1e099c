"""export.py: a clip of a character becomes a skeleton that stands and moves as its bodies do."""

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.character import Character, from_mjcf
from kinetok.motion.clip import Clip
from kinetok.motion.export import skeleton_motion
from kinetok.motion.formats.bvh import read_bvh, write_bvh
from kinetok.motion.kinematics import kinematics
from kinetok.motion.skeleton import SkeletonMotion

OFF_CENTRE = """
<mujoco model="off">
  <worldbody>
    <body name="base" quat="0.6 0 0 0.8">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="arm" pos="0.1 0 0.5" quat="0.8 0.6 0 0">
        <joint name="elbow" type="{kind}" axis="0 1 0" pos="0.02 0.03 -0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.05"/>
        <body name="hand" pos="0 0 1"><geom type="sphere" size="0.1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20"/></actuator>
</mujoco>
"""


def test_the_joints_of_the_humanoid_are_its_bodies(humanoid, walk):
    motion = skeleton_motion(humanoid, walk)
    assert (motion.joints, motion.parents, motion.fps) == (humanoid.body_names, humanoid.parents, walk.fps)
    bodies = kinematics(humanoid, walk.qpos, walk.fps)
    positions, rotations = motion.pose()
    np.testing.assert_allclose(positions, bodies.xpos, atol=1e-9)
    rest = kinematics(humanoid, humanoid.model.qpos0[None].repeat(2, 0), 1.0)
    expected = rotation.multiply(bodies.xquat, rotation.conjugate(rest.xquat[:1]))
    np.testing.assert_allclose(rotation.to_matrix(rotations), rotation.to_matrix(expected), atol=1e-9)


def test_all_rotations_are_zero_in_the_reference_pose(humanoid):
    still = Clip(name="still", character="humanoid", fps=30.0, qpos=humanoid.model.qpos0[None].repeat(2, 0))
    motion = skeleton_motion(humanoid, still)
    np.testing.assert_allclose(rotation.to_rotvec(motion.local), 0, atol=1e-9)


def test_the_walk_survives_a_bvh_file(humanoid, walk, tmp_path):
    motion = skeleton_motion(humanoid, walk)
    write_bvh(tmp_path / "walk.bvh", motion)
    again = read_bvh(tmp_path / "walk.bvh")
    assert (again.unit, again.fps) == ("cm", pytest.approx(walk.fps, rel=1e-9))
    order = [again.joints.index(name) for name in motion.joints]
    np.testing.assert_allclose(again.pose()[0][:, order], motion.pose()[0], atol=1e-5)


def clip_of(path, kind: str) -> tuple[Character, Clip]:
    path.write_text(OFF_CENTRE.format(kind=kind))
    body = Character.load(str(path))
    qpos = np.tile(body.model.qpos0, (5, 1))
    qpos[:, 7] = np.linspace(0, 0.8, 5)
    return body, Clip(name="bend", character=str(path), fps=10.0, qpos=qpos)


def test_a_joint_stands_where_its_axis_is(tmp_path):
    body, clip = clip_of(tmp_path / "off.xml", "hinge")
    motion = skeleton_motion(body, clip)
    poses = kinematics(body, clip.qpos, clip.fps)
    positions = motion.pose()[0]
    np.testing.assert_allclose(positions[:, 1], positions[:1, 1].repeat(5, 0), atol=1e-9)
    assert np.ptp(poses.xpos[:, 1], axis=0).max() > 0.05  # while the body's origin swings about it
    np.testing.assert_allclose(positions[:, 2], poses.xpos[:, 2], atol=1e-9)


def test_what_cannot_be_a_skeleton(tmp_path, walk, tiny):
    body, clip = clip_of(tmp_path / "slide.xml", "slide")
    with pytest.raises(ValueError, match=r"body 'arm' moves by 0\.8 m against its parent"):
        skeleton_motion(body, clip)
    with pytest.raises(ValueError, match=r"clip 'walk' has 43 columns; 'tiny' has 12"):
        skeleton_motion(tiny, walk)


def test_an_unnamed_body_is_no_bvh_joint(tmp_path):
    body = from_mjcf("off", OFF_CENTRE.format(kind="hinge").replace('<body name="hand"', "<body"), {})
    motion = SkeletonMotion(
        name="x", fps=1, joints=body.body_names, parents=body.parents, offsets=np.zeros((3, 3)),
        local=np.tile([1.0, 0, 0, 0], (2, 3, 1)), root=np.zeros((2, 3)),
    )  # fmt: skip
    with pytest.raises(ValueError, match="joint '' has a name that BVH cannot hold"):
        write_bvh(tmp_path / "x.bvh", motion)
    assert not list(tmp_path.iterdir())
