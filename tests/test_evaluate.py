"""evaluate.py: numbers by hand on made recordings, and the same numbers from the same seed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made import make_clips, make_prior, make_tokenizer

from kinetok.adapters import LoRAConfig
from kinetok.adapters.adapted import Adapted
from kinetok.adapters.rlft import TokenPolicyConfig
from kinetok.adapters.skill import Skill
from kinetok.checkpoint import CheckpointError
from kinetok.config import ConfigError
from kinetok.evaluate import (
    evaluate_prior,
    evaluate_task,
    evaluate_tracking,
    measure,
    standing_foot_height,
    starting_poses,
    survived,
)
from kinetok.gpt.controller import Prior, Recording, roll
from kinetok.presets import FIT
from kinetok.sim.tasks import SteeringConfig
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
    for key, column in (("success_rate", "success"), ("mpjpe_mm", "mpjpe_mm"), ("mpjpe_local_mm", "mpjpe_local_mm")):
        assert one[key] == pytest.approx(np.mean([clip[column] for clip in one["clips"]]))
    assert len(one["utilisation"]) == len(one["perplexity"]) == 2
    assert min(one["utilisation"]) > 0 and max(one["perplexity"]) <= 125
    json.dumps(one, allow_nan=False)


def test_a_teacher_has_no_tokens_to_count(table):
    config = replace(FIT["tiny"]().teacher_tokenizer, future=(1, 2))
    told = evaluate_tracking(new_tokenizer(config, table, 0), make_clips(table), episodes=1, threads=1)
    assert told["utilisation"] is None and told["perplexity"] is None


@pytest.fixture(scope="module")
def steering(tmp_path_factory, table):
    """The directories of a skill that has learned nothing, and of its prior: it plays as the prior does."""
    home = tmp_path_factory.mktemp("home")
    prior = make_prior(home, table)
    adapted = Adapted(prior.gpt, LoRAConfig(rank=1, alpha=1.0, hidden=4), cond_dim=4)
    task = SteeringConfig(speed=(0.7, 0.9))
    Skill(
        adapted=adapted, prior=prior, base=str(home / "prior"), task=task, policy=TokenPolicyConfig(top_p=0.9)
    ).save_pretrained(home / "skill")
    return home / "skill", home / "prior"


def test_a_task_is_measured_the_same_at_any_thread_count_and_by_its_seed(steering):
    skill, _ = steering
    one, two, other = (
        evaluate_task(skill, episodes=3, seconds=1.0, seed=seed, threads=threads, push=0.5)
        for seed, threads in ((1, 1), (1, 2), (2, 1))
    )
    assert one == two != other
    assert {"return", "survival_rate", "velocity_error_mps", "heading_error_rad"} <= one.keys()
    assert (one["task"], one["seed"], one["episodes"], one["push_mps"]) == ("steering", 1, 3, 0.5)
    assert "success_rate" not in one  # steering defines none
    assert 1.0 < one["head_height_m"] < 1.6
    json.dumps(one, allow_nan=False)


def test_the_prior_alone_does_what_a_skill_does_that_has_learned_nothing(steering):
    skill, prior = steering
    options = {"episodes": 2, "seconds": 0.5, "seed": 3, "threads": 1}
    bent = evaluate_task(skill, prior, "steering", **options)
    alone = evaluate_task(None, prior, "steering", **options)
    assert bent["survival_rate"] == alone["survival_rate"]
    assert bent["velocity_error_mps"] != alone["velocity_error_mps"]  # the skill's own speeds, the task's usual ones
    target = evaluate_task(None, prior, **options)
    assert target["task"] == "target" and target["success_rate"] is None and target["final_distance_m"] is None
    assert "token_entropy" in bent and "token_entropy" not in alone


def test_how_tokens_are_drawn_may_be_changed(steering):
    skill, prior = steering
    options = {"episodes": 2, "seconds": 0.5, "seed": 3, "threads": 1}
    usual, own = evaluate_task(skill, **options), evaluate_task(skill, top_p=0.9, temperature=1.0, **options)
    assert own == usual | {"top_p": 0.9, "temperature": 1.0}
    calm = evaluate_task(skill, temperature=0.5, **options)
    assert calm["return"] != usual["return"] and 0 < calm["token_entropy"] < usual["token_entropy"]
    assert evaluate_task(None, prior, top_p=0.3, **options)["return"] != evaluate_task(None, prior, **options)["return"]


def test_what_cannot_be_evaluated(steering, tmp_path):
    skill, prior = steering
    with pytest.raises(ConfigError, match="was bent to 'steering' and cannot read what 'path' asks"):
        evaluate_task(skill, task="path")
    with pytest.raises(ConfigError, match="unknown task 'walk'; one of: target, steering, path"):
        evaluate_task(None, prior, "walk")
    with pytest.raises(CheckpointError, match=r"prior has no adapter_config\.json"):
        evaluate_task(prior)
    with pytest.raises(ValueError, match="0 episodes of 1 s hold no control step"):
        evaluate_task(skill, episodes=0, seconds=1.0)
    with pytest.raises(CheckpointError, match="there is no directory"):
        Prior.from_pretrained(tmp_path / "no")
