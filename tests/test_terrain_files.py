"""Terrain files with height maps: reading, refusals, and the command that makes and shows them."""

from __future__ import annotations

import json
import re
import socket
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tomli_w
from hazard_helpers import catalog_to, small_camera
from map_helpers import PDS3, polar_stereographic

from startrack.camera import load_camera, save_camera
from startrack.cli.main import main
from startrack.core.files import data_dir, file_stem
from startrack.core.types import BadInput
from startrack.exposure import write_exposure, write_sidecar
from startrack.rendering import Series, render
from startrack.terrain import (
    EQUIRECTANGULAR,
    HeightMap,
    Projection,
    Raster,
    files_of_terrain,
    load_terrain,
    read_map,
    require_place,
    terrain_from_dict,
    write_map,
)
from startrack.terrain.imports.import_map import MEASURED_PER_ESTIMATE
from startrack.terrain.maps.projections import ORTHOGRAPHIC, projection_of

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.usefixtures("own_cache")


def hill(posts: int = 61, post_m: float = 100.0, projection: Projection | None = None) -> Raster:
    """A bowl with a rim, 6 km wide, about the projection's centre."""
    line = (np.arange(posts) - (posts - 1) / 2) * post_m
    r = np.hypot(line[:, None], line)
    return Raster(
        heights_m=(800 * np.exp(-((r - 2000) ** 2) / 500**2)).astype(np.float32),
        projection=projection or polar_stereographic(), x0_m=line[0], y0_m=-line[0], dx_m=post_m, dy_m=-post_m,
    )  # fmt: skip


HILL = {
    "format": 1, "name": "hill", "body": "moon", "origin": {"latitude_deg": -90.0, "longitude_deg": 0.0},
    "dem": {"file": "hill.tif", "height_sigma_m": 2.0}, "search": {"radius_m": 800.0},
}  # fmt: skip


def terrain_file(folder: Path, **changes) -> Path:
    write_map(folder / "hill.tif", hill())
    d = dict(HILL)
    for name, value in changes.items():
        d[name] = {**d[name], **value} if isinstance(value, dict) and name in d else value
    path = folder / "hill.toml"
    path.write_text(tomli_w.dumps(d))
    return path


@pytest.mark.parametrize("name", ["shackleton", "haworth", "faustini", "de-gerlache", "kepler"])
def test_shipped_maps_load(name):
    terrain = load_terrain(name)
    assert terrain.name == name
    ground = terrain.ground_m(np.zeros((1, 2)))[0]
    floors = {"shackleton": -2720, "haworth": -3377, "faustini": -2707, "de-gerlache": -1115, "kepler": -2900}
    assert ground == pytest.approx(floors[name], abs=250)  # published heights of the craters' floors


def test_every_key_reaches_the_terrain(tmp_path):
    more = {"radius_m": 700.0, "max_slope_deg": 20.0, "glare_deg": [[350.0, 10.0]]}
    path = terrain_file(tmp_path, dem={"horizon_sigma_deg": 0.05}, rover={"camera_height_m": 2.5}, search=more)
    terrain = load_terrain(path)
    assert isinstance(terrain, HeightMap)
    assert terrain.camera_height_m == 2.5
    assert terrain.search_radius_m == 700.0
    assert terrain.height_sigma_m == 2.0
    assert terrain.most_slope_rad == pytest.approx(np.radians(20))
    assert terrain.glare_rad == ((pytest.approx(np.radians(350)), pytest.approx(np.radians(10))),)
    own = np.hypot(np.radians(0.05), 0)
    assert own < terrain.errors.common_sigma_rad < 3 * own
    slopes = terrain.slope_rad(np.array([[0.0, 0.0], [0.0, 690.0]]))
    assert slopes[0] < 0.01
    assert terrain.allowed(np.array([[0.0, 0.0], [2000.0, 0.0]])).tolist() == [True, False]


def test_heights_whose_error_a_file_leaves_out_are_exact_with_a_warning(tmp_path):
    cylinder = {key: HILL[key] for key in ("format", "body", "origin")} | {"name": "pit"}
    size = {"diameter_m": 9000.0, "depth_m": 1600.0}
    pit = terrain_from_dict(cylinder | {"cylinder": size | {"exact": True}})
    assert all(error.is_stated and error.sigma == 0.0 for error in pit.errors.shape)
    assert pit.errors.warnings() == load_terrain("shackleton-thesis").errors.warnings() == []
    hill = load_terrain(terrain_file(tmp_path))
    assert hill.errors.warnings() == []
    (tmp_path / "hill.toml").write_text(tomli_w.dumps({**HILL, "dem": {"file": "hill.tif"}}))
    assert ["no height_sigma_m" in line for line in load_terrain(tmp_path / "hill.toml").errors.warnings()] == [True]


