"""Maps as other programs write them: units, scales, voids, masks, longitudes; and what no ground of a body has."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import tifffile
from map_helpers import PDS3

from startrack.cli.main import main
from startrack.core.files import data_dir
from startrack.core.types import BadInput
from startrack.terrain import (
    EQUIRECTANGULAR,
    Grid,
    Projection,
    import_maps,
    load_terrain,
    map_of_array,
    read_map,
    write_map,
)
from startrack.terrain.maps.heights import (
    FOOT_M,
    GROUNDS,
    SURVEY_FOOT_M,
    Mark,
    find_marks,
    highest_step_m,
    metres_of,
)
from startrack.terrain.maps.reading import place_on

pytestmark = pytest.mark.usefixtures("own_cache")
SPHERES = {"moon": "+proj=longlat +R=1737400 +no_defs", "earth": "EPSG:4326"}
POLAR, UTM = "+proj=stere +lat_0=-90 +lon_0=0 +k_0=1 +R=1737400 +units=m", "EPSG:32610"
SOUTH, KEPLER, HELENS = (-89.7, 130.0), (8.12, -38.01), (46.19, -122.19)
POSTS = 41, 51
HOLE = np.s_[3:9, 30:45]


def ground(x: Any, y: Any, low_m: float) -> np.ndarray:
    """Hills of 700 m with bumps, on a grid of rows and columns."""
    return low_m + 700.0 * np.sin(np.asarray(x) / 9.0) * np.cos(np.asarray(y) / 7.0) + 40.0 * np.sin(x + 2.0 * y)


class Case:
    """A map file in `folder`, of a reference system about a place (latitude, longitude), and its true heights."""

    def __init__(self, folder: Path, crs: str, place: tuple[float, float], post: float, turn: float = 0.0) -> None:
        self.folder, self.crs, self.post, self.place = folder, pyproj.CRS(crs), post, place
        horizontal = self.crs.sub_crs_list[0] if self.crs.is_compound else self.crs
        self.body = "moon" if horizontal.ellipsoid.semi_major_metre < 2e6 else "earth"
        to_map = pyproj.Transformer.from_crs(SPHERES[self.body], horizontal, always_xy=True)
        x, y = to_map.transform(place[1], place[0])
        self.at = np.array([17.3, 24.6])  # row and column of the place
        self.corner = x + turn - post * (self.at[1] + 0.5), y + post * (self.at[0] + 0.5)
        rows, columns = np.mgrid[: POSTS[0], : POSTS[1]]
        self.heights_m = ground(columns, rows, -1500.0 if self.body == "moon" else 1200.0)

    def write(self, values: np.ndarray, name: str = "a.tif", alpha: int | None = None, **facts: Any) -> Path:
        """Write the file; `facts` are rasterio's, of the band or of the file."""
        own = {key: facts.pop(key) for key in ("units", "scales", "offsets") if key in facts}
        mask = facts.pop("mask", None)
        path = self.folder / name
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=mask == "internal"), rasterio.open(
            path, "w", driver=facts.pop("driver", "GTiff"), height=POSTS[0], width=POSTS[1], crs=self.crs.to_wkt(),
            count=1 if alpha is None else 2, dtype=values.dtype,
            transform=rasterio.Affine(self.post, 0.0, self.corner[0], 0.0, -self.post, self.corner[1]), **facts,
        ) as file:  # fmt: skip
            file.write(values, 1)
            inside = np.ones(POSTS, dtype=bool)
            inside[HOLE] = False
            if alpha is not None:
                file.write((alpha * inside).astype(values.dtype), 2)
                file.colorinterp = [rasterio.enums.ColorInterp.gray, rasterio.enums.ColorInterp.alpha]
            if mask is not None:
                file.write_mask(inside)
            for key, value in own.items():
                setattr(file, key, (value,) * file.count)
        return path

    def check(self, path: Path, rounding_m: float = 0.01, voids: bool = False, **own: Any) -> tuple[str, ...]:
        """Assert that the file is read as what it is; the notes of its reader."""
        read = read_map(path, near=(np.radians(self.place[0]), np.radians(self.place[1])), body=self.body, **own)
        true = self.heights_m.copy()
        if voids:
            true[HOLE] = np.nan
        assert np.array_equal(np.isnan(read.heights_m), np.isnan(true))
        assert np.nanmax(np.abs(read.heights_m - true)) < rounding_m
        at = read.row_column(np.radians(self.place[0]), np.radians(self.place[1]))
        assert at == pytest.approx(self.at, abs=2e-3)
        return read.notes


