"""duplicates.py: copies, excerpts and mirror images are found; motions that only resemble each other are not."""

from dataclasses import replace

import numpy as np
import pytest

from kinetok import rotation
from kinetok.motion.duplicates import duplicates
from kinetok.motion.formats import read_clips


def test_duplicates_in_the_data(data_dir):
    folder = data_dir / "train" / "deepmimic"
    clips = [
        clip for name in ("stealthy_walk", "walk", "jog") for clip in read_clips(folder / f"humanoid3d_{name}.txt")
    ]
    clips += read_clips(data_dir / "train" / "deepmimic_long" / "humanoid3d_stealthy_walk1.txt")
    (pair,) = duplicates(clips)
    assert (pair.part, pair.whole, pair.mirrored) == (0, 3, False)
    assert pair.start == pytest.approx(28.0, abs=0.02) and pair.error < 1e-3


def test_duplicates_moved_mirrored_and_cut(walk, getup):
    qpos = walk.qpos.copy()
    spin = np.tile(rotation.about_z(np.array(1.0)), (len(qpos), 1))
    qpos[:, 3:7] = rotation.multiply(spin, qpos[:, 3:7])
    qpos[:, :3] = rotation.rotate(spin, qpos[:, :3]) + np.array([3.0, 1.0, 0.0])
    moved = replace(walk, qpos=qpos, name="other")
    assert [(p.part, p.whole, p.mirrored) for p in duplicates([walk, moved, getup])] == [(0, 1, False)]
    assert [(p.part, p.whole, p.mirrored) for p in duplicates([getup, getup.mirror()])] == [(0, 1, True)]
    cut = getup.resample(47.0).slice(0.3, 0.9)
    (pair,) = duplicates([getup, walk, cut])
    assert (pair.part, pair.whole) == (2, 0) and pair.start == pytest.approx(0.3, abs=0.02)


def test_still_clips_are_not_compared(walk):
    still = replace(walk, qpos=np.repeat(walk.qpos[:1], 40, axis=0))
    assert duplicates([still, replace(still, name="again")]) == []
