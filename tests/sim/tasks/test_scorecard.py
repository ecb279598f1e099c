"""scorecard.py: hand-made sequences and the means they must give."""

import json

import numpy as np
import pytest

from kinetok.sim.tasks.scorecard import Scorecard

NO = np.zeros(2, dtype=bool)
NONE = np.array([], dtype=int)
NAN = float("nan")


def test_means_by_hand():
    card = Scorecard(rows=2, control_hz=30)
    one_fell = np.array([False, True])
    card.add(np.array([1.0, 0.5]), NO, NONE, {"d": np.array([1.0, 2.0]), "success_rate": np.array([NAN, NAN])})
    card.add(np.array([1.0, 0.5]), one_fell, NONE, {"d": np.array([3.0, 4.0]), "success_rate": np.array([1.0, NAN])})
    card.add(np.array([1.0, 0.2]), NO, NONE, {"d": np.array([5.0, 6.0]), "success_rate": np.array([0.0, 1.0])})
    found = card.summary()
    assert found["d"] == pytest.approx(3.5) and found["success_rate"] == pytest.approx(2 / 3)
    assert found["counts"] == {"d": 6, "success_rate": 3}
    assert found["reward"] == pytest.approx((3 + 0.7) / 6)  # nothing for row 1 while it is down
    # row 0: 3; row 1: .5 + .5 up to its fall
    assert found["return"] == pytest.approx((3 + 1.0) / 2)
    assert found["survival_rate"] == 1.0 and found["never_fell_rate"] == 0.5  # it got up
    assert found["episodes"] == 2 and found["seconds"] == pytest.approx(0.1)


def test_down_at_the_end_is_no_survival():
    card = Scorecard(rows=2, control_hz=30)
    card.add(np.ones(2), NO, NONE, {})
    card.add(np.ones(2), np.array([True, False]), NONE, {})
    assert card.summary()["survival_rate"] == card.summary()["never_fell_rate"] == 0.5


def test_who_blew_up_is_down_for_good():
    card = Scorecard(rows=2, control_hz=30)
    card.add(np.ones(2), np.array([True, False]), np.array([0]), {})
    card.add(np.ones(2), NO, NONE, {})  # MuJoCo has put it on its feet
    assert card.summary()["survival_rate"] == card.summary()["never_fell_rate"] == 0.5
    assert card.summary()["reward"] == 0.5


def test_what_never_was_defined_is_none():
    card = Scorecard(rows=2, control_hz=30)
    card.add(np.ones(2), NO, NONE, {"success_rate": np.array([NAN, NAN])})
    found = card.summary()
    assert found["success_rate"] is None
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_messages():
    card = Scorecard(rows=2, control_hz=30)
    with pytest.raises(ValueError, match="nothing to sum up"):
        card.summary()
    with pytest.raises(ValueError, match=r"d has shape \(3,\); this scorecard is of 2 rows"):
        card.add(np.ones(2), NO, NONE, {"d": np.ones(3)})
