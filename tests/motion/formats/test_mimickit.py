"""mimickit.py: files pickled as MimicKit's Motion.save does it; bodies stand where MimicKit's own model puts them."""

import pickle

import mujoco
import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.formats import FormatError, read, read_mimickit
from kinetok.motion.kinematics import kinematics

# ours for MimicKit's bodies; its hands, feet and head have the same names
NAMES = {"torso": "chest"}


def write(tmp_path, frames, loop_mode=0, fps=30, **more):
    path = tmp_path / "motion.pkl"
    path.write_bytes(pickle.dumps({"loop_mode": loop_mode, "fps": fps, "frames": frames} | more))
    return path


def random_frames(count: int, degrees: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    frames = rng.uniform(-1, 1, (count, 6 + degrees))
    frames[:, 2] = 0.9
    return frames


def their_bodies(model: mujoco.MjModel, frames: np.ndarray) -> dict[str, np.ndarray]:
    """World positions (T, 3) by body name, by MimicKit's kin_char_model: joint rotations follow the fixed ones."""
    world, column = {0: (np.zeros((len(frames), 3)), np.tile([1.0, 0, 0, 0], (len(frames), 1)))}, 6
    out = {}
    for body in range(1, model.nbody):
        pos, rot = world[int(model.body_parentid[body])]
        count, first = int(model.body_jntnum[body]), int(model.body_jntadr[body])
        if body == 1:
            pos, rot = frames[:, :3], rotation.from_rotvec(frames[:, 3:6])
        else:
            pos = pos + rotation.rotate(rot, model.body_pos[body])
            rot = rotation.multiply(rot, model.body_quat[body])
            values = frames[:, column : column + count]
            vectors = values if count == 3 else values * model.jnt_axis[first] if count else np.zeros((len(frames), 3))
            rot = rotation.multiply(rot, rotation.from_rotvec(vectors))
            column += count
        world[body] = pos, rot
        out[model.body(body).name] = pos
    assert column == frames.shape[1]
    return out


def test_bodies_stand_where_mimickit_puts_them(tmp_path, data_dir, humanoid):
    model = mujoco.MjModel.from_xml_path(str(data_dir / "train" / "characters" / "mimickit_humanoid.xml"))
    frames = random_frames(20, 28)
    (clip,) = read(write(tmp_path, frames))
    assert (clip.character, clip.fps, clip.loop, clip.name) == ("humanoid", 30.0, False, "motion")
    ours = kinematics(humanoid, clip.qpos, clip.fps).xpos
    theirs = their_bodies(model, frames)
    assert len(theirs) == len(humanoid.body_names)
    for name, places in theirs.items():
        index = humanoid.body_names.index(NAMES.get(name, name))
        np.testing.assert_allclose(ours[:, index], places, atol=2e-6, err_msg=name)


def test_the_robot_and_loops(tmp_path, squat):
    vectors = rotation.to_rotvec(squat.quats)
    clip = read_mimickit(write(tmp_path, np.concatenate([squat.root, vectors, squat.joints], axis=1).tolist(), 1, 60))
    assert (clip.character, clip.fps, clip.loop) == ("g1", 60.0, True)
    np.testing.assert_allclose(clip.qpos, squat.qpos, atol=1e-9)


@pytest.mark.parametrize(
    ("frames", "more", "where", "reason"),
    [
        (random_frames(5, 31), {}, "frames", "31 degrees of freedom; known: 28 (humanoid), 29 (g1)"),
        (random_frames(1, 28), {}, "frames", "1 frames; a motion needs at least two"),
        (random_frames(5, 28) * np.inf, {}, "frames[0, 0]", "is not a finite number"),
        (random_frames(5, 28)[0], {}, "frames", "has shape (34,); the format has (T, any)"),
        (random_frames(5, 28), {"loop_mode": 2}, "loop_mode", "2; it is 0 (clamp) or 1 (wrap)"),
        (random_frames(5, 28), {"fps": [30, 60]}, "fps", "is no frame rate"),
        ("frames", {}, "frames", "is str, not numbers"),
    ],
)
def test_malformed_files(tmp_path, frames, more, where, reason):
    with pytest.raises(FormatError) as caught:
        read_mimickit(write(tmp_path, frames, **more))
    assert caught.value.where == where and reason in str(caught.value)
