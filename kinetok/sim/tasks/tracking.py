"""Tracking: follow a reference clip. GPC's observations, reward and termination (app. B).

    table = ReferenceTable(library, control_hz=30, seconds=20)
    task = Tracking(TrackingConfig(), table, rows=512)

The observation of a row is state | window | error | target (see `layout`): proprioception, the future frames
relative to the body, the tracking error now, and the PD target that the next reference frame suggests. Which
parts a policy reads is the policy's choice: a tokenizer's encoder reads the window, its decoder the state, a
teacher may read all. Clips are tabulated once at the control rate, loops unrolled to the longest episode.
"""

import os
from dataclasses import dataclass, replace

import numpy as np

from kinetok import rotation
from kinetok.config import ConfigError
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.kinematics import Motion, kinematics
from kinetok.motion.library import ClipLibrary
from kinetok.sim import observe
from kinetok.sim.batch import ALL, BodyState, Rows
from kinetok.sim.kernels import kernel
from kinetok.sim.reset import ClipWeights
from kinetok.sim.reward import TrackingReward, tracking_errors, tracking_reward

LARGEST = 0.8  # of the machine's memory that a table may take


@dataclass(frozen=True, kw_only=True)
class Failure:
    """largest, mean: an episode fails when the largest or the mean body error exceeds so many metres; slack: metres on
    the floor that the root may be away by without that counting as error (ours; without it a push ends an episode, with
    it pushes teach to recover: docs/log.md)."""

    largest: float = 0.5
    mean: float = 0.3
    slack: float = 0.0

    def __post_init__(self) -> None:
        for name in ("largest", "mean"):
            if not getattr(self, name) > 0:
                raise ConfigError(
                    f"{name} must be above 0, not {getattr(self, name)}; its unit is metres of body error"
                )
        if not self.slack >= 0:
            raise ConfigError(f"slack is metres that the root may be away by, 0 for none; not {self.slack}")

    def times(self, factor: float) -> "Failure":
        """The same slack, and limits so many times as wide."""
        return replace(self, largest=factor * self.largest, mean=factor * self.mean)


@dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """future: reference frames seen, in control steps ahead (GPC: 1, 2, 5, 7, 12, 18, 25); leash: metres from the root
    at which a reference that is further away is shown (ours): a push or a lag then looks like none a tracker has not
    met; failure; reward; from_start: share of the episodes that begin at their clip's first frame, as encoding does:
    a clip may begin where it is hardest to."""

    future: tuple[int, ...] = (1, 2, 5, 7, 12, 18, 25)
    leash: float = 0.3
    failure: Failure = Failure()
    reward: TrackingReward = TrackingReward()
    from_start: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.from_start <= 1:
            raise ConfigError(f"from_start is a share of the episodes, 0 to 1, not {self.from_start}")


class ReferenceTable:
    """Clips as arrays over frames at the control rate; frames of clip k are first[k] .. last[k].

    It holds every frame in memory, some 2 kB each for the humanoid, a quarter of a gigabyte an hour; more than the
    machine has is refused before it is filled.
    """

    def __init__(self, library: ClipLibrary, *, control_hz: int = 30, seconds: float = 20.0):
        self.character = Character.load(library.character)
        self.names, self.control_hz, self.identity = library.names, control_hz, library.identity()
        self.cycle = np.maximum((library.seconds * control_hz + 1e-6).astype(int), 1)
        counts = self.cycle + round(seconds * control_hz) * library.loop + 1
        self.first = np.cumsum(counts) - counts
        self.last = self.first + counts - 1
        few = _tabulated(self.character, library.clip(0), 2, control_hz)
        _refuse_too_large(counts.sum(), sum(part[0].nbytes for part in few.values()), control_hz)
        columns = {name: np.empty((counts.sum(), *part.shape[1:]), part.dtype) for name, part in few.items()}
        for index, (first, count) in enumerate(zip(self.first, counts, strict=True)):
            some = _tabulated(self.character, library.clip(index), int(count), control_hz)
            for name, part in some.items():
                columns[name][first : first + count] = part
        body = ("pos", "mat", "linear", "angular", "quat")
        self.body = BodyState(**{name: columns[name] for name in body})
        self.qpos, self.qvel, self.heading = columns["qpos"], columns["qvel"], columns["heading"]
        self.pose, self.target = columns["pose"], columns["target"]
        self.root = np.ascontiguousarray(self.body.pos[:, 0])
        self.facing = np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)


