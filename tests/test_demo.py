"""What is packaged belongs together and works: the demo's parts, without its videos."""

import numpy as np
import pytest

from kinetok.adapters.rlft import play
from kinetok.adapters.skill import Skill
from kinetok.checkpoint import ADAPTER, packaged
from kinetok.demo import CLIPS, PRIOR, SKILL
from kinetok.gpt.controller import Prior, roll
from kinetok.motion.library import ClipLibrary
from kinetok.tokenizers.codec import decode_tokens, encode_clip


@pytest.fixture(scope="module")
def prior() -> Prior:
    return Prior.from_pretrained(PRIOR)


def test_a_packaged_clip_is_tracked_and_played_back_from_its_tokens(prior):
    clip = ClipLibrary.open(CLIPS).clip(0)
    stream = encode_clip(prior.tokenizer, clip, seconds=1.0)
    assert np.abs(stream.simulated[-1] - clip.at(np.array([1.0]))[0])[:3].max() < 0.2
    np.testing.assert_array_equal(decode_tokens(prior.tokenizer, stream), stream.simulated)


def test_the_packaged_prior_stays_up_and_gets_somewhere(prior):
    recording = roll(prior, rows=16, seconds=4, seed=0)
    up = recording.pos[-1, :, 0, 2] > 0.5
    way = np.linalg.norm(recording.pos[-1, :, 0, :2] - recording.pos[0, :, 0, :2], axis=1)
    assert up.mean() > 0.7 and np.median(way) > 1.0


@pytest.mark.parametrize("name", packaged(ADAPTER))
def test_a_packaged_skill_bends_the_packaged_prior(prior, name):
    skill = Skill.from_pretrained(name)
    assert skill.base == PRIOR and skill.prior.tokenizer.hash == prior.tokenizer.hash
    played = play(skill.controller(0), skill.task, skill.prior, episodes=8, seconds=1.0, threads=1)
    assert played.score.measures["survival_rate"] > 0.7


def test_the_demo_has_its_skill():
    assert SKILL in packaged(ADAPTER)