UNITS = {
    "m": 1.0, "METERS": 1.0, "Metre": 1.0, "km": 1000.0, "KILOMETER": 1000.0, "kilometres": 1000.0, "dm": 0.1,
    "centimetres": 0.01, "cm": 0.01, "mm": 0.001, "millimeter": 0.001, "ft": 0.3048, "feet": 0.3048,
    "International foot": 0.3048, "foot_intl": None, "us-ft": 1200 / 3937, "US survey foot": 1200 / 3937,
    "Foot_US": 1200 / 3937, "ftUS": 1200 / 3937, "US Survey Feet": 1200 / 3937, "yard": 0.9144, "<KM>": 1000.0,
    "parsec": None, "hPa": None, "ms": None,
}  # fmt: skip


def test_units_are_known_by_their_names_or_not_at_all():
    assert {unit: metres_of(unit) for unit in UNITS} == pytest.approx(UNITS)
    assert pytest.approx(1200 / 3937, rel=1e-15) == SURVEY_FOOT_M
    assert FOOT_M == 0.3048


WAYS = [
    {}, {"compress": "lzw"}, {"compress": "deflate", "predictor": 3, "dtype": "float32"}, {"BIGTIFF": "YES"},
    {"compress": "deflate", "tiled": True, "blockxsize": 32, "blockysize": 32}, {"driver": "PDS4", "name": "a.xml"},
]  # fmt: skip


@pytest.mark.parametrize("way", WAYS, ids=str)
@pytest.mark.parametrize(("unit", "metres"), [("ft", 0.3048), ("km", 1000.0), ("cm", 0.01)])
def test_a_stated_unit_holds_whatever_the_file_is_like(tmp_path, way, unit, metres):
    """Unit and scale multiply: height = unit (offset + scale value)."""
    case, facts = Case(tmp_path, POLAR, SOUTH, 60.0), dict(way)
    values = case.heights_m / metres
    if facts.pop("dtype", "float32") == "float32":
        case.check(case.write(values.astype(np.float32), units=unit, **facts))
    if "predictor" not in way and "driver" not in way:
        scale, offset = 0.1 / metres, -3000.0 / metres
        steps = np.rint((values - offset) / scale).astype(np.int32)
        path = case.write(steps, "steps.tif", units=unit, scales=scale, offsets=offset, **facts)
        case.check(path, 0.06)


def with_keys(path: Path, more: list[tuple[int, int, int, int]], revision: int = 0) -> None:
    """Write the GeoTIFF at `path` again by another program, with more keys."""
    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        values, keys = page.asarray(), page.tags[34735].value
        kept = [t for t in page.tags if t.code in (33550, 33922, 34736, 34737, 42112)]
        extra = [(t.code, t.dtype, t.count, t.value, True) for t in kept]
    entries = sorted([*(keys[k : k + 4] for k in range(4, len(keys), 4)), *more])
    directory = (1, 1, revision, len(entries), *(number for entry in entries for number in entry))
    extra.append((34735, "H", len(directory), directory, True))
    tifffile.imwrite(path, values, extratags=extra, metadata=None)


@pytest.mark.parametrize("revision", [0, 1])
@pytest.mark.parametrize(("code", "metres"), [(9001, 1.0), (9002, 0.3048), (9003, 1200 / 3937), (9036, 1000.0)])
def test_the_vertical_unit_of_geotiff_keys_multiplies_the_scale(tmp_path, code, metres, revision):
    case = Case(tmp_path, UTM, HELENS, 60.0)
    path = case.write(np.rint(case.heights_m / metres / 0.01).astype(np.int32), scales=0.01)
    with_keys(path, [(4099, 0, 1, code)], revision)
    case.check(path, 0.006 * metres)