def _tabulated(body: Character, clip: Clip, frames: int, control_hz: int) -> dict[str, np.ndarray]:
    """What a table holds of the first frames of a clip, by column. A loop had a frame before its first, and has one
    after its last, so that it moves there as it does when it comes by again."""
    beyond = int(clip.loop)
    motion = kinematics(body, clip.at(np.arange(-beyond, frames + beyond) / control_hz), control_hz)
    motion = Motion(**{name: values[beyond : beyond + frames] for name, values in vars(motion).items()})
    pos, mat = motion.xpos.astype(np.float32), rotation.to_matrix(motion.xquat).astype(np.float32)
    quat = motion.xquat[:, 0].astype(np.float32)
    # PD target that makes a joint with damping kd follow a moving reference: q + kd / kp * qd
    target = body.pose_to_ctrl(motion.qpos) + body.kd / body.kp * motion.qvel[:, body.dof]
    return {
        "qpos": motion.qpos,
        "qvel": motion.qvel,
        "pos": pos,
        "mat": mat,
        "linear": motion.linear.astype(np.float32),
        "angular": motion.angular.astype(np.float32),
        "quat": quat,
        "heading": rotation.heading(quat),
        "pose": observe.pose_features(pos, mat, quat),
        "target": target.astype(np.float32),
    }


def _refuse_too_large(frames: int, size: int, control_hz: int) -> None:
    """Refuse a table of so many frames of so many bytes that the machine's memory cannot hold."""
    if not hasattr(os, "sysconf"):  # Windows does not say
        return
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if frames * size > LARGEST * there:
        raise ConfigError(
            f"{frames / control_hz / 3600:.1f} hours of reference frames take {frames * size / 1e9:.1f} GB, and this "
            f"machine has {there / 1e9:.1f} GB of memory: draw some of the clips at random, --hours "
            f"{max(1, int(0.25 * there / size / control_hz / 3600))}"
        )


