"""video.py: frames show the figure where it should be, videos decode to what was written, messages."""

import ctypes
import os
import subprocess
import sys

import imageio_ffmpeg
import matplotlib.image
import numpy as np
import PIL.Image
import pytest

from kinetok.render import RenderError, render_frames, write_strip, write_video
from kinetok.sim.tasks import Marker

SIZE = (160, 90)


@pytest.fixture(scope="module")
def egl():
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        pytest.skip("no EGL library: install libegl1")


@pytest.fixture(scope="module")
def qpos(table):
    return table.qpos[:10]


@pytest.fixture(scope="module")
def frames(egl, humanoid, qpos):
    return list(render_frames(humanoid, qpos, fps=30, size=SIZE))


def test_frames_show_a_figure_on_a_floor(frames):
    assert [(f.shape, f.dtype) for f in frames] == [((90, 160, 3), np.uint8)] * 10
    middle, border = frames[0][20:75, 70:90].astype(int), frames[0][20:75, :20].astype(int)
    assert middle.min() < border.min() - 20  # the figure is darker than the floor, and in the middle
    assert frames[0][-1].mean() > 120 and frames[0][0, :, 2].mean() > frames[0][0, :, 0].mean()  # a floor, a blue sky


def test_the_figure_moves(frames):
    assert np.abs(frames[9].astype(int) - frames[0]).max() > 50


def test_ghost_and_caption(egl, frames, humanoid, qpos):
    ghost = qpos.copy()
    ghost[:, 1] += 0.6
    shown = next(render_frames(humanoid, qpos, fps=30, size=SIZE, ghost=ghost))
    orange = (shown[..., 0].astype(int) - shown[..., 2]) > 60
    assert orange.sum() > 30 and ((frames[0][..., 0].astype(int) - frames[0][..., 2]) > 60).sum() == 0
    captioned = next(render_frames(humanoid, qpos, fps=30, size=SIZE, caption="walk"))
    changed = np.argwhere((captioned != frames[0]).any(-1))
    assert len(changed) and changed.max(0)[0] < 30 and changed.max(0)[1] < 80  # the upper left corner only


RED, GREEN = (0.9, 0.1, 0.1, 1.0), (0.1, 0.8, 0.2, 1.0)


def coloured(image: np.ndarray, channel: int) -> np.ndarray:
    """Pixels (k, 2) as (row, column) whose channel stands well above the two others."""
    values = image.astype(int)
    return np.argwhere(values[..., channel] > 60 + np.delete(values, channel, axis=-1).max(-1))


def test_a_marker_is_drawn_in_its_frame_only(egl, humanoid, qpos):
    shown = [
        Marker(shape="ball", pos=(0.3, 0.0, 0.2), radius=0.15, rgba=RED),
        Marker(shape="disc", pos=(0.3, 0.0, 0.0), radius=0.4, rgba=RED),
        Marker(shape="pole", pos=(0.3, 0.4, 0.0), end=(0.3, 0.4, 1.5), radius=0.05, rgba=RED),
        Marker(shape="arrow", pos=(0.3, 0.2, 0.1), end=(0.9, 0.2, 0.1), radius=0.06, rgba=RED),
    ]
    markers = [[], *([marker] for marker in shown)]
    plain, *marked = render_frames(humanoid, qpos[:5], fps=30, size=SIZE, markers=markers)
    assert len(coloured(plain, 0)) == 0
    assert all(20 < len(coloured(image, 0)) < 1500 for image in marked)


def test_markers_are_where_they_are_said_to_be(egl, humanoid, qpos):
    low, high = (0.0, 0.0, 0.1), (0.0, 0.0, 1.9)
    markers = [[Marker(shape="ball", pos=p, radius=0.1, rgba=c) for p, c in ((low, RED), (high, GREEN))]]
    near, far = (
        next(render_frames(humanoid, qpos[:1], fps=30, size=SIZE, markers=markers, distance=d)) for d in (3.1, 6.0)
    )
    gaps = [coloured(image, 0).mean(0)[0] - coloured(image, 1).mean(0)[0] for image in (near, far)]
    assert gaps[0] > 40 and 0.4 < gaps[1] / gaps[0] < 0.65  # red below green; 3.1 / 6.0 = .52 as large from afar
    assert len(coloured(far, 0)) < len(coloured(near, 0))