def test_units_of_a_compound_reference_system_hold(tmp_path):
    for code, metres in ((8228, 0.3048), (6360, 1200 / 3937)):
        case = Case(tmp_path, f"EPSG:32610+{code}", HELENS, 60.0)
        case.check(case.write((case.heights_m / metres).astype(np.float32)))
    path = case.write((case.heights_m / metres).astype(np.float32), units="km")
    with pytest.raises(BadInput, match=r"different units of heights \('km', 'US survey foot'\).*--scale"):
        read_map(path)
    case.check(path, scale=metres)


@pytest.mark.parametrize(("unit", "metres"), [("KILOMETER", 1000.0), ("METER", 1.0), ('"FEET"', 0.3048)])
def test_the_unit_of_a_pds3_label_is_read(tmp_path, unit, metres):
    """Radii in a unit that GDAL does not tell."""
    heights = ground(*np.mgrid[:61, :61], -1500.0)
    (tmp_path / "HILL.IMG").write_bytes((heights / metres / 0.5).astype("<f4").tobytes())
    label = PDS3.format(body="MOON", radius="1737.4").replace("UNIT = METER", f"UNIT = {unit}")
    label = label.replace("LSB_INTEGER", "PC_REAL").replace("SAMPLE_BITS = 16", "SAMPLE_BITS = 32")
    (tmp_path / "HILL.LBL").write_text(label.replace("1737400.", f"{1_737_400 / metres}"))
    assert np.abs(read_map(tmp_path / "HILL.LBL").heights_m - heights).max() < 0.01
    (tmp_path / "HILL.LBL").write_text(label.replace(f"UNIT = {unit}", "UNIT = PARSEC"))
    with pytest.raises(BadInput, match=r"unit of heights, 'PARSEC', is not known.*--scale and --offset"):
        read_map(tmp_path / "HILL.LBL", scale=1.0)


def test_a_flag_takes_precedence_over_the_file(tmp_path):
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    path = case.write((case.heights_m / 2.0 + 100.0).astype(np.float32), units="furlong", offsets=7.0)
    case.check(path, scale=2.0, offset_m=-200.0)
    with pytest.raises(BadInput, match="'furlong'"):
        read_map(path, scale=2.0)  # the offset is in a unit that is not known


@pytest.mark.parametrize(
    ("unit_m", "centre_m", "cause"),
    [(1000.0, 0.0, "are they kilometres"), (1000.0, 1_737_400.0, "from the centre of the Moon"), (0.01, 0.0, "cent")],
)
def test_the_unit_of_a_map_of_the_moon_that_states_none_is_named(tmp_path, unit_m, centre_m, cause):
    """And what the message advises reads the map rightly."""
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    for name, facts, values in (
        ("a.tif", {}, lambda v: v),
        ("b.tif", {"offsets": 10.0, "scales": 2.0}, lambda v: v / 2 - 5),
    ):
        path = case.write(values((case.heights_m + centre_m) / unit_m).astype(np.float64), name, **facts)
        with pytest.raises(BadInput, match=cause) as refusal:
            read_map(path)
        advice = dict(re.findall(r"(scale|offset_m) = (-?[\d.]+)", str(refusal.value)))
        case.check(path, **{key: float(value) for key, value in advice.items()})


def test_what_no_ground_has_is_refused_and_may_be_accepted(tmp_path, capsys):
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    flat = np.float32(0.005) * case.heights_m.astype(np.float32)
    words = ["terrain", "import", str(case.write(flat)), "--latitude", "-89.7", "--longitude", "130", "--radius", "300"]
    words += ["-o", str(tmp_path / "t.toml")]
    assert main(words) == 4
    assert "flatter than ground is" in capsys.readouterr().err
    compare = ["--compare", str(case.write(flat + np.float32(1.0), "finer.tif"))]
    assert main([*words, *compare, "--unusual-heights"]) == 0
    assert np.abs(load_terrain(tmp_path / "t.toml").maps[0].heights_m - flat).max() < 0.01
    steep = case.heights_m.astype(np.float32)
    steep[20, 20:22] = 1234.5, 4321.0
    with pytest.raises(BadInput, match=r"60 m apart, differ by up to .* is one of these a value for voids"):
        read_map(case.write(steep))
    steep[20, 20:22] = 12_345.0
    with pytest.raises(
        BadInput, match=r"heights from .* to 12345 m .*is 12345, the value of 2 posts, that for voids\?"
    ):
        read_map(case.write(steep))
    level = (case.heights_m + 15_000.0).astype(np.float32)
    with pytest.raises(BadInput, match=r"are they feet\?.*from another level.*--offset"):
        read_map(case.write(level))
    case.check(case.write(level), offset_m=-15_000.0)


