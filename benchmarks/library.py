"""A clip library at scale: time to open, time and memory to sample, from one hour of motion to hundreds.

    python benchmarks/library.py --scratch /some/disk --hours 1 10 100 680 --json out.json

Writes a synthetic library of each size (streamed; 30 frames per second, clips of 2 to 18 s, five to a source), measures
it in a process of its own and deletes it. 680 hours are 73 million frames: 6.8 GB as float16, 12.6 GB as float32.

Memory is what the kernel reports for that process in /proc/self/status: VmRSS after the last batch and VmHWM, the
highest ever, both with all mapped file pages (RssFile) that the process holds. Pages that the kernel keeps for the file
in its own cache belong to no process and are not counted; the library reads frames by pread, and maps only its index.
"Cold" batches come after the file was dropped from that cache (posix_fadvise), the others after it was read once: how
much of a library fits the cache is the machine's affair, and a cold read waits for the disk.
"""

import argparse
import functools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from kinetok import rotation
from kinetok.motion.character import Character
from kinetok.motion.clip import Clip
from kinetok.motion.library import ClipLibrary

FPS, WINDOWS, FRAMES, BATCHES = 30.0, 4096, 30, 8
TIMES = [f"{state}_{name}_cpu_ms" for state in ("cold", "warm") for name in ("windows", "poses")]
BYTES = {"float16": 92, "float32": 172}  # a frame of the humanoid


def prototypes(count: int, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Smooth motion of the humanoid (count, frames, nq): every joint swings at its own few frequencies."""
    body, t = Character.load("humanoid"), np.arange(frames) / FPS
    qpos = np.tile(body.model.qpos0, (count, frames, 1))

    def waves(width: int, size: float) -> np.ndarray:
        speed, phase = rng.uniform(0.5, 6.0, (2, count, 1, width)), rng.uniform(0, 6.3, (2, count, 1, width))
        return size * (np.sin(speed[0] * t[:, None] + phase[0]) + np.sin(speed[1] * t[:, None] + phase[1])) / 2

    qpos[..., :2], qpos[..., 2:3] = waves(2, 2.0), 0.9 + waves(1, 0.05)
    qpos[..., 3:7] = rotation.about_z(waves(1, 2.0)[..., 0])
    for column in body.ball[:, 0]:
        qpos[..., column : column + 4] = rotation.from_rotvec(waves(3, 0.6))
    for column in body.hinge[:, 0]:
        qpos[..., column : column + 1] = waves(1, 0.6)
    return qpos


def synthesize(hours: float, seed: int = 0) -> Iterator[Clip]:
    """Clips of the humanoid, this many hours in all, one at a time: cut at random from 64 prototypes and moved."""
    rng = np.random.default_rng(seed)
    motion, left, number = prototypes(64, 1200, rng), round(hours * 3600 * FPS), 0
    while left >= 2:
        frames = min(int(rng.integers(60, 541)), left)
        begin = int(rng.integers(0, 1200 - frames))
        qpos = motion[rng.integers(64), begin : begin + frames].copy()
        qpos[:, :2] += rng.uniform(-50, 50, 2)
        source = f"take-{number // 5:06d}.bvh"
        yield Clip(name=f"clip-{number:07d}", character="humanoid", fps=FPS, qpos=qpos, source=source)
        left, number = left - frames, number + 1


def memory() -> dict[str, float]:
    """VmRSS, VmHWM, RssAnon and RssFile of this process in MB."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {name: int(lines[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM", "RssAnon", "RssFile")}


def timed(work) -> tuple[float, float]:
    """Seconds of wall clock and of this process."""
    wall, own = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - own


def measure(path: Path) -> dict[str, object]:
    """Open a library and draw batches of 4,096 windows of one second and of 4,096 single poses, cold and warm."""
    rng = np.random.default_rng(0)
    Character.load("humanoid")
    before = memory()["VmRSS"]
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    held: list[ClipLibrary] = []
    opening = timed(lambda: held.append(ClipLibrary.open(path)))
    library, figures = held[0], {"clips": len(held[0]), "open_s": opening[0], "open_cpu_s": opening[1]}

    def batch(frames: int) -> tuple[float, float, float]:
        ids: list[np.ndarray] = []
        drawing = timed(lambda: ids.append(library.sample(WINDOWS, None, rng)))[1]
        times = rng.uniform(0, 1, (WINDOWS, 1)) * library.parts[0].entries(ids[0])[1][:, None] / FPS
        return drawing, *timed(lambda: library.at(ids[0], times + np.arange(frames) / FPS))

    for state in ("cold", "warm"):
        for name, frames in (("windows", FRAMES), ("poses", 1)):
            drawing, wall, own = np.median([batch(frames) for _ in range(BATCHES)], axis=0)
            figures |= {f"{state}_{name}_ms": 1000 * wall, f"{state}_{name}_cpu_ms": 1000 * own}
            figures["sample_cpu_ms"] = 1000 * float(drawing)
        figures |= {f"{state}_rss_mb": memory()["VmRSS"]}
        with path.open("rb") as file:
            while file.read(1 << 20):
                pass
    after = memory()
    figures |= {"before_rss_mb": before, "file_rss_mb": after["RssFile"], "peak_mb": after["VmHWM"]}
    return {name: float(value) for name, value in figures.items()}


def figures_of(path: Path) -> dict[str, object]:
    """The figures of a fresh process."""
    command = [sys.executable, __file__, "--measure", str(path)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def library(scratch: Path, hours: Sequence[float] = (1, 10), dtype: str = "float16") -> dict[str, object]:
    """Figures by hours of motion, and of the largest library relative to the smallest."""
    if dtype not in BYTES:
        raise ValueError(f"dtype is {dtype!r}; float16 or float32")
    need, free = max(hours) * 3600 * FPS * BYTES[dtype] * 1.2, shutil.disk_usage(scratch).free
    if need > free / 2:
        raise ValueError(
            f"{max(hours)} hours need {need / 1e9:.1f} GB; {scratch} has {free / 1e9:.1f} GB free, too few"
        )
    results: dict[str, object] = {"dtype": dtype, "windows": WINDOWS, "frames": FRAMES}
    rows: list[dict] = []
    for size in sorted(hours):
        path = scratch / f".bench-library-{os.getpid()}.safetensors"
        write = functools.partial(ClipLibrary.write, path, synthesize(size), dtype=dtype)  # type: ignore[arg-type]
        try:
            wall, own = timed(write)
            row = {"hours": size, "gb": path.stat().st_size / 1e9, "write_s": wall, "write_cpu_s": own}
            row |= figures_of(path)
        finally:
            path.unlink(missing_ok=True)
        print(json.dumps(row), file=sys.stderr, flush=True)
        rows.append(row)
    first, last = rows[0], rows[-1]
    results["sizes"] = rows
    results["growth"] = {name: last[name] / first[name] for name in ("warm_rss_mb", "peak_mb", *TIMES)}
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scratch", type=Path, help="a folder on a disk with room")
    parser.add_argument("--hours", type=float, nargs="+", default=[1, 10])
    parser.add_argument("--dtype", default="float16", choices=sorted(BYTES))
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure)))
        return
    if not options.scratch:
        parser.error("--scratch: name a folder for the library")
    text = json.dumps(library(options.scratch, options.hours, options.dtype), indent=2)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
