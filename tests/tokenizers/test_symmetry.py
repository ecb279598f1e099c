"""symmetry.py: the mirror image of an observation is the observation of the mirror image; of a target too."""

import numpy as np
import pytest
import torch

from kinetok.config import ConfigError
from kinetok.motion.library import ClipLibrary
from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking, TrackingConfig
from kinetok.tokenizers.symmetry import Mirror

FUTURE = (1, 2, 7)


def test_mirrored_worlds_stay_mirror_images(humanoid, walk):
    """Physics and all: mirrored targets in a mirrored world give mirrored observations, until contacts, solved in
    another order, part them."""
    table, mirror = ReferenceTable(ClipLibrary.of([walk, walk.mirror()])), Mirror.of("humanoid", FUTURE)
    task = Tracking(TrackingConfig(future=FUTURE), table, rows=2, fixed=np.array([0, 1]), starts=np.array([5, 5]))
    env = Env(EnvConfig(autoreset=False), task, rows=2, threads=1)
    obs, rng = torch.from_numpy(env.reset()), torch.Generator().manual_seed(0)
    for _ in range(4):
        torch.testing.assert_close(mirror.observation(obs[:1]), obs[1:], atol=5e-2, rtol=5e-2)
        action = obs[:1, mirror.targets] + 0.05 * torch.randn(1, humanoid.nu, generator=rng)
        both = torch.cat([action, mirror.action(action)])
        obs = torch.from_numpy(env.step(both.numpy()).obs)
    assert (obs[0] - obs[1]).abs().max() > 0.1  # and the two are not alike


def test_a_character_whose_frames_are_no_images_is_refused():
    with pytest.raises(ConfigError, match=r"'g1': observation .* has no mirror image"):
        Mirror.of("g1", FUTURE)