def test_the_file_of_an_import_loads_though_its_crop_is_flat(tmp_path):
    """The whole map has hills; a small crop of it has none."""
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    case.heights_m[7:28, 13:37] = -1500.0 + 0.1 * case.heights_m[7:28, 13:37] / 700.0
    path = case.write(case.heights_m.astype(np.float32))
    place = {"latitude_rad": np.radians(SOUTH[0]), "longitude_rad": np.radians(SOUTH[1])}
    import_maps([path], tmp_path / "t.toml", half_m=[300.0], radius_m=150.0, **place)
    assert "unusual_heights = true" in (tmp_path / "t.toml").read_text()
    assert np.ptp(load_terrain(tmp_path / "t.toml").maps[0].heights_m) < 10.0


VOIDS = [-9999.0, -32_768.0, -32_767.0, 9999.0, 12_000.0, -6_000.0, -3.4028234663852886e38]


@pytest.mark.parametrize("void", VOIDS)
@pytest.mark.parametrize(("crs", "place"), [(POLAR, SOUTH), (UTM, HELENS)])
def test_a_void_that_no_tag_states_is_named(tmp_path, crs, place, void):
    case = Case(tmp_path, crs, place, 60.0)
    values = case.heights_m.astype(np.float32)
    values[HOLE] = void
    for stated in (None, -1.0):  # a wrong one does not help
        (note,) = case.check(case.write(values, nodata=stated), voids=True)
        assert note.startswith(f"90 posts of value {void:g} are taken as voids")
    assert case.check(case.write(values, nodata=void), voids=True) == ()


def marks_of(heights: np.ndarray, post_m: float = 10.0, body: str = "earth") -> tuple[Mark, ...]:
    """Of values that are heights."""
    return find_marks(heights, np.ones(heights.shape, dtype=bool), (1.0, 0.0), post_m, GROUNDS[body])


def test_ground_is_never_taken_for_a_void():
    """A sea, a clipped valley, a flat floor below a wall, a summit; whole numbers and parts."""
    x, y = np.mgrid[:80, :90]
    hills = ground(x, y, 300.0)
    sea, floor = np.maximum(hills, 0.0), np.maximum(hills, -100.0)
    bowl = np.clip(40.0 * (np.hypot(x - 40, y - 45) - 15.0), 0.0, 700.0)
    for heights in (hills, sea, floor, np.rint(sea), np.rint(hills / 20), bowl, -bowl, np.rint(bowl)):
        assert marks_of(heights) == ()


@pytest.mark.parametrize(
    ("flat_m", "around_m", "post_m", "body"),
    [
        (-1500.0, -200.0, 20.0, "moon"), (65.0, 30.0, 1.0, "earth"), (1650.0, 1250.0, 30.0, "earth"),
        (1200.0, 1300.0, 5.0, "earth"),
    ],
    ids=["crater", "roof", "mesa", "lake"],
)  # fmt: skip
def test_flat_ground_behind_a_sharp_edge_is_ground(flat_m, around_m, post_m, body):
    """Steeper than any other ground of the map, yet not steeper than ground can be."""
    x, y = np.mgrid[:80, :90]
    inside = np.hypot(x - 40, y - 45) < 20
    heights = np.where(inside, flat_m, around_m + np.sin(x + 2.0 * y))
    assert marks_of(heights, post_m, body) == ()
    wall_m = highest_step_m(post_m) + 10.0
    (mark,) = marks_of(np.where(inside, around_m - wall_m, heights), post_m, body)
    assert mark == (around_m - wall_m, np.count_nonzero(inside), True)


