"""Makes the pictures of docs/predict.md: a map of Shackleton, a drive across a crater, what longer exposures buy.

    python docs/make_prediction.py

About ten minutes on two cores. A stopped run is resumed from the draws in startrack-predict/.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from PIL import Image

from startrack.cli.main import main
from startrack.core.files import data_dir

IMAGES = Path(__file__).parent / "images"
OUT = Path("startrack-predict")
FLOOR = OUT / "floor.toml"  # the shipped map, searched within 4 km of the middle: the floor
COMMON = ["predict", "-c", "fisheye-2048", "--time", "2030-06-01T00:00:00"]
WAYPOINTS = "east_m,north_m\n-8000,-3000\n-2000,0\n2000,1000\n5000,6500\n"

DRIVE = ["--spacing", "1000", "--draws", "3", "--exposures", "0.4,0.1,1,3"]


def run(name: str, terrain: str, *flags: str) -> Path:
    """The folder of one prediction."""
    out = OUT / name
    if main([*COMMON, "-t", terrain, "-D", str(out), *flags]) != 0:
        raise SystemExit(f"{name}: not predicted")
    return out


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    waypoints = OUT / "waypoints.csv"
    OUT.mkdir(exist_ok=True)
    shipped = data_dir("terrain")
    text = (shipped / "shackleton.toml").read_text().replace("radius_m = 10500.0", "radius_m = 4000.0")
    FLOOR.write_text(text.replace('"ldem', f'"{shipped.as_posix()}/ldem'))
    waypoints.write_text(WAYPOINTS)
    area = run("area", str(FLOOR), "--spacing", "1000", "--draws", "2")
    Image.open(area / "predict.png").save(IMAGES / "predict.webp", quality=90)
    drive = run("drive", "shackleton-thesis", "--path", str(waypoints), *DRIVE)
    shutil.copy(drive / "predict.png", IMAGES / "predict-drive.png")
    shutil.copy(drive / "predict-compare.png", IMAGES / "predict-exposures.png")
