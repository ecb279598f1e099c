"""Draw poses of a character and write them as a video or as a strip of stills.

    frames = render_frames(humanoid, qpos, fps=30, ghost=reference, caption="walk")
    frames = render_frames(humanoid, qpos, fps=30, markers=markers, distance=6.0, elevation=-25.0)
    write_video(Path("walk.mp4"), frames, fps=30)              # or walk.gif, for a web page
    write_strip(Path("walk.png"), humanoid, qpos)

The camera follows the root, smoothed, from three quarters in front. `ghost` is a second sequence of poses drawn
translucent in the same place; `markers` show what a task asks for (sim.tasks.marker). Without a display MuJoCo
draws through EGL (see kinetok/__init__.py); where that library is missing, RenderError names the package. Shadows
are flat discs below the limbs: half of the drawing time of a software renderer would go into a shadow map.
"""

import os
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import imageio_ffmpeg
import matplotlib.image
import mujoco
import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.sim.scene import SceneConfig, scene_spec
from kinetok.sim.tasks.marker import Marker

GHOST = (0.96, 0.56, 0.20, 0.38)
SKY, HAZE = (0.55, 0.68, 0.84), (0.90, 0.93, 0.96)
DISTANCE, ELEVATION, THREE_QUARTERS = 3.1, -14.0, 138.0  # metres, degrees, degrees from the heading
BONE, BONE_COLOUR, BONE_GROUP = 0.028, (0.30, 0.34, 0.42, 1.0), 2  # radius in metres
SHADE_HEIGHT = 0.9
FOLLOW_SECONDS = 0.5
PALETTE = "split[a][b];[a]palettegen=max_colors=48[p];[b][p]paletteuse=dither=none"  # one for all frames
ENCODERS = {
    ".mp4": "-c:v libx264 -preset veryfast -crf 21 -pix_fmt yuv420p -movflags +faststart",
    ".gif": f"-vf fps=15,scale='min(400,iw)':-1:flags=area,{PALETTE}",
}


class RenderError(RuntimeError):
    """Drawing or encoding is not possible on this machine; the message says what to install."""


def render_frames(
    character: Character,
    qpos: np.ndarray,
    *,
    fps: float,
    size: tuple[int, int] = (640, 360),
    ghost: np.ndarray | None = None,
    caption: str = "",
    markers: Sequence[Sequence[Marker]] | None = None,
    distance: float = DISTANCE,
    elevation: float = ELEVATION,
) -> Iterator[np.ndarray]:
    """Draw poses qpos (T, nq), given at fps frames per second, as images (H, W, 3) uint8; size is (width, height).

    ghost (T, nq) is drawn translucent over them; caption is written in the upper left corner; markers: those of each
    frame; distance, elevation: metres and degrees of the camera from the root.
    """
    for name, poses in (("qpos", qpos), ("ghost", ghost)):
        if poses is not None and (poses.ndim != 2 or poses.shape[1] != character.nq or len(poses) != len(qpos)):
            wanted = f"({len(qpos) if name == 'ghost' else 'T'}, {character.nq})"
            raise ValueError(f"{name} has shape {poses.shape}; {character.name!r} needs {wanted}")
    if markers is not None and len(markers) != len(qpos):
        raise ValueError(f"markers are given for {len(markers)} frames, qpos for {len(qpos)}")
    return _render(character, qpos, _cameras(qpos, fps, distance, elevation), size, ghost, caption, markers)


def write_video(path: Path | str, frames: Iterable[np.ndarray], fps: float) -> None:
    """Encode images (H, W, 3) uint8 by the file's suffix; the file appears whole or not at all.

    .mp4: H.264 (yuv420p, so sides must be even); .gif: 15 frames a second, at most 400 columns, 48 colours.
    """
    path = Path(path)
    if path.suffix not in ENCODERS:
        raise ValueError(f"{path}: a video's name ends in {' or '.join(ENCODERS)}")
    frames = iter(frames)
    try:
        first = next(frames)
    except StopIteration:
        raise ValueError(f"{path}: no frames; a video needs at least one") from None
    height, width = first.shape[:2]
    if path.suffix == ".mp4" and (height % 2 or width % 2):
        raise ValueError(f"{path}: frames are {width} x {height}; H.264 needs even sides")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{path.suffix}")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6f}", "-i", "-"]
    command += ["-an", *ENCODERS[path.suffix].split(" "), str(temporary)]
    try:
        _pipe(command, first, frames)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def render_task(
    character: Character, qpos: np.ndarray, markers: Sequence[Sequence[Marker]], *, fps: float, caption: str
) -> Iterator[np.ndarray]:
    """render_frames from further up, where the floor shows what a task asks for."""
    return render_frames(character, qpos, fps=fps, markers=markers, caption=caption, distance=4.5, elevation=-28.0)