REFUSED = [
    ({"dem": {"file": "none.tif"}}, "none.tif"), ({"dem": {"file": []}}, "file"), ({"dem": {"file": 3}}, "file"),
    ({"dem": {"height_sigma_m": -1.0}}, "height_sigma_m"), ({"dem": {"height_sigma_m": "big"}}, "height_sigma_m"),
    ({"search": {"radius_m": 5000.0}}, "cover"), ({"search": {"max_slope_deg": 0.0}}, "max_slope_deg"),
    ({"search": {"glare_deg": [10.0]}}, "glare_deg"), ({"body": "earth"}, "a map of the Moon"),
    ({"cylinder": {"diameter_m": 100.0, "depth_m": 10.0}}, "two grounds"),
    ({"origin": {"latitude_deg": 0.0}}, "origin is not on this map: its middle is at latitude -90.00, longitude"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "named"), REFUSED, ids=lambda v: str(v)[:40])
def test_what_cannot_be_used_is_refused_and_named(changes, named, tmp_path):
    with pytest.raises(BadInput, match=named) as caught:
        load_terrain(terrain_file(tmp_path, **changes))
    assert caught.value.reason == "bad_terrain"


def test_maps_without_position_of_other_bodies_or_with_holes_are_refused(tmp_path):
    import tifffile

    path = terrain_file(tmp_path)
    tifffile.imwrite(tmp_path / "hill.tif", np.zeros((50, 50), dtype=np.int16))
    with pytest.raises(BadInput, match="position on a body"):
        load_terrain(path)
    (tmp_path / "hill.tif").write_bytes(b"II*\x00 not a tiff")
    with pytest.raises(BadInput, match="can be read"):
        load_terrain(path)
    holed = hill()
    heights = holed.heights_m.copy()
    heights[30, 32] = np.nan
    write_map(tmp_path / "hill.tif", replace(holed, heights_m=heights))
    with pytest.raises(BadInput, match="holes"):
        load_terrain(path)
    with pytest.raises(BadInput, match="radius"):
        projection_of({"proj": "stere", "lat_0": -90, "R": 3_396_190.0})
    with pytest.raises(BadInput, match="Earth"):
        projection_of({"proj": "longlat", "datum": "WGS84"})
    for key, value in (("k_0", 1e-200), ("k_0", 1e200), ("x_0", 1e200), ("y_0", np.nan), ("lat_0", np.inf)):
        with pytest.raises(BadInput, match="impossible numbers"):
            projection_of({"proj": "stere", "lat_0": -90, "R": 1_737_400.0, key: value})


@pytest.mark.parametrize(
    "projection",
    [
        polar_stereographic(), polar_stereographic(south=False, longitude_rad=0.5),
        Projection(kind=ORTHOGRAPHIC, latitude_rad=0.1, longitude_rad=-0.6),
        Projection(kind=EQUIRECTANGULAR, longitude_rad=1.0, scale=0.9),
    ],
    ids=["south", "north", "orthographic", "equirectangular"],
)  # fmt: skip
def test_maps_survive_the_file_and_rasterio_reads_the_same(projection, tmp_path):
    written = hill(projection=projection)
    write_map(tmp_path / "a.tif", written)
    read = read_map(tmp_path / "a.tif")
    assert np.abs(read.heights_m - written.heights_m).max() < 0.02
    at = np.array([[3.0, 5.0]])
    assert np.array(read.xy(at)) == pytest.approx(np.array(written.xy(at)))
    place = written.projection.latlon_from_xy(*written.xy(at))
    assert read.row_column(*place) == pytest.approx(at, abs=1e-9)
    with rasterio.open(tmp_path / "a.tif") as file:
        values = file.read(1) * file.scales[0] + file.offsets[0]
        assert np.abs(values - read.heights_m).max() < 1e-3
        assert file.xy(3, 5) == pytest.approx([float(v[0]) for v in written.xy(at)])
        dumb = projection_of(file.crs.to_dict())
    assert dumb.xy_from_latlon(*place)[0] == pytest.approx(projection.xy_from_latlon(*place)[0], abs=1e-3)


def test_rasterio_reads_projections_that_the_tags_lack(tmp_path):
    wkt = rasterio.crs.CRS.from_proj4("+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m")
    m = hill()
    move = rasterio.transform.from_origin(m.x0_m - 50, m.y0_m + 50, 100, 100)
    with rasterio.open(
        tmp_path / "a.img", "w", driver="HFA", height=61, width=61, count=1, dtype="float32", crs=wkt, transform=move
    ) as file:  # fmt: skip
        file.write(m.heights_m, 1)
    read = read_map(tmp_path / "a.img")
    assert np.array_equal(read.heights_m, m.heights_m)
    assert (read.x0_m, read.y0_m) == (m.x0_m, m.y0_m)
    assert read.projection == m.projection


