import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from kinetok.motion.library import ClipLibrary
from kinetok.sim.tasks.tracking import ReferenceTable, Tracking
from kinetok.tokenizers.track import TrackingScore, track


class Follow:
    """Plays the PD target that each observation ends with, bent by `offset` radians."""

    def __init__(self, actions: int, offset: float = 0.0):
        self.actions, self.offset = actions, offset

    def act(self, obs: torch.Tensor):
        return obs[:, -self.actions :] + self.offset, torch.zeros(()), {}


@pytest.fixture(scope="module")
def good(standing):
    return track(Follow(standing.character.nu), standing, future=(1,), episodes=3)


def test_a_follower_of_a_standing_clip_succeeds(good):
    assert good.names == ("wave", "sweep") and good.episodes == 3
    assert (good.success == 1).all() and (good.success_mean_error == 1).all()
    assert (good.mpjpe_mm < 100).all() and (good.mpjpe_local_mm > 0).all()
    assert good.seconds.tolist() == [1.0, 1.0]  # every episode of a clip that ends runs from its first frame


def test_episodes_of_one_clip_differ(standing, good):
    once = track(Follow(standing.character.nu), standing, future=(1,), episodes=1)
    assert (once.mpjpe_mm != good.mpjpe_mm).all()


def phases(seed: int, episodes: int, cycle: int = 30) -> list[int]:
    """Frames at which the episodes of a loop begin."""
    begin = np.random.default_rng([seed, 5]).random()
    return [int((k + begin) / episodes * cycle) for k in range(episodes)]


def test_a_loop_is_entered_at_phases_spread_over_it(wave):
    """Jumping by 2 m at frame 10 of 30, a loop loses every episode there; only the phases tell how late."""
    clip = wave("jump", 1.0, loop=True)
    clip.qpos[10:, 0] += 2.0
    table = ReferenceTable(ClipLibrary.of([clip]), seconds=2)
    for seed in (0, 2):
        score = track(Follow(28), table, future=(1,), episodes=2, seconds=1.5, seed=seed)
        # every episode ends at frame 10, of its cycle or of the next
        steps = [(10 - start) % 30 for start in phases(seed, 2)]
        assert score.seconds.tolist() == [sum(steps) / 2 / 30] and score.success.tolist() == [0.0]
    assert phases(0, 2) != phases(2, 2)
    begun = track(Follow(28), table, future=(1,), episodes=2, seconds=1.5, from_start=True)
    assert begun.seconds.tolist() == [10 / 30]


def test_a_broken_body_scores_less(standing, good):
    bad = track(Follow(standing.character.nu, offset=2.0), standing, future=(1,), episodes=3)
    assert (bad.mpjpe_mm > good.mpjpe_mm).all() and bad.merit < good.merit


def test_a_simulation_that_blows_up_fails_with_a_finite_score(standing):
    score = track(Follow(standing.character.nu, offset=float("nan")), standing, future=(1,), episodes=2)
    assert (score.success == 0).all() and (score.success_mean_error == 0).all()
    assert np.isfinite(score.mpjpe_mm).all() and np.isfinite(score.merit)


def test_a_loop_runs_for_the_seconds_asked_for(wave):
    table = ReferenceTable(ClipLibrary.of([wave("loop", loop=True)]), seconds=3)
    score = track(Follow(table.character.nu), table, future=(1,), episodes=2, seconds=1.2)
    assert score.seconds.tolist() == [1.2] and score.success.tolist() == [1.0]


def test_scores_do_not_depend_on_threads(standing, good):
    again = track(Follow(standing.character.nu), standing, future=(1,), episodes=3, threads=2)
    assert again.to_json() == good.to_json()


def test_pushes_are_felt_and_seeded(standing, good):
    once, twice, other = (
        track(Follow(standing.character.nu), standing, future=(1,), push=1.0, push_seconds=0.2, episodes=3, seed=seed)
        for seed in (0, 0, 1)
    )
    assert (once.mpjpe_mm > good.mpjpe_mm).all()
    assert once.to_json() == twice.to_json() != other.to_json()