def write_strip(
    path: Path | str,
    character: Character,
    qpos: np.ndarray,
    *,
    columns: int = 8,
    rows: int = 1,
    size: tuple[int, int] = (200, 260),
    markers: Sequence[Sequence[Marker]] | None = None,
    distance: float = DISTANCE,
    elevation: float = ELEVATION,
) -> None:
    """Write a PNG of columns x rows stills, evenly spaced over poses qpos (T, nq), each `size` (width, height).

    markers, distance, elevation: as in render_frames.
    """
    path = Path(path)
    picked = np.linspace(0, len(qpos) - 1, columns * rows).round().astype(int)
    shown = None if markers is None else [markers[t] for t in picked]
    # one heading for all stills, which 1e-3 frames per second gives: the camera goes along but does not turn
    frames = render_frames(
        character, qpos[picked], fps=1e-3, size=size, markers=shown, distance=distance, elevation=elevation
    )
    tiles = np.stack(list(frames))
    grid = tiles.reshape(rows, columns, *tiles.shape[1:]).transpose(0, 2, 1, 3, 4)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.png")
    matplotlib.image.imsave(temporary, grid.reshape(rows * size[1], columns * size[0], 3))
    os.replace(temporary, path)


def _pipe(command: list[str], first: np.ndarray, frames: Iterator[np.ndarray]) -> None:
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:
        assert encoder.stdin and encoder.stderr
        try:
            encoder.stdin.write(np.ascontiguousarray(first).data)
            for frame in frames:
                encoder.stdin.write(np.ascontiguousarray(frame).data)
            encoder.stdin.close()
        except BrokenPipeError:
            pass  # the encoder gave up; its own message below says why
        message = encoder.stderr.read().decode(errors="replace").strip()
    if encoder.returncode:
        raise RenderError(f"ffmpeg ended with code {encoder.returncode}: {message}")