def test_posts_of_0_m_under_walls_are_ground_with_a_warning(tmp_path):
    """A sea below a cliff looks as voids that are filled with 0 do."""
    case = Case(tmp_path, UTM, HELENS, 60.0)
    values = case.heights_m.astype(np.float32)
    values[HOLE] = 0.0
    path = case.write(values)
    read = read_map(path)
    assert np.array_equal(read.heights_m, values)
    (note,) = read.notes
    assert note.startswith("90 posts of value 0 are taken as ground, though most steps onto them are steeper")
    assert read_map(path, unusual_heights=True).notes == ()
    assert case.check(case.write(values, nodata=0.0), voids=True) == ()
    x, y = np.mgrid[:80, :90]
    (mark,) = marks_of(np.where(y < 40, 0.0, 60.0 + np.sin(x + 2.0 * y)))
    assert mark == (0.0, 3200, False)


def test_heights_from_the_centre_are_no_voids(tmp_path):
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    case.heights_m[HOLE] = -2500.0
    assert case.check(case.write(case.heights_m + 1_737_400.0)) == ()


@pytest.mark.parametrize(
    "facts",
    [
        {"mask": "internal"}, {"mask": "beside"}, {"mask": "internal", "compress": "deflate", "tiled": True,
        "blockxsize": 16, "blockysize": 16}, {"alpha": 1}, {"alpha": 255}, {"mask": "internal", "nodata": -9999.0},
    ],
    ids=str,
)  # fmt: skip
def test_posts_under_a_mask_are_voids(tmp_path, facts):
    for k, (crs, place) in enumerate(((POLAR, SOUTH), (UTM, HELENS))):
        case = Case(tmp_path, crs, place, 60.0)
        values = case.heights_m.astype(np.float32)
        values[HOLE] = 0.0 if k else values[HOLE] + 1.0  # also where the values look like ground
        path = case.write(values, f"{k}.tif", **facts)
        assert Path(f"{path}.msk").exists() == (facts.get("mask") == "beside")
        assert case.check(path, voids=True) == ()


def test_other_bands_are_named(tmp_path):
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    path = case.write(case.heights_m.astype(np.float32), alpha=1)
    with rasterio.open(path, "r+") as file:
        file.colorinterp = [rasterio.enums.ColorInterp.gray, rasterio.enums.ColorInterp.undefined]
        file.descriptions = "height", "slope"
    (note,) = case.check(path)
    assert "the first of its 2 bands is taken as the heights; not read: 2 (slope)" in note