def test_who_loses_its_place_has_failed_but_not_fallen(wave):
    """The reference jumps away by 2 m: the body stands on, unless it goes limp."""
    clip = wave("jump", 1.0)
    clip.qpos[10:, 0] += 2.0
    table = ReferenceTable(ClipLibrary.of([clip]))
    stands, limp = (track(Follow(28, offset), table, future=(1,), push=0.01, episodes=2) for offset in (0.0, 1.5))
    assert stands.success_mean_error[0] == limp.success_mean_error[0] == 0 and stands.seconds[0] == pytest.approx(1 / 3)
    assert stands.survival[0] == 1 and limp.survival[0] == 0


def test_who_is_lost_and_has_not_fallen_has_merit(good):
    lost = replace(good, success=0 * good.success, success_mean_error=0 * good.success)
    assert lost.merit == pytest.approx(good.merit) and replace(lost, survival=0 * good.success).merit < lost.merit - 0.9


def test_a_clip_survives_relative_to_how_long_it_could_last(good):
    """Halving what the short of two clips survives costs as much as halving the long one's: 0.2 * 0.5 / 2."""
    both = replace(good, seconds=np.array([1.0, 20.0]), limit=np.array([1.0, 20.0]))
    short, long = (replace(both, seconds=np.array(seconds)) for seconds in ([0.5, 20.0], [1.0, 10.0]))
    assert both.merit - short.merit == pytest.approx(0.05) and both.merit - long.merit == pytest.approx(0.05)


def test_the_limit_is_the_clips_end_or_the_seconds_of_a_loop(wave, good):
    assert good.limit.tolist() == [1.0, 1.0]
    table = ReferenceTable(ClipLibrary.of([wave("loop", loop=True), wave("once", 0.5)]), seconds=2)
    limits = [track(Follow(28), table, future=(1,), episodes=2, seconds=s).limit.tolist() for s in (1.2, 9.0)]
    left = np.mean([(90 - start) / 30 for start in phases(0, 2)])  # the loop's table ends after 3 s
    assert limits == [[1.2, 0.5], [pytest.approx(left), 0.5]]


def test_what_is_seen_is_what_goes_on(wave):
    table = ReferenceTable(ClipLibrary.of([wave("long"), wave("short", 0.5)]))
    seen: list[int] = []
    track(Follow(28), table, future=(1,), episodes=2, seen=lambda obs: seen.append(len(obs)))
    assert seen == [4] * 15 + [2] * 15  # nothing of an episode that is over
    seen.clear()
    track(Follow(28, offset=float("nan")), table, future=(1,), episodes=2, seen=lambda obs: seen.append(len(obs)))
    assert seen == [4]  # nor of one that has failed


def test_a_score_from_before_limits_keeps_its_merit(good):
    old = good.to_json() | {"seconds": [0.5, 2.0]}
    del old["limit"], old["survival"], old["mpjpe_local_mm"]
    again = TrackingScore.from_json(old)
    assert again.survival.tolist() == good.success_mean_error.tolist() and np.isnan(again.mpjpe_local_mm).all()
    expected = good.success.mean() + 0.2 * (0.25 + 1) / 2 - good.mpjpe_mm.mean() / 1000
    assert again.limit.tolist() == [2.0, 2.0] and again.merit == pytest.approx(expected)


def test_json_round_trip_is_exact(good):
    again = TrackingScore.from_json(json.loads(json.dumps(good.to_json())))
    assert again.names == good.names and again.episodes == good.episodes
    for name in ("success", "success_mean_error", "survival", "mpjpe_mm", "mpjpe_local_mm", "seconds", "limit"):
        assert np.array_equal(getattr(again, name), getattr(good, name))
    assert again.merit == good.merit


def test_error_from_the_root_is_that_without_its_drift(standing, monkeypatch):
    """Everything 0.3 m further along x than it was: the one error grows, the other stays."""
    score = {}
    for away in (0.0, 0.3):
        real = Tracking.over

        def over(self, body, away=away, real=real):
            found = real(self, body)
            self.offset = self.offset + np.array([away, 0, 0], np.float32)
            return found

        monkeypatch.setattr(Tracking, "over", over)
        score[away] = track(Follow(standing.character.nu), standing, future=(1,), episodes=1)
        monkeypatch.undo()
    assert (score[0.3].mpjpe_mm - score[0.0].mpjpe_mm > 200).all()
    np.testing.assert_allclose(score[0.3].mpjpe_local_mm, score[0.0].mpjpe_local_mm, rtol=1e-4)