def test_a_cloud_optimised_geotiff_is_read(tmp_path):
    """Tiled, compressed, with overviews, integers with scale, offset and no-data, as published by agencies."""
    from rasterio.enums import Resampling
    from rasterio.shutil import copy

    m = hill(posts=121)
    wkt = rasterio.crs.CRS.from_proj4("+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m")
    move = rasterio.transform.from_origin(m.x0_m - 50, m.y0_m + 50, 100, 100)
    values = np.rint((m.heights_m.astype(float) + 100) / 0.5).astype(np.int16)
    values[0, :7] = -32768
    with rasterio.open(
        tmp_path / "plain.tif", "w", driver="GTiff", height=121, width=121, count=1, dtype="int16", crs=wkt,
        transform=move, nodata=-32768, tiled=True, blockxsize=64, blockysize=64,
    ) as file:  # fmt: skip
        file.write(values, 1)
        file.scales, file.offsets = (0.5,), (-100.0,)
        file.build_overviews([2, 4], Resampling.average)
    copy(tmp_path / "plain.tif", tmp_path / "cog.tif", driver="COG", compress="deflate")
    read = read_map(tmp_path / "cog.tif")
    assert np.isnan(read.heights_m[0, :7]).all()
    assert np.nanmax(np.abs(read.heights_m - m.heights_m)) < 0.26
    assert (read.x0_m, read.y0_m, read.dx_m, read.dy_m) == pytest.approx((m.x0_m, m.y0_m, 100.0, -100.0))
    assert read.projection == m.projection


VRT = """<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>EPSG:32610</SRS>
<GeoTransform>500000, 200, 0, 5000000, 0, -200</GeoTransform><VRTRasterBand dataType="Float32" band="1"><SimpleSource>
<SourceFilename>{source}</SourceFilename><SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"""
WMS = """<GDAL_WMS><Service name="TMS"><ServerUrl>{address}/${{z}}.png</ServerUrl></Service><DataWindow>
<UpperLeftX>0</UpperLeftX><UpperLeftY>9</UpperLeftY><LowerRightX>9</LowerRightX><LowerRightY>0</LowerRightY>
<SizeX>9</SizeX><SizeY>9</SizeY></DataWindow><Projection>EPSG:3857</Projection><BandsCount>1</BandsCount></GDAL_WMS>"""


@pytest.mark.parametrize(("body", "radius"), [("MOON", "1737.4"), ("MARS", "3396.19")])
def test_a_pds3_map_is_read_by_its_detached_label(body, radius, tmp_path):
    """Written by hand as the LOLA team writes them: heights in half metres above the radius that OFFSET gives."""
    pytest.importorskip("rasterio")
    m = hill()
    (tmp_path / "HILL.IMG").write_bytes(np.rint(m.heights_m / 0.5).astype("<i2").tobytes())
    label = tmp_path / "HILL.LBL"
    label.write_text(PDS3.format(body=body, radius=radius).replace("\n", "\r\n"))
    if body == "MARS":
        with pytest.raises(BadInput, match=r"HILL\.LBL|radius|Moon"):
            read_map(label)
        return
    read = read_map(label)
    assert np.abs(read.heights_m - m.heights_m).max() < 0.26
    latitude, longitude = read.projection.latlon_from_xy(*read.xy(np.array([[30.0, 30.0], [30.0, 40.0], [20.0, 30.0]])))
    assert np.degrees(latitude[0]) == pytest.approx(-90.0, abs=1e-4)
    assert np.degrees(longitude[1:]) == pytest.approx([90.0, 0.0], abs=0.3)  # east to the right, 0 degrees up
    assert (90 + np.degrees(latitude[1:])) * 30_323 == pytest.approx([1000.0, 1000.0], rel=1e-3)


