"""portrait.py: the picture shows the character in three views, the text what it is made of."""

import ctypes
import re

import matplotlib.image
import numpy as np
import pytest

from kinetok.motion.character import Character, characters
from kinetok.render.portrait import describe, write_portrait


@pytest.mark.parametrize("name", characters())
def test_three_views(tmp_path, name):
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        pytest.skip("no EGL library: install libegl1")
    path = tmp_path / "new" / "portrait.png"
    write_portrait(path, Character.load(name), size=(120, 180))
    views = np.split((matplotlib.image.imread(path)[..., :3] * 255).astype(int), 3, axis=1)
    assert views[0].shape == (180, 120, 3) and [p.name for p in path.parent.iterdir()] == ["portrait.png"]
    for view in views:  # the figure is in the middle, the sky above its head is free, its feet are in the picture
        middle, border = view[20:160, 45:75], view[20:160, :15]
        assert middle.min() < border.min() - 20
        assert np.ptp(view[:12, 45:75].reshape(-1, 3), axis=0).max() < 25
        assert np.abs(view[150:165, 40:80] - np.median(view[150:165, :15], axis=(0, 1))).max() > 40
    assert np.abs(views[0] - views[2]).max() > 60
    left, right = views[0][:, :60], views[0][:, :59:-1]  # the left side is drawn lighter
    shape = [np.abs(half - half[:, :1]).max(-1) > 60 for half in (left, right)]
    assert (shape[0] == shape[1]).mean() > 0.9


def test_a_portrait_is_a_png(tmp_path, humanoid):
    with pytest.raises(ValueError, match=r"a\.jpg: a portrait is a PNG; the name must end in \.png"):
        write_portrait(tmp_path / "a.jpg", humanoid)


def test_description():
    text = describe(Character.load("g1"))
    assert "g1: 30 bodies, 29 degrees of freedom beside the root's, 29 of them driven (nq 36, nv 35, nu 29)" in text
    assert re.search(r"mass 33\.34 kg, standing 1\.31 m high, root at 0\.78\d m", text)
    assert re.search(r"left_knee_joint +hinge +-0\.09 \.\. 2\.88 +600 +30 +139", text)
    assert re.search(r"mirror +left_ <-> right_, through xz", text) and re.search(r"left_shin +left_knee_link", text)
    assert "no part named: head" in text and "no role named" not in text  # the g1 has no neck


def test_description_without_roles(tiny):
    text = describe(tiny)
    assert "no role named: feet, mirror, retarget, stand\n" in text and "no part named" not in text
    assert re.search(r"shoulder +ball +free +30 +3 +5", text) and re.search(r"wrist +hinge +free +20 +3 +inf", text)
