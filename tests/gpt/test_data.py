"""data.py: what is recorded and what is left out."""

import numpy as np
import pytest
import torch
from made import make_tokenizer

from kinetok import rotation
from kinetok.gpt.data import (
    Starts,
    TokenDataset,
    before_failure,
    clip_weights,
    jitter,
    record,
)
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks.tracking import ReferenceTable


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory, table):
    return make_tokenizer(tmp_path_factory.mktemp("tokenizer"), table)


def standing(humanoid, name: str, frames: int, x: float, yaw: float) -> Clip:
    qpos = np.tile(humanoid.model.qpos0, (frames, 1))
    qpos[:, 0], qpos[:, 2] = x, 0.89
    qpos[:, 3:7] = rotation.about_z(np.full(frames, yaw))
    return Clip(name=name, character="humanoid", fps=30.0, qpos=qpos)


@pytest.fixture(scope="module")
def two_stands(humanoid) -> ReferenceTable:
    clips = [standing(humanoid, "here", 11, 0.0, 0.0), standing(humanoid, "there", 11, 5.0, 1.5)]
    return ReferenceTable(ClipLibrary.of(clips), control_hz=30)


def test_records_states_with_the_tokens_chosen_in_them(tokenizer, table):
    data = record(tokenizer, table, samples=600, rows=8, env=EnvConfig(reset_noise=0.01), threads=1, quiet=True)
    assert 100 < len(data) <= 600
    assert data.states.shape == (len(data), tokenizer.sizes["state"]) and data.states.dtype == torch.float32
    assert data.tokens.shape == (len(data), 2) and data.tokens.dtype == torch.int32
    assert data.tokens.min() >= 0 and data.tokens.max() < 125
    assert torch.isfinite(data.states).all()
    assert set(data.clip.tolist()) <= {0, 1} and set(data.world.tolist()) <= set(range(8))
    assert data.starts.qpos.shape == (512, 43) and data.names == ("cycle", "once")
    mean, std = data.statistics()
    torch.testing.assert_close(mean, data.states.mean(0), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(std, data.states.std(0), rtol=1e-2, atol=1e-3)


def test_the_same_seed_records_the_same_at_any_thread_count(tokenizer, table):
    env = EnvConfig(reset_noise=0.02, push=0.5, push_seconds=0.2)
    one, two = (
        record(tokenizer, table, samples=400, rows=8, env=env, seed=3, transitions=2.0, threads=threads, quiet=True)
        for threads in (1, 2)
    )
    assert torch.equal(one.states, two.states) and torch.equal(one.tokens, two.tokens)
    other = record(tokenizer, table, samples=400, rows=8, env=env, seed=4, transitions=2.0, threads=1, quiet=True)
    assert not torch.equal(one.states[:8], other.states[:8])


def test_half_of_the_rows_may_wander(tokenizer, table):
    settings = {"samples": 480, "rows": 8, "seed": 3, "quiet": True}
    plain = record(tokenizer, table, threads=1, **settings)
    one, two = (record(tokenizer, table, wander=0.5, threads=threads, **settings) for threads in (1, 2))
    assert torch.equal(one.states, two.states) and torch.equal(one.tokens, two.tokens)
    half = record(tokenizer, table, threads=1, **settings | {"samples": 240})
    assert 0 < len(half) < len(one) <= 480
    assert torch.equal(one.states[: len(half)], half.states) and torch.equal(half.states[:8], plain.states[:8])


def test_a_data_set_returns_from_its_file(tokenizer, table, tmp_path):
    data = record(tokenizer, table, samples=200, rows=8, threads=1, quiet=True)
    data.save(tmp_path / "tokens.safetensors", {"seed": 0})
    again, meta = TokenDataset.load(tmp_path / "tokens.safetensors")
    assert meta == {"seed": 0} and again.names == data.names
    for name in ("states", "tokens", "clip", "world"):
        assert torch.equal(getattr(data, name), getattr(again, name))
    np.testing.assert_array_equal(data.starts.qvel, again.starts.qvel)


def test_a_tokenizer_that_follows_nothing_is_refused(tmp_path, two_stands):
    tokenizer = make_tokenizer(tmp_path, two_stands)
    with torch.no_grad():
        tokenizer.action_mean.fill_(2.0)  # curls up at once
        tokenizer.action_scale.zero_()
    env = EnvConfig(reset_noise=1.0)
    with pytest.raises(ValueError, match="follows none of here, there"):
        record(tokenizer, two_stands, samples=64, rows=4, env=env, threads=1, quiet=True)


def test_worlds_are_held_out_whole():
    world = torch.arange(10).repeat(3)
    zeros = torch.zeros(30, 1)
    starts = Starts(qpos=np.zeros((1, 7)), qvel=np.zeros((1, 6)), clip=np.zeros(1, int))
    data = TokenDataset(states=zeros, tokens=zeros.int(), clip=world, world=world, names=("a",), starts=starts)
    learn, hold = data.split(0.2)
    assert set(world[learn].tolist()) == set(range(8)) and set(world[hold].tolist()) == {8, 9}
    assert [len(part) for part in data.split(0.0)] == [30, 0]
    assert len(data.split(0.01)[1]) == 3  # at least one world
    with pytest.raises(ValueError, match="cannot hold out 10 of 10 worlds; record with more rows"):
        data.split(0.99)
    with pytest.raises(ValueError, match=r"must lie in \[0, 1\), not 1"):
        data.split(1)


def test_the_steps_before_a_failure_are_marked():
    # world 0 fails at step 4; world 1 times out at step 2 and fails at step 3; world 2 times out only
    terminated = np.zeros((6, 3), bool)
    terminated[4, 0] = terminated[3, 1] = True
    done = terminated.copy()
    done[2, 1] = done[2, 2] = True
    marked = before_failure(terminated, done, 3)
    assert np.flatnonzero(marked[:, 0]).tolist() == [2, 3, 4]
    assert np.flatnonzero(marked[:, 1]).tolist() == [3]  # not across the time-out
    assert not marked[:, 2].any()


def test_half_of_the_clips_weight_is_uniform_and_half_duration(table):
    # 30 and 15 steps: 1/4 + 1/2 * 2/3, 1/4 + 1/2 * 1/3
    np.testing.assert_allclose(clip_weights(table), [0.25 + 1 / 3, 0.25 + 1 / 6])


def test_jitter_moves_a_share_of_the_codes_by_one_level_within_range():
    codes = torch.randint(0, 5, (2000, 6), generator=torch.Generator().manual_seed(0))
    moved = jitter(codes, 0.3, 5, np.random.default_rng(0))
    assert (moved - codes).abs().max() == 1 and moved.min() == 0 and moved.max() == 4
    inner = (codes > 0) & (codes < 4)
    assert (moved != codes)[inner].float().mean().item() == pytest.approx(0.3, abs=0.02)
