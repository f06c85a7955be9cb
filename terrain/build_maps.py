"""Make the shipped height maps from the published ones: python terrain/build_maps.py FOLDER [--check]

FOLDER holds the original files (names, sources and sums: README.md here). Nothing is resampled: posts keep their
places and, but for rounding (far maps, site01), their values.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from startrack.terrain import EQUIRECTANGULAR, STEREOGRAPHIC, Projection, Raster, read_map, write_map
from startrack.terrain.maps.reading import read_shipped

HERE = Path(__file__).parent
SUMS = {
    "ldem75s_cap_240m_rg16.png": "3b72f67c0a35832604eb79583709dd4ad46ebf7765282762ce0c410d88b6fb8f",
    "ldem75s_far_1787m_rg16.png": "15225105c62d1f4feeb45bdf4bcdadcdb0e9801b021707f0f6116b50423d0ed8",
    "kepler_lola_48m.tif": "3cf9d369650bfd1d353272c1f7a4b7f1f2fad788b266084d840aee3ef383b2b2",
    "LDEM_4.IMG": "972d66d7f330abca62abc21aae270661516c00dd1a881ec102b94df9563656b5",
    "site01_connecting_ridge_10m_rg16.png": "e366140ae324cc2122f69f5c591e568c36713d583bc2cf3c744c9ebd8becda12",
}
KEPLER = np.radians(8.12), np.radians(-38.01)
FAR_KEPLER_M = 300_000.0
SITE01_CENTRE_M = (-11_000.0, -12_000.0)  # x, y
SITE01_MIDDLE = slice(350, 1250)  # 9 km: enough to measure the errors of the 240 m map
MIDDLE = slice(288, 1248)  # 230 km about the pole: every crater of the TOML files here, and 25 km around the last


def main() -> int:
    """Write the maps, or compare what is here with what the sources give."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if the maps here differ")
    args = parser.parse_args()
    for name, wanted in SUMS.items():
        if hashlib.sha256((args.folder / name).read_bytes()).hexdigest() != wanted:
            sys.exit(f"{args.folder / name} is not the file that README.md names")
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) if args.check else HERE
        for name in make(args.folder, out):
            print(f"{name}: {(out / name).stat().st_size} bytes")
            if args.check and not is_same(read_shipped(out / name), read_shipped(HERE / name)):
                sys.exit(f"{name} is not what the sources give")
    return 0


def is_same(one: Raster, other: Raster) -> bool:
    """Whether two maps have the same heights at the same places (to the rounding of the numbers in their files)."""
    places = [(m.x0_m, m.y0_m, m.dx_m, m.dy_m) for m in (one, other)]
    numbers = [
        (p.kind, p.latitude_rad, p.longitude_rad, p.scale, p.scale_y, p.false_x_m, p.false_y_m, p.radius_m)
        for p in (one.projection, other.projection)
    ]
    return np.array_equal(one.heights_m, other.heights_m) and all(
        np.allclose(*pair, rtol=1e-12, atol=1e-9) for pair in (places, numbers)
    )


def make(folder: Path, out: Path) -> list[str]:
    """Write all maps into a folder; their names."""
    polar(folder / "ldem75s_cap_240m_rg16.png", out / "ldem75s-240m.tif", 240.0, -5499.0, 7025.0, MIDDLE)
    polar(folder / "ldem75s_far_1787m_rg16.png", out / "ldem75s-1787m.tif", 1786.875, -6829.5, 7025.0)
    polar(folder / "site01_connecting_ridge_10m_rg16.png", out / "site01-10m.tif", 10.0, -523.2, 1959.5, SITE01_MIDDLE,
          centre_m=SITE01_CENTRE_M, step_m=0.25)  # fmt: skip
    write_map(out / "kepler-48m.tif", read_map(folder / "kepler_lola_48m.tif", scale=0.5), step_m=0.5, offset_m=-4000.0)
    write_map(out / "kepler-far.tif", global_map(folder / "LDEM_4.IMG").crop_around(*KEPLER, FAR_KEPLER_M), step_m=0.5,
              offset_m=-10000.0)  # fmt: skip
    return ["ldem75s-240m.tif", "ldem75s-1787m.tif", "site01-10m.tif", "kepler-48m.tif", "kepler-far.tif"]


def polar(
    source: Path, to: Path, post_m: float, low_m: float, high_m: float, cut: slice = slice(None), *,
    centre_m: tuple[float, float] = (0.0, 0.0), step_m: float | None = None,
) -> None:  # fmt: skip
    """A south polar map of a picture whose red and green are the two bytes of the height.

    centre_m: x, y of the picture's centre. step_m: to which heights are rounded; None keeps those of the picture.
    """
    picture = cv2.imread(str(source), cv2.IMREAD_UNCHANGED)
    steps = picture[:, :, 2].astype(np.int64) * 256 + picture[:, :, 1]
    own_step_m = (high_m - low_m) / 65_535
    corner = (steps.shape[0] - 1) / 2 * post_m
    heights = Raster(
        heights_m=(low_m + steps * own_step_m).astype(np.float32),
        projection=Projection(kind=STEREOGRAPHIC, latitude_rad=-np.pi / 2),
        x0_m=centre_m[0] - corner, y0_m=centre_m[1] + corner, dx_m=post_m, dy_m=-post_m,
    )  # fmt: skip
    write_map(to, heights.crop(cut, cut), step_m=step_m or own_step_m, offset_m=low_m)


def global_map(source: Path) -> Raster:
    """LDEM_4: 4 posts a degree, row 0 at the north, column 0 at 0 degrees east, half metres."""
    values = np.fromfile(source, dtype="<i2").reshape(720, 1440)
    degrees = 180 / np.pi / 1_737_400.0
    frame = Projection(kind=EQUIRECTANGULAR, scale=degrees, scale_y=degrees)
    turned = np.roll(values, 720, axis=1)  # from -180 to 180 degrees
    return Raster(
        heights_m=(0.5 * turned).astype(np.float32), projection=frame, x0_m=-179.875, y0_m=89.875, dx_m=0.25, dy_m=-0.25
    )


if __name__ == "__main__":
    sys.exit(main())