LONGLAT, EQC = "+proj=longlat +R=1737400 +no_defs", "+proj=eqc +R=1737400"
TURN_M = 2 * np.pi * 1_737_400.0
TURNED = [
    (LONGLAT, 0.002, 360.0), (LONGLAT, 0.002, 0.0), ("+proj=longlat +R=1737400 +pm=180", 0.002, 0.0),
    (EQC, 60.0, TURN_M),
    (f"{EQC} +lat_ts=30", 60.0, TURN_M * np.cos(np.radians(30))), (f"{EQC} +lon_0=180", 60.0, 0.0),
    (f"{EQC} +lon_0=180 +lat_0=5 +x_0=7000 +y_0=-90", 60.0, TURN_M), ("EPSG:4326", 0.0005, 360.0),
    ("EPSG:4326", 0.0005, 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("crs", "post", "turn"), TURNED)
@pytest.mark.parametrize("longitude", [-38.01, 321.99, 179.9999, -0.01])
def test_longitudes_count_from_any_meridian(tmp_path, crs, post, turn, longitude):
    case = Case(tmp_path, crs, (KEPLER[0], longitude), post)
    wrapped = (longitude + 180.0) % 360.0 - 180.0
    if turn and wrapped < 0:  # as in files of 0 to 360 degrees
        own = Case(tmp_path, crs, (KEPLER[0], wrapped), post)
        case.corner = own.corner[0] + turn, own.corner[1]
    path = case.write(case.heights_m.astype(np.float32))
    case.check(path)
    if longitude < 0 and case.body == "moon":  # and the crop that import writes
        write_map(tmp_path / "crop.tif", read_map(path))
        case.check(tmp_path / "crop.tif", 0.02)


LENGTHS = [
    (f"{EQC} +units=km +lon_0=180 +x_0=3000", KEPLER, 0.06),
    ("+proj=stere +lat_0=8 +lon_0=-38 +k_0=0.9 +x_0=1000 +y_0=500 +R=1737400 +units=us-ft", KEPLER, 200.0),
    ("+proj=ortho +lat_0=8 +lon_0=-38 +R=1737400 +to_meter=0.3048", KEPLER, 200.0),
    (POLAR.replace("units=m", "units=km"), SOUTH, 0.06), ("+proj=stere +lat_0=-90 +lat_ts=-75 +R=1737400", SOUTH, 60.0),
    ("+proj=stere +lat_0=90 +lon_0=30 +R=1737400 +units=km", (88.2, -40.0), 0.06),
    ("+proj=utm +zone=10 +datum=WGS84 +units=us-ft", HELENS, 200.0), ("EPSG:3031", (-78.0, 166.0), 60.0),
    ("+proj=utm +zone=10 +datum=WGS84 +units=km", HELENS, 0.06),
]  # fmt: skip


@pytest.mark.parametrize(("crs", "place", "post"), LENGTHS)
def test_projections_count_in_any_length(tmp_path, crs, place, post):
    case = Case(tmp_path, crs, place, post)
    path = case.write(case.heights_m.astype(np.float32))
    case.check(path)
    write_map(tmp_path / "crop.tif", read_map(path))
    case.check(tmp_path / "crop.tif", 0.02)


def test_axes_and_meridians_that_are_not_known_are_refused():
    heights = np.zeros((3, 3), np.float32)
    for text, named in (
        ("+proj=longlat +R=1737400 +axis=wnu", "to the west"), ("+proj=merc +R=1737400", "gdalwarp"),
        ('ENGCRS["a",EDATUM["b"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]', "not known"),
    ):  # fmt: skip
        with pytest.raises(BadInput, match=named):
            place_on(pyproj.CRS(text), heights, (0.0, 0.0), (1.0, -1.0), None)


def test_an_array_becomes_a_terrain(tmp_path, capsys):
    """Its first row is the northern one, columns go east, its middle stands at the origin."""
    rows, columns = np.mgrid[:41, :51]
    heights = ground(columns, rows, -1500.0)
    heights[2, 3] = np.nan
    np.save(tmp_path / "h.npy", heights)
    words = ["terrain", "import", str(tmp_path / "h.npy"), "-o", str(tmp_path / "t.toml"), "--latitude", "8.12"]
    words += ["--longitude", "-38.01", "--radius", "300"]
    assert main(words) == 4
    assert "how far apart its posts are: give terrain import --post M" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*words, "--corner", "0", "0"])
    assert main([*words, "--post", "60"]) == 0
    terrain = load_terrain(tmp_path / "t.toml")
    for east, north in ((0.0, 0.0), (120.0, 0.0), (0.0, 180.0), (-60.0, -240.0)):
        true = heights[20 - round(north / 60), 25 + round(east / 60)]
        assert terrain.ground_m(np.array([[east, north]]))[0] == pytest.approx(true, abs=0.2)  # curvature: 0.03 m
    read = terrain.maps[0]
    assert np.argwhere(np.isnan(read.heights_m)).tolist() == [[2, 3]]


