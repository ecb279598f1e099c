"""One recorded motion: poses of a character over time.

    clip = Clip(name="walk", character="humanoid", fps=30.0, qpos=qpos, loop=True, source="walk.txt")
    qpos = clip.at(np.arange(0, 20, 1 / 30))      # interpolated; a loop continues the root's path

qpos follows the character's MJCF (root xyz in metres, root quaternion wxyz, then joints depth first). In a
loop the last frame is the first frame of the next cycle, displaced horizontally. Refused: a wrong number of
columns, fewer than two frames, values that are not finite, quaternions that are not unit.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character

MIRRORED = "-mirrored"


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """fps: frames per second; qpos (T, nq) float64; loop: the motion repeats; source: where it came from."""

    name: str
    character: str
    fps: float
    qpos: np.ndarray = field(repr=False)
    loop: bool = False
    source: str = ""

    def __post_init__(self) -> None:
        body = Character.load(self.character)
        if self.qpos.ndim != 2 or self.qpos.shape[1] != body.nq:
            raise ValueError(
                f"clip {self.name!r}: qpos has shape {self.qpos.shape}; {self.character!r} needs (T, {body.nq})"
            )
        if len(self.qpos) < 2:
            raise ValueError(f"clip {self.name!r}: {len(self.qpos)} frames; a motion needs at least two")
        if not self.fps > 0:
            raise ValueError(f"clip {self.name!r}: fps is {self.fps}; it must be positive")
        if not np.isfinite(self.qpos).all():
            frame, column = np.argwhere(~np.isfinite(self.qpos))[0]
            raise ValueError(f"clip {self.name!r}: frame {frame}, column {column} is {self.qpos[frame, column]}")
        first = quaternion_columns(body)
        norms = np.linalg.norm(self.qpos[:, first[:, None] + np.arange(4)], axis=-1)
        if (np.abs(norms - 1) > 1e-3).any():
            frame, index = np.argwhere(np.abs(norms - 1) > 1e-3)[0]
            column = first[index]
            raise ValueError(
                f"clip {self.name!r}: frame {frame}, columns {column}-{column + 3}: a quaternion of norm "
                f"{norms[frame, index]:.4g} is no rotation; see rotation.normalize"
            )

    @property
    def seconds(self) -> float:
        """Duration of one cycle, from the first frame to the last."""
        return (len(self.qpos) - 1) / self.fps

    def at(self, times: np.ndarray) -> np.ndarray:
        """Poses (K, nq) at times (K,) in seconds. A loop goes on for ever; other clips hold their ends."""
        body = Character.load(self.character)
        cycles = np.floor(times / self.seconds + 1e-9) if self.loop else np.zeros_like(times)
        frame = np.clip((times - cycles * self.seconds) * self.fps, 0, len(self.qpos) - 1)
        low = np.minimum(frame.astype(int), len(self.qpos) - 2)
        pose = interpolate(body, self.qpos[low], self.qpos[low + 1], frame - low)
        pose[:, :2] += cycles[:, None] * (self.qpos[-1, :2] - self.qpos[0, :2])
        return pose

    def resample(self, fps: float) -> "Clip":
        """The same motion at another frame rate.

        A loop keeps its whole cycle, so its rate is the nearest one that divides it; of any other clip the last frame
        may fall up to 1/fps seconds earlier.
        """
        if self.loop:
            count = max(round(self.seconds * fps), 1)
            fps = count / self.seconds
        else:
            count = int(self.seconds * fps + 1e-6)
        times = np.arange(count + 1) / fps
        qpos = self.at(np.minimum(times, self.seconds - 1e-9))
        qpos[-1] = self.qpos[-1] if self.loop else qpos[-1]
        return replace(self, fps=fps, qpos=qpos)

    def slice(self, start: float, stop: float) -> "Clip":
        """The part from start to stop seconds, no longer a loop."""
        if not 0 <= start < stop <= self.seconds + 1e-9:
            raise ValueError(f"clip {self.name!r}: [{start}, {stop}] s is not within [0, {self.seconds:.3f}] s")
        first, last = round(start * self.fps), round(stop * self.fps)
        return replace(self, qpos=self.qpos[first : last + 1], loop=False)

    def mirror(self) -> "Clip":
        """The same motion with left and right exchanged, reflected at the x-z plane; twice is the motion itself."""
        name = self.name.removesuffix(MIRRORED) if self.name.endswith(MIRRORED) else self.name + MIRRORED
        return replace(self, name=name, qpos=Character.load(self.character).mirror_qpos(self.qpos))


def quaternion_columns(body: Character) -> np.ndarray:
    """First qpos columns of the root's and the ball joints' quaternions."""
    return np.concatenate([[3], body.ball[:, 0]]).astype(int)


def interpolate(body: Character, a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Poses between a and b (K, nq) at shares t (K,): slerp for rotations, linear for the rest."""
    pose = a + (b - a) * t[:, None]
    columns = quaternion_columns(body)[:, None] + np.arange(4)
    pose[:, columns] = rotation.slerp(a[:, columns], b[:, columns], np.repeat(t[:, None], len(columns), axis=1))
    return pose


def close_loop(body: Character, qpos: np.ndarray, frames: int) -> np.ndarray:
    """Blend the last `frames` frames towards the first pose so that a cycle ends where the next begins.

    Horizontal root position is left alone: its change over the cycle is the path the loop continues.
    """
    frames = min(frames, len(qpos) - 1)
    share = np.zeros(len(qpos))
    share[-frames - 1 :] = (1 - np.cos(np.linspace(0, np.pi, frames + 1))) / 2
    # The discrepancy between the ends is taken out along the blend, so the motion keeps its own shape.
    first, last = np.repeat(qpos[:1], len(qpos), 0), np.repeat(qpos[-1:], len(qpos), 0)
    closed = qpos + (first - last) * share[:, None]
    columns = quaternion_columns(body)[:, None] + np.arange(4)
    gap = rotation.to_rotvec(rotation.multiply(rotation.conjugate(last[:, columns]), first[:, columns]))
    closed[:, columns] = rotation.multiply(qpos[:, columns], rotation.from_rotvec(gap * share[:, None, None]))
    closed[:, :2] = qpos[:, :2]
    return closed
