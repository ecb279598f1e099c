"""Draw retargeted recordings, a row of stills each, so that a table of residuals can be looked at.

python benchmarks/strips.py walk.bvh run.amc --character humanoid --out docs/retargeted.jpg
"""

import argparse
import tempfile
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from kinetok.motion.character import Character
from kinetok.motion.formats import read_clips
from kinetok.render.video import write_strip

COLUMNS, SIZE = 10, (104, 132)


def strips(files: list[Path], character: str, out: Path) -> None:
    """One row per file, evenly spaced over its motion."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, file in enumerate(files):
            (clip,) = read_clips(file, character)
            strip = Path(folder) / f"{number}.png"
            write_strip(strip, Character.load(clip.character), clip.qpos, columns=COLUMNS, size=SIZE, distance=3.2)
            rows.append(imageio.imread(strip)[..., :3])
            print(f"{number + 1}. {file.name}: {clip.seconds:.1f} s")
    imageio.imwrite(out, np.concatenate(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="recordings of one motion each")
    parser.add_argument("--character", default="humanoid", help="body to put them on (default %(default)s)")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    options = parser.parse_args()
    strips(options.files, options.character, options.out)


if __name__ == "__main__":
    main()
