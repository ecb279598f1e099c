"""guide.py: rows that are moved are seen where they would be, and what is recorded repeats."""

import numpy as np
import torch

from kinetok import rotation
from kinetok.adapters.guide import Place, demonstrate, forwards
from kinetok.adapters.rlft import task_of
from kinetok.sim.env import EnvConfig
from kinetok.sim.tasks import TargetConfig


def test_a_body_that_was_moved_is_seen_where_it_was(table):
    ids = np.arange(4)
    here = table.body.rows(np.array([0, 3, 5, 7]))
    place = Place(4)
    place.keep(ids, np.array([[1.0, 2.0]] * 4), np.full(4, 0.7), here)
    there = place.seen(here)
    np.testing.assert_allclose(there.pos[:, 0, :2], [[1.0, 2.0]] * 4, atol=1e-6)
    np.testing.assert_allclose(rotation.heading(there.quat), 0.7, atol=1e-6)
    turn = rotation.to_matrix(rotation.about_z(place.angle))
    np.testing.assert_allclose(there.mat, turn[:, None] @ here.mat, atol=1e-6)
    np.testing.assert_allclose(there.linear, (turn[:, None] @ here.linear[..., None])[..., 0], atol=1e-6)
    np.testing.assert_allclose(there.pos[..., 2], here.pos[..., 2])
    # Moved again: what is seen does not change.
    moved = table.body.rows(np.array([2, 4, 6, 8]))
    place.keep(ids, there.pos[:, 0, :2], rotation.heading(there.quat), moved)
    np.testing.assert_allclose(place.seen(moved).pos[:, 0, :2], there.pos[:, 0, :2], atol=1e-6)


def test_a_demonstration_repeats_and_holds_what_was_asked(prior, table):
    def run(seed, threads=1):
        goal = task_of(TargetConfig(fall_height=0.1), prior, 8)
        told = {"samples": 480, "rows": 8, "env": EnvConfig(push=0.1), "quiet": True}
        return demonstrate(prior.tokenizer, table, goal, seed=seed, threads=threads, **told)

    states, c, tokens = run(1)
    assert 0 < len(states) == len(c) == len(tokens) < 480
    assert states.shape[1] == prior.gpt.config.state_dim and c.shape[1] == 4 and tokens.shape[1] == 2
    assert 0.1 < float(c.norm(dim=1).max()) < 12
    assert all(torch.equal(a, b) for a, b in zip((states, c, tokens), run(1, threads=2), strict=True))
    assert not torch.equal(states[:8], run(2)[0][:8])


def test_what_lies_behind_is_turned_to():
    wish = np.array([[1, 0], [1, 1], [0, -2], [-3, 1e-3], [0, 0]])
    # straight on and 45 degrees stay; to the right and behind left become 60 degrees, as long as they were
    expected = [[1, 0], [1, 1], [1, -(3**0.5)], [1.5, 1.5 * 3**0.5], [0, 0]]
    np.testing.assert_allclose(forwards(wish), expected, atol=1e-6)
