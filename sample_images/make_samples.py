"""Render the synthetic samples of this folder again: `python sample_images/make_samples.py [FOLDER]`.

Without FOLDER the files here are replaced. Same version, same bytes.
"""

import sys
from pathlib import Path

from startrack.cli.main import main

COMMON = "--camera fisheye-2048 --terrain shackleton-thesis --truth-mag 6 --stars hipparcos --overwrite"
SAMPLES = {
    "near-centre": "--seed 1 --time 2031-03-26T20:58:11Z --east 420 --north -310 --heading 32 --pitch 1.5 --roll -2",
    "near-wall": "--seed 2 --time 2029-09-08T03:12:45Z --east -6900 --north 4700 --heading 205 --pitch -2.5 --roll 1",
    "tilted": "--seed 3 --time 2027-12-02T14:05:30Z --east 5200 --north 4200 --heading 268 --pitch 9 --roll 8",
}


def make(folder: Path) -> int:
    """Render every sample into the folder; the worst exit code."""
    shots = [[*flags.split(), "--output", str(folder / f"{name}.png")] for name, flags in SAMPLES.items()]
    return max(main(["render", *COMMON.split(), *shot]) for shot in shots)


if __name__ == "__main__":
    sys.exit(make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent))