@pytest.mark.parametrize(("crs", "place", "post"), [
    (POLAR, SOUTH, 60.0), (UTM, HELENS, 60.0), ("+proj=eqc +R=1737400 +lon_0=180 +units=km", KEPLER, 0.06),
    (LONGLAT, KEPLER, 0.002),
])  # fmt: skip
def test_an_array_in_a_reference_system_is_a_map(tmp_path, crs, place, post):
    case = Case(tmp_path, crs, place, post)
    at = {"latitude_rad": np.radians(place[0]), "longitude_rad": np.radians(place[1])}
    corner = case.corner[0] + 0.5 * post, case.corner[1] - 0.5 * post
    placed = map_of_array(case.heights_m, Grid(post=post, crs=crs, corner=corner), **at)
    assert placed.row_column(*at.values()) == pytest.approx(case.at, abs=1e-3)
    middle = map_of_array(case.heights_m, Grid(post=post, crs=crs), **at)
    assert middle.row_column(*at.values()) == pytest.approx([20.0, 25.0], abs=1e-3)
    assert middle.projection.body == case.body
    with pytest.raises(BadInput, match="whole numbers and no scale"):
        map_of_array(case.heights_m.astype(int), Grid(post=post, crs=crs), **at)
    for wrong, named in ((np.zeros(5), "rows and columns"), (np.full((9, 9), np.nan), "no post has a height")):
        with pytest.raises(BadInput, match=named):
            map_of_array(wrong, Grid(post=post), **at)
    with pytest.raises(BadInput, match="PROJ knows no such reference system"):
        map_of_array(case.heights_m, Grid(post=post, crs="EPSG:no"), **at)


def test_files_of_other_kinds_are_named(tmp_path):
    for name, named in (
        ("a.npz", "an archive of arrays"), ("a.toml", "a terrain file with -t"), ("a.vrt", "one file"),
        ("a.zip", "archive"),
    ):  # fmt: skip
        (tmp_path / name).write_bytes(b"PK\3\4")
        with pytest.raises(BadInput, match=f"{name}: .*{named}"):
            read_map(tmp_path / name)
    np.save(tmp_path / "o.npy", np.array([{}]), allow_pickle=True)
    at = {"latitude_rad": 0.0, "longitude_rad": 0.0, "half_m": [1e4], "radius_m": 100.0}
    with pytest.raises(BadInput, match="not an array that numpy reads"):
        import_maps([tmp_path / "o.npy"], tmp_path / "t.toml", grid=Grid(post=10.0), **at)


def test_shipped_maps_need_no_rasterio(tmp_path, monkeypatch):
    by_rasterio = {}
    for path in data_dir("terrain").glob("*.tif"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
        by_rasterio[path] = read_map(tmp_path / path.name, scale=None)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    monkeypatch.setitem(sys.modules, "pyproj", None)
    for path, other in by_rasterio.items():
        own = read_map(path)
        assert np.array_equal(own.heights_m, other.heights_m)
        rows, columns = own.heights_m.shape
        at = own.projection.latlon_from_xy(*own.xy(np.array([[0.0, 0.0], [rows - 1.0, columns - 1.0]])))
        assert other.row_column(*at) == pytest.approx(np.array([[0.0, 0.0], [rows - 1, columns - 1]]), abs=1e-6)


def test_other_maps_need_the_extra_dem(tmp_path, monkeypatch):
    case = Case(tmp_path, POLAR, SOUTH, 60.0)
    path = case.write(case.heights_m.astype(np.float32))
    raster = read_map(path)
    for module in ("maps.reading", "maps.writing"):
        monkeypatch.setattr(f"startrack.terrain.{module}.find_spec", lambda name: None)
    for use in (lambda: read_map(path), lambda: write_map(tmp_path / "b.tif", raster)):
        with pytest.raises(BadInput, match=r"pip install '\.\[dem\]'"):
            use()
    at = {"latitude_rad": 0.1, "longitude_rad": 0.0}
    assert map_of_array(case.heights_m, Grid(post=10.0), **at).post_m == 10.0


def test_a_projection_turned_to_its_map_has_the_same_coordinates():
    one = Projection(kind=EQUIRECTANGULAR, longitude_rad=0.4, scale=0.9, false_x_m=5000.0)
    x = one.xy_from_latlon(0.1, 0.7)[0]
    assert one.centred_at(3e6).xy_from_latlon(0.1, 0.7)[0] == pytest.approx(x, abs=1e-6)
    turn = 2 * np.pi * one.radius_m * 0.9
    assert one.centred_at(turn).xy_from_latlon(0.1, 0.7)[0] == pytest.approx(x + turn, abs=1e-6)