def test_what_stands_beside_a_map_is_of_its_files(tmp_path):
    """A mask that appears, and the data of a detached label: the terrain is read again."""
    path = terrain_file(tmp_path)
    assert files_of_terrain(path) == (tmp_path / "hill.tif",)
    assert not np.isnan(load_terrain(path).maps[0].heights_m).any()
    mask = np.full((61, 61), 255, dtype=np.uint8)
    mask[0, :5] = 0
    facts = {"driver": "GTiff", "height": 61, "width": 61, "count": 1, "dtype": "uint8"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it has no position
        with rasterio.open(tmp_path / "hill.tif.msk", "w", **facts) as file:
            file.write(mask, 1)
            file.update_tags(INTERNAL_MASK_FLAGS_1="2")
    (tmp_path / "hill.tif.aux.xml").write_text("<PAMDataset></PAMDataset>")
    beside = [tmp_path / f"hill.tif{end}" for end in ("", ".aux.xml", ".msk")]
    assert sorted(files_of_terrain(path)) == sorted(beside)
    assert np.count_nonzero(np.isnan(load_terrain(path).maps[0].heights_m)) == 5
    (tmp_path / "hill.tif.msk").unlink()
    assert not np.isnan(load_terrain(path).maps[0].heights_m).any()
    (tmp_path / "HILL.IMG").write_bytes(np.full((61, 61), 7, dtype="<i2").tobytes())
    (tmp_path / "HILL.LBL").write_text(PDS3.format(body="MOON", radius="1737.4"))
    path.write_text(tomli_w.dumps({**HILL, "dem": {"file": "HILL.LBL", "unusual_heights": True}}))
    assert sorted(files_of_terrain(path)) == [tmp_path / "HILL.IMG", tmp_path / "HILL.LBL"]
    (tmp_path / "HILL.LBL").unlink()
    assert files_of_terrain(path) == (tmp_path / "HILL.LBL",)


def test_an_import_that_is_refused_leaves_the_former_terrain(tmp_path, capsys):
    """Also where that shows only as the crops are read again: the search area is wider than the map, or has a void."""
    write_map(tmp_path / "src.tif", hill())
    holed = hill().heights_m.copy()
    holed[28:33, 28:33] = np.nan
    write_map(tmp_path / "holed.tif", replace(hill(), heights_m=holed))
    words = ["--latitude", "-90", "--longitude", "0", "--half", "2500", "-o", str(tmp_path / "mine.toml"), "-O"]
    assert main(["terrain", "import", str(tmp_path / "src.tif"), "--radius", "500", *words]) == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for source, radius in (("src.tif", "4000"), ("holed.tif", "500")):
        assert main(["terrain", "import", str(tmp_path / source), "--radius", radius, *words]) == 4
        assert "do not cover the search area" in capsys.readouterr().err
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert main(["terrain", "import", str(tmp_path / "src.tif"), "--radius", "600", *words]) == 0
    assert load_terrain(tmp_path / "mine.toml").search_radius_m == 600.0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(before)


def test_import_show_and_build(tmp_path, capsys):
    write_map(tmp_path / "src.tif", hill())
    words = ["--latitude", "-90", "--longitude", "0", "--radius", "500", "--half", "2500"]
    made = tmp_path / "mine.toml"
    assert main(["terrain", "import", str(tmp_path / "src.tif"), "-o", str(made), *words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["format"] == "startrack.terrain/1"
    assert facts["maps"][0]["posts"] == [53, 53]
    assert 2600 <= facts["maps_end"].pop("nearest_m") <= 2700  # half of 53 posts, one post on at most
    assert facts["maps_end"].pop("nearest_azimuth_deg") % 90 in (0, 1, 89)
    assert facts["maps_end"] == {"highest_beyond_m": 800, "highest_beyond_from": "map", "missing": []}
    assert min(facts["about_s"]["horizons"], facts["about_s"]["frame"]) > 0
    assert main(["terrain", "import", str(tmp_path / "src.tif"), "-o", str(made), *words]) == 2
    assert "-O" in capsys.readouterr().err
    assert main(["terrain", "build", str(made), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["known_before"] is False
    assert facts["maps_end"]["missing"] == []
    assert set(facts["about_s"]) == {"horizons", "frame"}
    assert main(["terrain", "build", str(made), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["known_before"] is True
    assert set(facts["about_s"]) == {"frame"}  # the table is there
    assert main(["terrain", "show", str(made), "--at", "100", "0", "-D", str(tmp_path / "out"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["horizons_ready"] is True
    assert 15 < facts["horizon_min_deg"] < facts["horizon_max_deg"] < 40
    from PIL import Image

    for file in facts["files"]:
        assert np.asarray(Image.open(file)).std() > 5
    assert main(["terrain", "show", str(made), "--at", "9000", "0", "--no-plots"]) == 4
    line = capsys.readouterr().err
    assert "E 9000 m, N 0 m is 9000 m from the origin of mine: give a place within its search area, 500 m" in line
    assert "next:" not in line


def test_a_place_where_no_camera_can_stand_is_refused_with_the_cause(tmp_path):
    terrain = load_terrain(terrain_file(tmp_path, search={"max_slope_deg": 0.3}))
    line = np.linspace(0.0, 790.0, 30)
    steep = next(east for east in line if not terrain.allowed(np.array([[east, 0.0]]))[0])
    with pytest.raises(BadInput, match=r"hill: no camera can stand at .* \(a steep slope, or the wall\)"):
        require_place(terrain, float(steep), 0.0)
    with pytest.raises(BadInput, match=r"is 5000 m from the origin of hill: give a place within .* 800 m"):
        require_place(terrain, 3000.0, -4000.0)
    require_place(terrain, 0.0, 0.0)


IMPORT = ["--latitude", "-90", "--longitude", "0", "--radius", "500", "--half", "2500"]


def whole_numbers(path: Path, unit: str | None = None) -> None:
    """The hill in half metres, as a map that has lost its scale."""
    m = hill()
    wkt = rasterio.crs.CRS.from_proj4("+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m")
    move = rasterio.transform.from_origin(m.x0_m - 50, m.y0_m + 50, 100, 100)
    with rasterio.open(
        path, "w", driver="GTiff", height=61, width=61, count=1, dtype="int16", crs=wkt, transform=move
    ) as file:  # fmt: skip
        file.write(np.rint(m.heights_m / 0.5).astype(np.int16), 1)
        if unit:
            file.units = (unit,)


def test_a_map_of_the_moon_has_no_geoid(tmp_path, capsys):
    write_map(tmp_path / "src.tif", hill())
    words = ["terrain", "import", str(tmp_path / "src.tif"), "-o", str(tmp_path / "mine.toml"), *IMPORT]
    assert main([*words, "--geoid", "us_nga_egm08_25.tif"]) == 4
    assert "those of maps of the Earth" in capsys.readouterr().err
    assert not (tmp_path / "mine.toml").exists()


def test_whole_numbers_without_a_scale_are_not_taken_for_metres(tmp_path, capsys):
    whole_numbers(tmp_path / "src.tif")
    words = ["terrain", "import", str(tmp_path / "src.tif"), "-o", str(tmp_path / "mine.toml"), *IMPORT]
    assert main(words) == 4
    assert "--scale" in capsys.readouterr().err
    assert not (tmp_path / "mine.toml").exists()
    assert main([*words, "--scale", "0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["maps"][0]["highest_m"] == pytest.approx(800, abs=5)
    whole_numbers(tmp_path / "said.tif", "metre")
    assert read_map(tmp_path / "said.tif").heights_m.max() == pytest.approx(1600, abs=5)


def test_the_error_of_posts_is_estimated_from_the_map(tmp_path, capsys):
    """Known rough ground: the estimated error of a grid is that of the interpolation between its posts to a third."""
    rng = np.random.default_rng(3)
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(1025), np.fft.fftfreq(1025)))
    wave[0, 0] = np.inf
    ground = np.fft.ifft2(np.fft.fft2(rng.normal(size=wave.shape)) * wave**-1.8).real
    ground *= 300 / ground.std()
    taken = {}
    for every in (8, 32, 128):
        posts = ground[::every, ::every]
        n = len(posts)
        post_m, half = 10.0 * every, 5.0 * every * (n - 1)
        made = replace(hill(), heights_m=posts.astype(np.float32), x0_m=-half, y0_m=half, dx_m=post_m, dy_m=-post_m)
        write_map(tmp_path / f"{every}.tif", made)
        words = ["--latitude", "-90", "--longitude", "0", "--radius", "2000", "--half", "6000", "--json"]
        out = str(tmp_path / f"mine{every}.toml")
        assert main(["terrain", "import", str(tmp_path / f"{every}.tif"), "-o", out, *words]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["sigma_from"] == "map"
        assert any("hardly distinguishes" in line for line in facts["warnings"]) == (every == 128)
        half_way = every // 2
        middle = 0.5 * (posts[:, 1:] + posts[:, :-1])
        true = float(np.sqrt(np.mean((ground[::every, half_way::every][:, : n - 1] - middle) ** 2)))
        taken[every] = facts["height_sigma_m"] / MEASURED_PER_ESTIMATE / true
    assert all(0.66 < ratio < 1.5 for ratio in taken.values()), taken


def test_no_map_opens_a_network_connection(tmp_path, capfd, monkeypatch):
    """A mosaic, a map service under the name of an elevation file, and a label whose pixels are elsewhere."""
    pytest.importorskip("rasterio")
    monkeypatch.setenv("GDAL_HTTP_TIMEOUT", "1")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        files = {
            "mosaic.vrt": VRT.format(source=f"/vsicurl/{address}/a.tif"),
            "service.dem": WMS.format(address=address),
            "label.lbl": PDS3.format(body="MOON", radius="1737.4").replace("HILL.IMG", f"/vsicurl/{address}/a.img"),
        }
        for name, text in files.items():
            (tmp_path / name).write_text(text)
            with pytest.raises(BadInput, match=f"{name}: not a map that can be read"):
                read_map(tmp_path / name)
            with pytest.raises(TimeoutError):
                server.accept()
        write_map(tmp_path / "hill.tif", hill())
        (tmp_path / "hill.tif.msk").write_text(WMS.format(address=address))
        with pytest.raises(BadInput, match=r"hill\.tif: not a map that can be read"):
            read_map(tmp_path / "hill.tif")
        with pytest.raises(TimeoutError):
            server.accept()
    assert capfd.readouterr().err == ""


def test_pixels_without_their_label_are_refused_with_advice(tmp_path, capfd):
    pytest.importorskip("rasterio")
    from PIL import Image

    (tmp_path / "HILL.IMG").write_bytes(bytes(61 * 61 * 2))
    with pytest.raises(BadInput, match=r"HILL\.LBL"):
        read_map(tmp_path / "HILL.IMG")
    Image.fromarray(np.zeros((40, 40), dtype=np.uint8)).save(tmp_path / "plain.png")
    with pytest.raises(BadInput, match="position on a body"):
        read_map(tmp_path / "plain.png")
    assert capfd.readouterr().err == ""


def test_show_prints_words_and_units(tmp_path, capsys):
    path = terrain_file(tmp_path)
    assert main(["terrain", "show", str(path), "--no-plots", "--at", "100", "-50"]) == 0
    said = capsys.readouterr().out
    for words in ("90.00000 S", "within 800 m", "61 x 61 posts, 100 m apart", "2 m", "E 100 m, N -50 m", "degrees"):
        assert words in said
    assert "None" not in said
    assert not {"[", "{"} & set(said)
    assert main(["terrain", "show", "shackleton-thesis", "--no-plots"]) == 0
    assert "20000 m across and 2000 m deep" in capsys.readouterr().out


def test_the_ends_of_the_maps_and_times_are_told(tmp_path, capsys):
    """Beyond the ends, 3 km off, ground could stand 5 km high: seen from 800 m off the origin at atan(5 / 2.2)."""
    write_map(tmp_path / "src.tif", hill())
    made = str(tmp_path / "mine.toml")
    words = ["--latitude", "-90", "--longitude", "0", "--radius", "800", "--half", "3000", "--highest-beyond", "5000"]
    assert main(["terrain", "import", str(tmp_path / "src.tif"), "-o", made, *words]) == 0
    told = [capsys.readouterr().out]
    for command in (["show", "--no-plots"], ["build"]):
        assert main(["terrain", command[0], made, *command[1:]]) == 0
        told.append(capsys.readouterr().out)
    for said in told:
        (end,) = re.findall(r"ends      ([\d.]+) m from the origin.* up to 5000 m high \(highest_beyond_m\)", said)
        assert 3000 <= float(end) <= 3100  # a post more at most
        (up_to,) = re.findall(r"missing   azimuths 0 to 360: the maps end .* up to ([\d.]+) degrees high", said)
        assert float(up_to) == pytest.approx(np.degrees(np.arctan2(5000, 2200)), abs=1.0)
        assert re.search("takes     about .* for the table of horizons, once, about .* for the position", said)
    assert main(["terrain", "show", made, "--no-plots", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["maps_end"]["highest_beyond_from"] == "stated"
    assert [(one["from_deg"], one["to_deg"]) for one in facts["maps_end"]["missing"]] == [(0, 360)]
    assert set(facts["about_s"]) == {"frame"}


@pytest.mark.slow
def test_where_the_maps_end_is_told_once_for_all_frames(tmp_path, capsys):
    path = terrain_file(tmp_path, dem={"highest_beyond_m": 5000.0}, search={"radius_m": 300.0})
    camera = replace(small_camera(), size_px=(400, 400), focal_px=(127.0, 127.0), centre_px=(199.5, 199.5))
    save_camera(camera, tmp_path / "camera.toml")
    series = Series(
        camera=camera, terrain=load_terrain(path), catalog=catalog_to(5.0), seed=1, faint_v_mag=5.0,
        terrain_ref=str(path), camera_ref=str(tmp_path / "camera.toml"),
    )  # fmt: skip
    exposure, _ = render(series.scene(0)[0], rng=np.random.default_rng(1))
    images = [tmp_path / "in" / f"{name}.png" for name in "ab"]
    images[0].parent.mkdir()
    for image in images:
        write_exposure(image, exposure)
        write_sidecar(image, exposure)
    out = ["-D", str(tmp_path / "out"), "--no-plots"]
    folder = str(images[0].parent)
    for words in (["locate", *map(str, images)], ["batch", folder, "-j", "1", "-v", "-O"]):  # over results that exist
        main([*words, *out])
        heard = capsys.readouterr().err
        assert heard.count("the maps end") == 1
        assert "hill: azimuths 0 to 360 degrees: the maps end" in heard
    for name in "ab":
        record = json.loads((tmp_path / "out" / f"{name}.fix.json").read_text())
        assert sum("the maps end" in one for one in record["warnings"]) == 1  # in the results of each


def test_a_post_between_voids_counts_for_the_highest_ground(tmp_path):
    """Ground beyond the maps, and beyond voids, is taken to be no higher: it must not be taken for lower."""
    heights = hill().heights_m.copy()
    heights[5, 5], heights[4, 4:7], heights[6, 4:7], heights[5, 4], heights[5, 6] = 1234.0, *[np.nan] * 4
    path = terrain_file(tmp_path)
    write_map(tmp_path / "hill.tif", replace(hill(), heights_m=heights))
    terrain = load_terrain(path)
    assert isinstance(terrain, HeightMap)
    for one in (terrain, terrain.with_voids()):
        assert one.ground.highest_m == pytest.approx(1234.0, abs=0.3)
    assert terrain.facts()["maps_end"]["highest_beyond_m"] == 1234


def test_a_folder_that_takes_no_pictures_is_named_before_any_work(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for out in ("/proc", str(tmp_path / "file" / "below")):
        assert main(["terrain", "show", "shackleton-thesis", "-D", out]) == 2
        said = capsys.readouterr().err
        assert out in said
        assert "written to this folder" in said


def test_a_build_prints_one_line_and_a_stopped_one_leaves_its_parts_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # of this test alone: it lists the folder
    path = terrain_file(tmp_path)
    terrain = load_terrain(path)
    assert isinstance(terrain, HeightMap)

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        terrain.prepare(interrupt)
    table = terrain.table_path
    parts = list(table.parent.iterdir())
    assert parts and set(parts) == set(table.parent.glob(f"{table.stem}-*.table"))
    table.with_suffix(".lock").touch()  # left by one that was killed
    assert main(["terrain", "build", str(path), "--json"]) == 0
    heard = capsys.readouterr()
    assert json.loads(heard.out)["known_before"] is False
    assert len(heard.err.splitlines()) == 1
    assert "hill: computed now, once" in heard.err
    assert list(table.parent.iterdir()) == [table]
    assert main(["terrain", "build", str(path), "-q", "--force"]) == 0
    assert capsys.readouterr().err == ""


def test_every_shipped_map_is_named_with_its_source():
    readme = (data_dir("terrain") / "README.md").read_text()
    for path in data_dir("terrain").glob("*.t*"):
        assert path.name in readme


def damaged_maps(folder: Path) -> list[Path]:
    """Maps with flipped bytes, cut ends, and tags that hold no usable numbers, of three encodings."""
    import tifffile

    shutil = pytest.importorskip("rasterio.shutil")  # LZW is read through rasterio

    rng, paths = np.random.default_rng(8), []

    def keep(data: bytes) -> None:
        paths.append(folder / f"damaged-{len(paths)}.tif")
        paths[-1].write_bytes(data)

    write_map(folder / "sound.tif", hill())
    with tifffile.TiffFile(folder / "sound.tif") as file:
        page = file.pages.first
        place = [tag for tag in page.tags if tag.code in (33550, 33922, 34735, 34736)]
        extra = [(tag.code, tag.dtype, tag.count, tag.value, True) for tag in place]
        values = page.asarray()
    for compression in ("deflate", "lzw", None):
        own = None if compression == "lzw" else compression
        tifffile.imwrite(folder / "one.tif", values, compression=own, extratags=extra, metadata=None)
        if compression == "lzw":
            shutil.copy(folder / "one.tif", folder / "lzw.tif", driver="GTiff", compress="lzw")
        sound = (folder / ("lzw.tif" if compression == "lzw" else "one.tif")).read_bytes()
        for k in range(25):
            changed = bytearray(sound)
            many = rng.integers(1, 20) if k % 2 else 1
            top = len(sound) if k % 3 else 700
            for at in rng.integers(0, top, many):
                changed[at] = rng.integers(0, 256)
            keep(bytes(changed))
        for part in (0.1, 0.5, 0.9, 0.999):
            keep(sound[: int(part * len(sound))])
    wrong = {
        33550: (np.nan, np.inf, 0.0, 1e308), 33922: (np.nan, 1e308), 34736: (np.nan, 1e308, -1.0),
        42113: ("nonsense", "1e999"), 42112: ("<not xml", "<GDALMetadata><Item name='SCALE'>nan</Item></GDALMetadata>"),
    }  # fmt: skip
    for code, bad_values in wrong.items():
        for bad in bad_values:
            own = [tag for tag in extra if tag[0] != code]
            new = (code, "s", 0, bad, True) if isinstance(bad, str) else None
            for tag in extra:
                if tag[0] == code:
                    new = (code, tag[1], tag[2], tuple(bad for _ in tag[3]), True)
            assert new is not None
            tifffile.imwrite(folder / "one.tif", values, extratags=[*own, new], metadata=None)
            keep((folder / "one.tif").read_bytes())
    return paths


def test_damaged_maps_are_refused_and_named_or_read(tmp_path, capfd):
    """A flipped byte among the heights cannot be noticed; other damage is bad_terrain in one line."""
    path, refusals = terrain_file(tmp_path, dem={"scale": 0.02}), []
    for damaged in damaged_maps(tmp_path):
        path.write_text(tomli_w.dumps({**HILL, "dem": {"file": damaged.name, "scale": 0.02}}))
        try:
            load_terrain(path)
        except BadInput as cause:
            refusals.append(cause)
    assert len(refusals) > 40
    assert {cause.reason for cause in refusals} == {"bad_terrain"}
    assert all("\n" not in str(cause) and len(str(cause)) < 800 for cause in refusals)
    said = capfd.readouterr()
    assert said.out + said.err == ""


WRONG_VALUES = [
    ({"dem": {"file": "x" * 300}}, "no such file"), ({"dem": {"file": "a\nb.tif"}}, "file"),
    ({"dem": {"height_sigma_m": 1e308}}, "height_sigma_m"), ({"dem": {"scale": 1e308}}, "scale"),
    ({"origin": {"latitude_deg": 10**300}}, "latitude_deg"), ({"origin": {"height_m": 1e308}}, "height_m"),
    ({"search": {"radius_m": 1e308}}, "radius_m"), ({"search": {"radius_m": 2**80}}, "radius_m"),
    ({"rover": {"camera_height_m": 1e308}}, "camera_height_m"), ({"name": "n" * 250}, "name"),
    ({"search": {"radius": 5.0}}, "radius_m"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "named"), WRONG_VALUES, ids=lambda v: str(v)[:40])
def test_values_beyond_all_limits_are_refused_and_named(changes, named, tmp_path):
    path = terrain_file(tmp_path)
    d = {**HILL, **changes} if not isinstance(next(iter(changes.values())), dict) else HILL
    for table, keys in changes.items():
        d = {**d, table: {**d.get(table, {}), **keys}} if isinstance(keys, dict) else d
    with pytest.raises(BadInput, match=named) as caught:
        terrain_from_dict(d, folder=path.parent)
    assert caught.value.reason == "bad_terrain"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, "a = " + "9" * 5000, "body = 'moon'\nbody = 'moon'"])
def test_texts_that_no_parser_takes_are_bad_terrain(text, tmp_path):
    (tmp_path / "bad.toml").write_text(text)
    for name in (tmp_path / "bad.toml", tmp_path, f"{'x' * 300}.toml"):
        with pytest.raises(BadInput) as caught:
            load_terrain(name)
        assert caught.value.reason == "bad_terrain"


def test_pictures_stay_in_their_folder_whatever_the_terrain_is_called(tmp_path, capsys):
    out = tmp_path / "a" / "out"
    for name, stem in (("../../up", "_.._up"), (str(tmp_path / "root"), None), ("..", "unnamed")):
        path = terrain_file(tmp_path, name=name)
        assert main(["terrain", "show", str(path), "-D", str(out), "--json"]) == 0
        (file,) = json.loads(capsys.readouterr().out)["files"]
        assert Path(file).resolve().parent == out.resolve()
        assert stem is None or Path(file).name == f"{stem}.relief.png"
    assert len(file_stem("\U0001f30b" * 200).encode()) <= 200


@pytest.mark.parametrize("given", [5, None, b"shackleton"])
def test_what_is_neither_a_name_nor_a_path_is_refused(given: Any) -> None:
    for load, reason in ((load_terrain, "bad_terrain"), (load_camera, "no_calibration")):
        with pytest.raises(BadInput, match=f"{type(given).__name__} is neither a name nor a path") as caught:
            load(given)
        assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("name", "place_deg", "middle"),
    [
        ("site01-10m", ("89.5", "222"), "latitude -89.46, longitude -137.49, .* 9 km x 9 km"),
        ("site01-10m", ("-89.45", "42"), "latitude -89.46, longitude -137.49, .* 9 km x 9 km"),
        ("ldem75s-240m", ("89.5", "222"), "latitude -90.00, .* 230 km x 230 km"),
        ("kepler-48m", ("8.12", "38.01"), "latitude 8.1., longitude -38.0., .* 38.3 km"),
    ],
)
def test_an_origin_with_a_wrong_sign_is_told_where_the_map_lies(name, place_deg, middle, tmp_path, capsys):
    latitude, longitude = place_deg
    words = ["--latitude", latitude, "--longitude", longitude, "-o", str(tmp_path / "mine.toml")]
    assert main(["terrain", "import", str(ROOT / "terrain" / f"{name}.tif"), *words]) == 4
    err = capsys.readouterr().err
    assert re.search(f"{name}.tif: the origin is not on this map: its middle is at {middle}", err)
    assert "next:" not in err
