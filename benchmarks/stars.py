"""Detection and identification against other programs: all benchmarks, one after the other.

python benchmarks/stars.py [--write]
"""

from __future__ import annotations

import runpy
from pathlib import Path

if __name__ == "__main__":
    for name in ("stars_detection.py", "stars_narrow.py", "stars_identification.py"):
        runpy.run_path(str(Path(__file__).with_name(name)), run_name="__main__")