class Tracking:
    """The tracking task of `rows` worlds.

    Episodes start anywhere in a clip (reference-state initialisation), clips drawn by how often they fail. `fixed`
    (rows,) pins each row to one clip and `starts` (rows,) to one frame of it, counted from its first.
    """

    def __init__(
        self,
        config: TrackingConfig,
        table: ReferenceTable,
        *,
        rows: int,
        fixed: np.ndarray | None = None,
        starts: np.ndarray | None = None,
    ):
        self.config, self.table, self.character = config, table, table.character
        self.weights = ClipWeights(len(table.names))
        self.fixed, self.starts = fixed, starts
        self.clip = np.zeros(rows, dtype=int)
        self.frame = np.zeros(rows, dtype=int)
        self.offset = np.zeros((rows, len(self.character.body_names), 3), dtype=np.float32)
        self._future = np.array(config.future)
        bodies = len(self.character.body_names)
        sizes = {
            "state": observe.state_size(bodies),
            "window": observe.window_size(bodies, len(config.future)),
            "error": observe.error_size(bodies),
            "target": self.character.nu,
        }
        edges = np.cumsum([0, *sizes.values()])
        self.layout = {name: slice(int(a), int(b)) for name, a, b in zip(sizes, edges, edges[1:], strict=False)}
        self.obs_size = int(edges[-1])

    def start(self, ids: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Poses and velocities of the frames at which rows ids begin."""
        table = self.table
        if self.fixed is not None:
            clip = self.fixed[ids]
        else:
            clip = self.weights.draw(len(ids), rng)
        if self.starts is not None:
            offset = self.starts[ids]
        else:
            offset = (rng.random(len(ids)) * table.cycle[clip]).astype(int)
            if self.config.from_start:
                offset[rng.random(len(ids)) < self.config.from_start] = 0
        self.place(ids, clip, table.first[clip] + offset)
        return table.qpos[self.frame[ids]], table.qvel[self.frame[ids]]

    def spread(self) -> None:
        """Rows begin anywhere as it is."""

    def place(self, ids: np.ndarray, clip: np.ndarray, frame: np.ndarray) -> None:
        """Let rows ids follow `clip` (n,) from table frame `frame` (n,) on."""
        self.clip[ids], self.frame[ids] = clip, frame

    def advance(self) -> None:
        """Time goes on by one control step."""
        self.frame = np.minimum(self.frame + 1, self.table.last[self.clip])
        self.weights.count(self.clip)

    def observe(self, body: BodyState, ids: Rows = ALL, out: np.ndarray | None = None) -> np.ndarray:
        """state | window | error | target (n, O) float32 of rows ids, which are in states body; to out, if given."""
        table, frame = self.table, self.frame[ids]
        last = table.last[self.clip[ids]]
        ahead, beyond = np.empty((len(frame), len(self._future)), int), np.empty((len(frame), 2), np.float32)
        _shown(table.root, body.pos, frame, last, self._future, np.float32(self.config.leash), ahead, beyond)
        obs = np.empty((len(frame), self.obs_size), dtype=np.float32) if out is None else out
        start = {name: columns.start for name, columns in self.layout.items()}
        observe.state_features(body, obs, start["state"])
        observe.window_features(body, table.pose, table.root, table.facing, ahead, beyond, obs, start["window"])
        observe.error_features(body, table.body, frame, beyond, obs, start["error"])
        obs[:, self.layout["target"]] = table.target[np.minimum(frame + 1, last)]
        return obs

    def reward(self, body: BodyState) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """GPC eq. 8 against the frame the row should have reached."""
        terms = tracking_reward(tracking_errors(body, self.table.body, self.frame), self.config.reward)
        return np.sum(list(terms.values()), axis=0), terms

    def over(self, body: BodyState) -> tuple[np.ndarray, np.ndarray]:
        """terminated: the error is too large (or not a number); truncated: the clip is over.

        `offset` keeps where the reference was from every body (N, B, 3), in metres, before any reset.
        """
        offset = self.offset = self.table.body.pos[self.frame] - body.pos
        if self.config.failure.slack:
            offset = offset.copy()
            offset[..., :2] -= _no_longer(offset[:, :1, :2], self.config.failure.slack)
        largest, mean = np.empty((2, len(offset)), dtype=np.float32)
        _distances(offset, largest, mean)
        fine = (largest < self.config.failure.largest) & (mean < self.config.failure.mean)
        return ~fine, self.frame >= self.table.last[self.clip]

    def state_dict(self) -> dict:
        return self.weights.state_dict()

    def load_state_dict(self, state: dict) -> None:
        self.weights.load_state_dict(state)

    def finished(self, ids: np.ndarray, terminated: np.ndarray) -> None:
        """Failure-weighted clip sampling learns from every finished episode."""
        self.weights.update(self.clip[ids], ~terminated)


@kernel
def _shown(root, pos, frame, last, future, leash, ahead, beyond):
    """The frames ahead of each row, and by how much it is shown them nearer than they are, see TrackingConfig."""
    for row in range(len(frame)):
        for k in range(len(future)):
            ahead[row, k] = min(frame[row] + future[k], last[row])
        x, y = root[frame[row], 0] - pos[row, 0, 0], root[frame[row], 1] - pos[row, 0, 1]
        length = np.sqrt(x * x + y * y)
        share = (length - leash) / length if length > leash else length * 0
        beyond[row, 0], beyond[row, 1] = share * x, share * y


@kernel
def _distances(offset, largest, mean):
    """Of each row's bodies, offset (N, B, 3); the mean is no number where one of them is none."""
    for row in range(len(offset)):
        total, most = offset[row, 0, 0] * 0, offset[row, 0, 0] * 0
        for b in range(offset.shape[1]):
            x, y, z = offset[row, b, 0], offset[row, b, 1], offset[row, b, 2]
            length = np.sqrt(x * x + y * y + z * z)
            total += length
            most = max(most, length)
        largest[row], mean[row] = most, total / offset.shape[1]


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Of vectors (..., k)."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _no_longer(vectors: np.ndarray, length: float) -> np.ndarray:
    """Vectors (..., k) of at most that length."""
    return vectors * np.minimum(1, length / lengths(vectors)[..., None].clip(1e-6))
