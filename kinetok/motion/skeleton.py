"""A motion as it was recorded: joints of someone else's skeleton, before it fits any character.

    motion = read_bvh(Path("walk.bvh"))
    positions, rotations = motion.pose()             # (T, J, 3) m and (T, J, 4), world, z up

Every reader turns its file into this form: metres, seconds, radians, z up, quaternions wxyz. What the reader
could not know it says in `unit`: "guessed" where the file names no unit and the size of the body decided.
Refused: frames that are not finite, quaternions that are not unit, parents that do not come first.
"""

from dataclasses import dataclass, field

import numpy as np

from kinetok import rotation


@dataclass(frozen=True, kw_only=True, eq=False)
class SkeletonMotion:
    """fps; joints: J names, each after its parent; parents: index or -1; offsets (J, 3) metres from the parent's frame
    at rest; local (T, J, 4) rotation relative to the parent, the root's relative to the world; root (T, 3) metres;
    family: which rig it is ("cmu-daz", "smpl", ... or "" when unknown); unit: "m", "cm", ..., "guessed ..."; source."""

    name: str
    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray = field(repr=False)
    local: np.ndarray = field(repr=False)
    root: np.ndarray = field(repr=False)
    family: str = ""
    unit: str = "m"
    source: str = ""

    def __post_init__(self) -> None:
        frames, joints = len(self.root), len(self.joints)
        wanted = {"offsets": (joints, 3), "local": (frames, joints, 4), "root": (frames, 3), "parents": (joints,)}
        for name, shape in wanted.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"motion {self.name!r}: {name} has shape {np.shape(getattr(self, name))}, not {shape}")
        if frames < 2:
            raise ValueError(f"motion {self.name!r}: {frames} frames; a motion needs at least two")
        if not self.fps > 0:
            raise ValueError(f"motion {self.name!r}: fps is {self.fps}; it must be positive")
        if self.parents[0] != -1 or any(not 0 <= p < j for j, p in enumerate(self.parents) if j):
            raise ValueError(f"motion {self.name!r}: the first joint is the root, every other one follows its parent")
        for name in ("offsets", "local", "root"):
            values = getattr(self, name)
            if not np.isfinite(values).all():
                place = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
                raise ValueError(f"motion {self.name!r}: {name}{list(place)} is {values[place]}")
        norms = np.linalg.norm(self.local, axis=-1)
        if (np.abs(norms - 1) > 1e-3).any():
            frame, joint = np.argwhere(np.abs(norms - 1) > 1e-3)[0]
            raise ValueError(
                f"motion {self.name!r}: frame {frame}, joint {self.joints[joint]!r}: a quaternion of norm "
                f"{norms[frame, joint]:.4g} is no rotation"
            )

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return (len(self.root) - 1) / self.fps

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """World positions (T, J, 3) and rotations (T, J, 4) of all joints."""
        pos, rot = np.empty((*self.local.shape[:2], 3)), np.empty(self.local.shape)
        for joint, parent in enumerate(self.parents):
            if parent < 0:
                pos[:, joint], rot[:, joint] = self.root, self.local[:, joint]
            else:
                rot[:, joint] = rotation.multiply(rot[:, parent], self.local[:, joint])
                pos[:, joint] = pos[:, parent] + rotation.rotate(rot[:, parent], self.offsets[joint])
        return pos, rot