def _cameras(qpos: np.ndarray, fps: float, distance: float, elevation: float) -> list[mujoco.MjvCamera]:
    """One camera per frame, looking at the smoothed root from three quarters in front of the mean heading."""
    sigma = FOLLOW_SECONDS * fps
    reach = np.arange(-round(3 * sigma), round(3 * sigma) + 1)
    kernel = np.exp(-0.5 * (reach / max(sigma, 1e-9)) ** 2)
    padded = np.pad(qpos[:, :3], ((len(reach) // 2,) * 2, (0, 0)), mode="edge")
    look_at = np.stack([np.convolve(padded[:, i], kernel / kernel.sum(), mode="valid") for i in range(3)], axis=1)
    heading = np.angle(np.exp(1j * rotation.heading(qpos[:, 3:7])).mean())
    cameras = []
    for x, y, z in look_at:
        camera = mujoco.MjvCamera()
        camera.lookat[:] = x, y, 0.55 * z + 0.4
        camera.distance, camera.elevation = distance, elevation
        camera.azimuth = np.rad2deg(heading) + THREE_QUARTERS
        cameras.append(camera)
    return cameras


def _model(character: Character, size: tuple[int, int]) -> mujoco.MjModel:
    spec = scene_spec(character, SceneConfig())
    texture = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
    spec.add_texture(name="sky", width=64, height=384, rgb1=HAZE, rgb2=SKY, **texture)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    spec.visual.rgba.haze = (*HAZE, 1.0)
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 20, 12
    for body in spec.bodies[1:]:  # bones from joint to joint: a figure of loose limbs is hard to read
        ends = [] if body.parent == spec.worldbody else [(body.parent, np.array(body.pos))]
        ends += [(body, np.array(g.pos)) for g in body.geoms if g.type == mujoco.mjtGeom.mjGEOM_SPHERE]
        for start, end in ends:
            if np.linalg.norm(end) > 2 * BONE:
                start.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                    fromto=[0, 0, 0, *end],
                    size=[BONE, 0, 0],
                    rgba=BONE_COLOUR,
                    group=BONE_GROUP,
                )
    model = spec.compile()
    for geom in range(1, model.ngeom):  # the left side lighter, so that steps can be told apart
        if model.body(model.geom_bodyid[geom]).name.startswith("left"):
            model.geom_rgba[geom, :3] = 0.45 + 0.55 * model.geom_rgba[geom, :3]
    return model


@contextmanager
def _context(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[mujoco.MjrContext]:
    """An off-screen OpenGL context, current inside the block."""
    try:
        window = mujoco.GLContext(*size)
        window.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # each backend raises its own kinds
        backend = os.environ.get("MUJOCO_GL", "none chosen")
        raise RenderError(
            f"MuJoCo cannot draw here (MUJOCO_GL: {backend}; {error}). Without a display it draws through EGL: "
            "install libegl1 and libgl1-mesa-dri (apt) or mesa-libEGL (dnf), and leave MUJOCO_GL unset"
        ) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    try:
        yield context
    finally:
        context.free()
        window.free()


def _render(
    character: Character,
    qpos: np.ndarray,
    cameras: list[mujoco.MjvCamera],
    size: tuple[int, int],
    ghost: np.ndarray | None,
    caption: str,
    markers: Sequence[Sequence[Marker]] | None,
) -> Iterator[np.ndarray]:
    model = _model(character, size)
    pale = _model(character, size)
    pale.geom_rgba[1:] = np.where(pale.geom_group[1:, None] == BONE_GROUP, 0, GHOST)
    data, option, pert = mujoco.MjData(model), mujoco.MjvOption(), mujoco.MjvPerturb()
    moving = mujoco.mjtCatBit.mjCAT_DYNAMIC
    most = max((len(shown) for shown in markers or ()), default=0)
    scene = mujoco.MjvScene(model, maxgeom=10 * model.ngeom + most)
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True
    view, image = mujoco.MjrRect(0, 0, *size), np.empty((size[1], size[0], 3), dtype=np.uint8)
    corner = mujoco.mjtGridPos.mjGRID_TOPLEFT
    with _context(model, size) as context:
        for t, camera in enumerate(cameras):
            data.qpos[:] = qpos[t]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            mujoco.mjv_updateScene(model, data, option, pert, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
            _shade(model, data, scene)
            if ghost is not None:
                data.qpos[:] = ghost[t]
                mujoco.mj_kinematics(pale, data)
                mujoco.mjv_addGeoms(pale, data, option, pert, moving, scene)
            for marker in markers[t] if markers else ():
                _mark(marker, scene)
            mujoco.mjr_render(view, scene, context)
            if caption:
                mujoco.mjr_overlay(mujoco.mjtFont.mjFONT_NORMAL, corner, view, caption, "", context)
            mujoco.mjr_readPixels(image, None, view, context)
            yield image[::-1].copy()


def _shade(model: mujoco.MjModel, data: mujoco.MjData, scene: mujoco.MjvScene) -> None:
    """Add a flat dark disc on the floor below every low geom, fainter the higher it is."""
    for geom in range(1, model.ngeom):
        x, y, z = data.geom_xpos[geom]
        if z > SHADE_HEIGHT or model.geom_group[geom] == BONE_GROUP:
            continue
        half = model.geom_aabb[geom, 3:]
        reach = np.abs(data.geom_xmat[geom].reshape(3, 3)) @ half
        size = np.array([reach[0], reach[1], 0.001])
        shade = np.array([0.05, 0.07, 0.12, 0.32 * (1 - max(z, 0) / SHADE_HEIGHT)], dtype=np.float32)
        disc = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            disc, mujoco.mjtGeom.mjGEOM_ELLIPSOID, size, np.array([x, y, 0.002]), np.eye(3).ravel(), shade
        )
        scene.ngeom += 1


def _mark(marker: Marker, scene: mujoco.MjvScene) -> None:
    """Add a marker; it glows a little, so that its colour is the same from all sides."""
    geom, r = scene.geoms[scene.ngeom], marker.radius
    shape, size = {
        "ball": (mujoco.mjtGeom.mjGEOM_SPHERE, (r, 0, 0)),
        "disc": (mujoco.mjtGeom.mjGEOM_CYLINDER, (r, 0.006, 0)),
        "pole": (mujoco.mjtGeom.mjGEOM_CAPSULE, (r, r, 0)),
        "arrow": (mujoco.mjtGeom.mjGEOM_ARROW, (r, r, r)),
    }[marker.shape]
    rgba = np.array(marker.rgba, dtype=np.float32)
    mujoco.mjv_initGeom(
        geom, shape, np.array(size, dtype=float), np.array(marker.pos, dtype=float), np.eye(3).ravel(), rgba
    )
    if marker.end is not None:
        mujoco.mjv_connector(geom, shape, r, np.array(marker.pos, dtype=float), np.array(marker.end, dtype=float))
    geom.emission = 0.4
    scene.ngeom += 1