def test_a_strip_shows_the_markers_of_its_frames(egl, tmp_path, humanoid, qpos):
    path, ball = tmp_path / "strip.png", Marker(shape="ball", pos=(0.3, 0.3, 0.3), radius=0.2, rgba=RED)
    write_strip(path, humanoid, qpos, columns=2, size=(80, 60), markers=[[]] * 9 + [[ball]])
    image = (matplotlib.image.imread(path)[..., :3] * 255).astype(int)
    assert len(coloured(image[:, :80], 0)) == 0 and len(coloured(image[:, 80:], 0)) > 20


def test_video_decodes_to_what_was_written(tmp_path, frames):
    path = tmp_path / "new" / "clip.mp4"
    write_video(path, frames, 25)
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert (meta["size"], meta["fps"], meta["codec"]) == (SIZE, 25.0, "h264") and "yuv420p" in meta["pix_fmt"]
    decoded = [np.frombuffer(raw, np.uint8).reshape(90, 160, 3).astype(int) for raw in reader]
    assert len(decoded) == 10
    assert max(np.abs(a - b).mean() for a, b in zip(decoded, frames, strict=True)) < 8
    assert [p.name for p in path.parent.iterdir()] == ["clip.mp4"]


def test_a_gif_has_fifteen_frames_a_second(tmp_path, frames):
    path = tmp_path / "clip.gif"
    write_video(path, frames, 30)
    with PIL.Image.open(path) as image:
        assert (image.format, image.size, image.n_frames) == ("GIF", SIZE, 5)
        image.seek(4)
        drawn = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(drawn - frames[8]).mean() < 8
    assert [p.name for p in tmp_path.iterdir()] == ["clip.gif"]


def test_strip(egl, tmp_path, humanoid, qpos):
    path = tmp_path / "clip.png"
    write_strip(path, humanoid, qpos, columns=3, rows=2, size=(40, 60))
    image = matplotlib.image.imread(path)
    assert image.shape[:2] == (120, 120)
    assert np.abs(image[:60, :40] - image[60:, 80:]).max() > 0.2  # the first and the last still differ


def test_messages(tmp_path, humanoid, qpos):
    with pytest.raises(ValueError, match=r"qpos has shape \(10, 7\); 'humanoid' needs \(T, 43\)"):
        render_frames(humanoid, qpos[:, :7], fps=30)
    with pytest.raises(ValueError, match=r"ghost has shape \(4, 43\); 'humanoid' needs \(10, 43\)"):
        render_frames(humanoid, qpos, fps=30, ghost=qpos[:4])
    with pytest.raises(ValueError, match="markers are given for 3 frames, qpos for 10"):
        render_frames(humanoid, qpos, fps=30, markers=[[]] * 3)
    with pytest.raises(ValueError, match="marker 'ball' has no end"):
        Marker(shape="ball", pos=(0, 0, 0), end=(0, 0, 1), radius=0.1, rgba=RED)
    with pytest.raises(ValueError, match="marker 'arrow' needs an end"):
        Marker(shape="arrow", pos=(0, 0, 0), radius=0.1, rgba=RED)
    with pytest.raises(ValueError, match="no frames; a video needs at least one"):
        write_video(tmp_path / "a.mp4", [], 30)
    with pytest.raises(ValueError, match=r"frames are 5 x 4; H.264 needs even sides"):
        write_video(tmp_path / "a.mp4", [np.zeros((4, 5, 3), np.uint8)], 30)


def test_a_video_has_a_suffix_that_can_be_written(tmp_path, frames):
    with pytest.raises(ValueError, match=r"a\.avi: a video's name ends in \.mp4 or \.gif"):
        write_video(tmp_path / "a.avi", frames, 30)


def test_an_encoder_error_is_shown_and_leaves_no_file(tmp_path):
    with pytest.raises(RenderError, match="ffmpeg ended with code"):
        write_video(tmp_path / "a.mp4", [np.zeros((4, 4, 3), np.uint8)], 0.0)
    assert list(tmp_path.iterdir()) == []


NO_EGL = """
import ctypes
load = ctypes.CDLL.__init__
def init(self, name, *args, **kwargs):
    if "EGL" in str(name):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *args, **kwargs)
ctypes.CDLL.__init__ = init
import numpy as np
import PIL.Image
from kinetok.motion.character import Character
from kinetok.render import render_frames
body = Character.load("humanoid")
next(render_frames(body, np.array(body.model.qpos0)[None], fps=30))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux draws without a display")
def test_without_egl_the_message_names_the_package():
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM")
    environment = {k: v for k, v in os.environ.items() if k not in hidden}
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    result = subprocess.run([sys.executable, "-c", NO_EGL], capture_output=True, text=True, env=environment, cwd=root)
    assert "RenderError: MuJoCo cannot draw here" in result.stderr and "install libegl1" in result.stderr, result.stderr
