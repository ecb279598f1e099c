"""gym.py: Gymnasium's contract for vector environments that reset within the step."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install 'kinetok[gym]'")
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from kinetok.sim.env import Env, EnvConfig
from kinetok.sim.gym import TrackingVectorEnv
from kinetok.sim.tasks.tracking import Failure, Tracking, TrackingConfig

ROWS = 4
ROOT = Path(__file__).parents[2]


@pytest.fixture
def worlds(table):
    failure = Failure(largest=1e9, mean=1e9)
    fixed, starts = np.array([0, 1, 0, 1]), np.array([0, 13, 5, 10])
    task = Tracking(TrackingConfig(future=(1,), failure=failure), table, rows=ROWS, fixed=fixed, starts=starts)
    return TrackingVectorEnv(Env(EnvConfig(), task, rows=ROWS, threads=1))


def test_spaces_and_metadata(worlds):
    assert isinstance(worlds, VectorEnv) and worlds.num_envs == ROWS
    assert worlds.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert worlds.observation_space.shape == (ROWS, *worlds.single_observation_space.shape)
    assert worlds.action_space.shape == (ROWS, *worlds.single_action_space.shape) == (ROWS, 28)
    obs, infos = worlds.reset(seed=0)
    assert worlds.observation_space.contains(obs) and infos == {}
    worlds.close()
    assert worlds.closed


def test_step_types_and_final_values(worlds):
    worlds.reset(seed=0)
    worlds.action_space.seed(0)
    for number in range(3):
        obs, reward, terminated, truncated, infos = worlds.step(0.1 * worlds.action_space.sample())
        assert worlds.observation_space.contains(obs)
        assert reward.shape == (ROWS,) and np.issubdtype(reward.dtype, np.floating)
        assert terminated.dtype == truncated.dtype == bool and terminated.shape == truncated.shape == (ROWS,)
        done = number == 1  # row 1 begins two frames before its clip's end
        assert truncated.tolist() == [False, done, False, False] and not terminated.any()
        assert infos["_position"].tolist() == [True, not done, True, True]
        np.testing.assert_allclose(
            sum(v for k, v in infos.items() if not k.startswith(("_", "final")))[[0, 2, 3]],
            reward[[0, 2, 3]],
            rtol=1e-6,
        )
        assert ("final_obs" in infos) == ("final_info" in infos) == done
        if done:
            assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == [False, True, False, False]
            assert [o is None for o in infos["final_obs"]] == [True, False, True, True]
            assert worlds.single_observation_space.contains(infos["final_obs"][1])
            assert np.abs(infos["final_obs"][1] - obs[1]).max() > 0.01
            final = infos["final_info"]
            assert sum(final[k][1] for k in final if k[0] != "_") == pytest.approx(reward[1])


def test_seeds(table):
    task = Tracking(TrackingConfig(future=(1,)), table, rows=ROWS)
    worlds = TrackingVectorEnv(Env(EnvConfig(), task, rows=ROWS, threads=1))
    first, again, other = (worlds.reset(seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_gymnasiums_own_wrapper_counts_episodes(worlds):
    wrapped = RecordEpisodeStatistics(worlds)
    wrapped.reset(seed=0)
    lengths = []
    for _ in range(6):
        *_, infos = wrapped.step(np.zeros(wrapped.action_space.shape, dtype=np.float32))
        if "episode" in infos:
            lengths += infos["episode"]["l"][infos["_episode"]].tolist()
    assert lengths == [2, 2, 5, 2]  # row 1 every two steps, row 3 after five


def test_messages(worlds):
    worlds.reset()
    with pytest.raises(ValueError, match=r"actions have shape \(28,\); these worlds take \(4, 28\)"):
        worlds.step(np.zeros(28))
    with pytest.raises(ValueError, match=r"reset takes no options, got \['reset_mask'\]"):
        worlds.reset(options={"reset_mask": np.ones(ROWS, dtype=bool)})


def test_without_gymnasium_the_message_names_the_extra():
    code = "import sys; sys.modules['gymnasium'] = None; import kinetok.sim.gym"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert "ImportError: kinetok.sim.gym needs Gymnasium: pip install 'kinetok[gym]'" in result.stderr
