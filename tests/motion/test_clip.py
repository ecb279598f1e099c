"""clip.py: time on loops and ends, resampling, slicing, closing, messages."""

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.clip import Clip, close_loop, interpolate, quaternion_columns
from kinetok.motion.kinematics import kinematics


def poses(humanoid, count: int) -> np.ndarray:
    """A straight path of 0.1 m a frame, turning and bending steadily."""
    qpos = np.tile(humanoid.model.qpos0, (count, 1))
    qpos[:, 0] = 0.1 * np.arange(count)
    qpos[:, 3:7] = rotation.about_z(0.02 * np.arange(count))
    qpos[:, humanoid.hinge[0, 0]] = 0.05 * np.arange(count)
    return qpos


def clip(humanoid, count=11, **fields) -> Clip:
    return Clip(**({"name": "c", "character": "humanoid", "fps": 10.0, "qpos": poses(humanoid, count)} | fields))


def test_at_between_frames(humanoid):
    c = clip(humanoid)
    pose = c.at(np.array([0.0, 0.25, 1.0]))
    np.testing.assert_allclose(pose[:, 0], [0.0, 0.25, 1.0])
    np.testing.assert_allclose(rotation.heading(pose[:, 3:7]), [0.0, 0.05, 0.2])
    np.testing.assert_allclose(pose[:, humanoid.hinge[0, 0]], [0.0, 0.125, 0.5])


def test_a_clip_that_is_no_loop_holds_its_ends(humanoid):
    c = clip(humanoid)
    np.testing.assert_array_equal(c.at(np.array([-3.0, 5.0])), c.qpos[[0, -1]])


def test_a_loop_continues_its_path(humanoid):
    c = clip(humanoid, loop=True)
    pose = c.at(np.array([0.25, 1.25, 7.25, -0.75]))
    np.testing.assert_allclose(pose[:, 0], [0.25, 1.25, 7.25, -0.75], atol=1e-9)  # 1 m a cycle
    np.testing.assert_allclose(pose[:, 2:], np.repeat(pose[:1, 2:], 4, 0), atol=1e-9)


def test_the_walk_goes_through_its_seam_smoothly(walk, humanoid):
    motion = kinematics(humanoid, walk.at(np.arange(0, 3 * walk.seconds, 1 / 60)), 60)
    assert np.linalg.norm(motion.linear, axis=-1).max() < 6.0  # a jump at the seam would be tens of m/s


def test_resample(humanoid):
    fast = clip(humanoid).resample(40.0)
    assert (fast.fps, len(fast.qpos)) == (40.0, 41)
    np.testing.assert_allclose(fast.qpos[:, 0], np.arange(41) / 40, atol=1e-8)
    uneven = clip(humanoid).resample(3.0)
    np.testing.assert_allclose(uneven.qpos[:, 0], [0, 1 / 3, 2 / 3, 1.0], atol=1e-8)


def test_slice(humanoid):
    part = clip(humanoid, loop=True).slice(0.2, 0.5)
    assert not part.loop and part.seconds == pytest.approx(0.3)
    np.testing.assert_allclose(part.qpos[:, 0], [0.2, 0.3, 0.4, 0.5])


def test_mirror_twice_is_the_clip_itself(walk, humanoid):
    mirrored = walk.mirror()
    assert (mirrored.name, mirrored.loop, mirrored.fps, mirrored.source) == (
        "walk-mirrored",
        True,
        walk.fps,
        walk.source,
    )
    assert mirrored.mirror().name == "walk"
    np.testing.assert_allclose(mirrored.mirror().qpos, walk.qpos, atol=1e-12)
    left, right = (int(humanoid.model.joint(f"{side}_knee").qposadr[0]) for side in ("left", "right"))
    np.testing.assert_allclose(mirrored.qpos[:, left], walk.qpos[:, right], atol=1e-12)
    np.testing.assert_allclose(mirrored.qpos[:, :3], walk.qpos[:, :3] * [1, -1, 1], atol=1e-12)
    np.testing.assert_allclose(rotation.heading(mirrored.qpos[:, 3:7]), -rotation.heading(walk.qpos[:, 3:7]), atol=1e-9)


def test_close_loop_ends_where_it_begins(humanoid):
    qpos = poses(humanoid, 21)
    closed = close_loop(humanoid, qpos, 5)
    np.testing.assert_array_equal(closed[:, :2], qpos[:, :2])
    np.testing.assert_array_equal(closed[:15], qpos[:15])
    np.testing.assert_allclose(closed[-1, 2:], qpos[0, 2:], atol=1e-12)
    columns = quaternion_columns(humanoid)[:, None] + np.arange(4)
    np.testing.assert_allclose(np.linalg.norm(closed[:, columns], axis=-1), 1)
    assert (np.diff(closed[:, 0]) > 0).all()


def test_interpolate_takes_the_short_way(humanoid):
    a, b = poses(humanoid, 2)
    b[3:7] *= -1
    np.testing.assert_allclose(rotation.heading(interpolate(humanoid, a[None], b[None], np.array([0.5]))[:, 3:7]), 0.01)


def spoiled(humanoid, index, value):
    qpos = poses(humanoid, 4)
    qpos[index] = value
    return qpos


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"qpos": np.zeros((5, 7))}, r"clip 'c': qpos has shape \(5, 7\); 'humanoid' needs \(T, 43\)"),
        ({"qpos": np.zeros(43)}, r"qpos has shape \(43,\)"),
        ({"count": 1}, "clip 'c': 1 frames; a motion needs at least two"),
        ({"fps": 0.0}, "clip 'c': fps is 0.0; it must be positive"),
        ({"fps": np.nan}, "fps is nan"),
        ({"spoil": ((2, 5), np.inf)}, "clip 'c': frame 2, column 5 is inf"),
        (
            {"spoil": ((3, slice(3, 7)), 0.3)},
            "frame 3, columns 3-6: a quaternion of norm 0.6 is no rotation",
        ),
    ],
)
def test_messages(humanoid, fields, message):
    fields = dict(fields)
    if "spoil" in fields:
        fields["qpos"] = spoiled(humanoid, *fields.pop("spoil"))
    with pytest.raises(ValueError, match=message):
        clip(humanoid, **fields)


@pytest.mark.parametrize(("start", "stop"), [(-0.1, 0.5), (0.5, 0.5), (0.7, 0.2), (0.0, 1.2)])
def test_slices_outside_are_refused(humanoid, start, stop):
    with pytest.raises(ValueError, match=r"is not within \[0, 1.000\] s"):
        clip(humanoid).slice(start, stop)
