"""evaluate.py: numbers by hand on made recordings, and the same numbers from the same seed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made import make_clips, make_prior, make_tokenizer

from kinetok.evaluate import (
    evaluate_prior,
    evaluate_tracking,
    measure,
    standing_foot_height,
    starting_poses,
    survived,
)
from kinetok.gpt.controller import Recording, roll
from kinetok.presets import FIT
from kinetok.tokenizers.fit import new_tokenizer


@pytest.fixture(scope="module")
def prior(tmp_path_factory, table):
    return make_prior(tmp_path_factory.mktemp("models"), table)


def made(pos: np.ndarray, blown_up=None) -> Recording:
    """A recording of body positions pos (T, N, 15, 3) and of the tokens 0, 1, 0, 1 ..."""
    steps, rows = pos.shape[:2]
    return Recording(
        character="humanoid",
        qpos=np.zeros((steps, rows, 43)),
        pos=pos,
        tokens=np.tile(np.arange(steps)[:, None, None] % 2, (1, rows, 1)).astype(np.int32),
        blown_up=np.zeros(rows, bool) if blown_up is None else np.array(blown_up),
        start=np.zeros(rows, int),
        vocabulary=4,
        fps=30,
    )


def test_survival_asks_for_the_end_and_falls_for_the_whole_way():
    pos = np.full((30, 4, 15, 3), 0.9)
    pos[10:20, 1, :, 2] = 0.2  # falls and gets up
    pos[20:, 2, :, 2] = 0.2  # falls for good
    recording = made(pos, blown_up=[False, False, False, True])
    assert survived(recording).tolist() == [True, True, False, False]
    told = measure(recording)
    assert told["survival_rate"] == 0.5 and told["never_fell_rate"] == 0.25 and told["blown_up"] == 1
    assert told["seconds"] == 1.0 and told["episodes"] == 4


def test_smoothness_and_skating_by_hand():
    t = np.arange(60) / 30
    pos = np.zeros((60, 1, 15, 3))
    pos[..., 0] = (0.5 * 3.0 * t**2)[:, None, None]  # 3 m/s^2 along x
    pos[..., 2] = 0.9
    told = measure(made(pos))
    assert told["accel_mps2"] == pytest.approx(3.0) and told["path_m"] == pytest.approx(1.5 * t[-1] ** 2)
    assert told["foot_skate_mps"] is None  # no foot is down
    pos[..., 2] = 0.05
    assert measure(made(pos))["foot_skate_mps"] == pytest.approx(1.5 * t[-1])  # mean speed
    assert told["utilisation"] == [0.5] and told["perplexity"] == [pytest.approx(2.0)]


def test_a_foot_of_the_humanoid_stands_five_centimetres_high(humanoid):
    # the sole lies 0.0225 + 0.0275 m below the foot's origin
    assert standing_foot_height(humanoid) == pytest.approx(0.05, abs=1e-6)


def test_starting_poses_take_every_clip_before_any_twice(prior):
    poses = starting_poses(prior, 2, seed=0)
    assert sorted(prior.starts.clip[poses]) == [0, 1]
    every = starting_poses(prior, 8, seed=0)
    assert sorted(every) == list(range(8)) and (every[:2] == poses).all()
    assert not np.array_equal(starting_poses(prior, 8, seed=1), every)


def test_a_prior_is_measured_the_same_at_any_thread_count(prior):
    one, two = (evaluate_prior(prior, episodes=7, seconds=1.0, seed=2, threads=threads) for threads in (1, 2))
    assert one == two
    assert one["episodes"] == 7 and one["starting_poses"] == 3 and one["seconds"] == 1.0 and one["seed"] == 2
    assert one["apd_m"] > 0 and one["apd_pose_m"] > one["apd_m"]
    assert sum(clip["episodes"] for clip in one["start_clips"]) == 7
    rate = sum(clip["episodes"] * clip["survival_rate"] for clip in one["start_clips"]) / 7
    assert rate == pytest.approx(one["survival_rate"])
    json.dumps(one, allow_nan=False)
    assert evaluate_prior(prior, episodes=7, seconds=1.0, seed=3, threads=1) != one


def test_one_episode_has_no_diversity(prior):
    told = evaluate_prior(prior, episodes=1, seconds=1.0, threads=1)
    assert told["apd_m"] is None and told["episodes"] == 1


def test_measure_is_what_evaluation_says_of_its_own_rollouts(prior):
    told = evaluate_prior(prior, episodes=2, seconds=1.0, seed=4, threads=1)
    starts = np.repeat(starting_poses(prior, 1, 4), 2)
    again = measure(roll(prior, rows=2, seconds=1.0, starts=starts, seed=4, threads=1))
    assert {key: told[key] for key in again} == again


def test_tracking_is_measured_the_same_at_any_thread_count(tmp_path, table):
    tokenizer = make_tokenizer(tmp_path, table)
    one, two = (
        evaluate_tracking(tokenizer, make_clips(table), episodes=2, seed=1, threads=threads) for threads in (1, 2)
    )
    assert one == two
    assert {"success_rate", "success_rate_mean_error", "mpjpe_mm", "clips", "seed", "episodes"} <= one.keys()
    assert [clip["name"] for clip in one["clips"]] == ["cycle", "once"]
    for key, column in (("success_rate", "success"), ("mpjpe_mm", "mpjpe_mm")):
        assert one[key] == pytest.approx(np.mean([clip[column] for clip in one["clips"]]))
    assert len(one["utilisation"]) == len(one["perplexity"]) == 2
    assert min(one["utilisation"]) > 0 and max(one["perplexity"]) <= 125
    json.dumps(one, allow_nan=False)


def test_a_teacher_has_no_tokens_to_count(table):
    config = replace(FIT["tiny"]().teacher_tokenizer, future=(1, 2))
    told = evaluate_tracking(new_tokenizer(config, table, 0), make_clips(table), episodes=1, threads=1)
    assert told["utilisation"] is None and told["perplexity"] is None
