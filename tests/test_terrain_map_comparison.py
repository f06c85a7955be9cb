"""Errors of maps against finer ones: what shipped files and `terrain import` state, and positions on such ground."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from startrack.cli.main import main
from startrack.core.files import data_dir
from startrack.core.types import Array, Evidence
from startrack.frames import enu_from_latlon
from startrack.localization import ExactPosterior
from startrack.terrain import STEREOGRAPHIC, HeightMap, Projection, Raster, load_terrain, read_map, write_map
from startrack.terrain.imports.comparison import MapComparison, compare_maps, measure_waves
from startrack.terrain.maps.projections import ORTHOGRAPHIC

DATA = Path(__file__).parent / "data"
pytestmark = pytest.mark.usefixtures("own_cache")
POLAR, MAPS = ("shackleton", "haworth", "faustini", "de-gerlache"), ("shackleton", "haworth", "kepler")


@pytest.fixture(scope="module")
def site01() -> MapComparison:
    """The 240 m map against 10 m posts."""
    folder = data_dir("terrain")
    found = compare_maps(read_map(folder / "ldem75s-240m.tif"), read_map(folder / "site01-10m.tif"))
    assert found is not None
    return found


def test_the_errors_of_heights_are_the_measured_ones(site01):
    """By another way, too: the plain difference of bilinear heights at every post of the finer map."""
    coarse, fine = (read_map(data_dir("terrain") / name) for name in ("ldem75s-240m.tif", "site01-10m.tif"))
    y, x = np.mgrid[: fine.heights_m.shape[0], : fine.heights_m.shape[1]]
    at = np.stack([(fine.y0_m + fine.dy_m * y - coarse.y0_m) / coarse.dy_m,
                   (fine.x0_m + fine.dx_m * x - coarse.x0_m) / coarse.dx_m], axis=-1)  # fmt: skip
    plain = float(np.std(coarse.sample(at) - fine.heights_m))
    assert site01.height_sigma_m == pytest.approx(plain, rel=0.02)
    for name in POLAR:
        assert load_terrain(name).height_sigma_m == pytest.approx(site01.height_sigma_m, rel=0.1)


def test_the_errors_of_crests_are_covered_by_the_stated_ones(site01):
    terrain = load_terrain("shackleton")
    assert 0.3 * terrain.height_sigma_m < site01.crest_sigma_m < terrain.height_sigma_m
    assert 2.0 < site01.crest_bias_m < site01.common_crest_sigma_m  # crests are clipped, and the error stated covers it


def test_horizon_elevations_differ_by_the_stated_errors():
    """Shackleton's rim as another program traced it on 5 m posts: too low by the common error, scattered by posts'."""
    reference = np.genfromtxt(DATA / "shackleton_floor_horizon.csv", delimiter=",", names=True)
    terrain = replace(load_terrain("shackleton"), camera_height_m=2.0)
    place, azimuth = enu_from_latlon(terrain.site, np.radians(-89.67), np.radians(129.78))[:2], reference["azimuth_deg"]
    tan, distance, _ = terrain.horizons(place, np.radians(azimuth))
    higher = np.radians(reference["elevation_deg"]) - np.arctan(tan)
    assert terrain.horizon_sigma_common_rad == pytest.approx(higher.mean(), rel=0.15)
    sigma = terrain.height_sigma_m / ((1 + tan**2) * distance)
    assert 0.7 < np.std((higher - higher.mean()) / sigma) < 1.1
    coefficients_rad = np.fft.rfft(higher)[1:9] * 2 / len(higher)  # of the waves: two of each, 16 degrees of freedom
    shape = replace(terrain, search_radius_m=300.0).errors.shape  # what is stated does not depend on the area
    stated_rad = [error.sigma for error in shape if error.name.startswith("wave_")][::2]
    assert 0.2 < np.mean(np.abs(coefficients_rad / stated_rad) ** 2) / 2 < 1.5


@pytest.mark.parametrize("name", [*POLAR, "kepler"])
def test_files_state_the_waves_that_their_map_shows(name):
    stated = tomllib.loads((data_dir("terrain") / f"{name}.toml").read_text())["dem"]["horizon_waves_sigma_deg"]
    waves_rad, _ = measure_waves(load_terrain(name), None)
    np.testing.assert_allclose(stated, np.degrees(waves_rad), rtol=0.05, atol=5e-5)


@pytest.mark.parametrize("name", MAPS)
def test_files_for_rendered_pictures_share_the_ground_and_state_it_as_exact(name):
    ground, rendered = (
        tomllib.loads((data_dir("terrain") / f"{n}.toml").read_text()) for n in (name, f"{name}-rendered")
    )
    assert rendered.pop("name") == f"{ground.pop('name')}-rendered"
    errors, stated = (
        {key: d["dem"].pop(key) for key in ERRORS} | {"camera": d["rover"].pop("camera_height_sigma_m")}
        for d in (rendered, ground)
    )
    assert rendered["dem"].pop("map_offset_sigma_m") == 0.0
    assert rendered == ground
    assert errors["height_sigma_m"] == 1.0 < stated["height_sigma_m"]
    assert (
        errors["horizon_waves_sigma_deg"]
        == errors["stretch_sigma_1"]
        == errors["vertical_sigma_deg"]
        == errors["camera"]
        == 0.0
    )


ERRORS = ("height_sigma_m", "horizon_sigma_deg", "horizon_waves_sigma_deg", "stretch_sigma_1", "vertical_sigma_deg")


def fractal(posts: int, seed: int) -> Array:
    """Self-affine heights (posts, posts) of Hurst exponent 0.8, 10 m RMS between posts."""
    rng, n = np.random.default_rng(seed), 1 << (posts - 1).bit_length()
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.rfftfreq(n), indexing="ij"))
    wave[0, 0] = np.inf
    heights = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(n, n))) * wave**-1.8)[:posts, :posts]
    return np.asarray(heights * 10 / np.diff(heights, axis=0).std())


def grid(heights_m: Array, post_m: float) -> Raster:
    half_m = 0.5 * post_m * (len(heights_m) - 1)
    plane = Projection(kind=STEREOGRAPHIC, latitude_rad=np.radians(30.0), longitude_rad=np.radians(12.0))
    return Raster(
        heights_m=heights_m.astype(np.float32), projection=plane, x0_m=-half_m, y0_m=half_m, dx_m=post_m, dy_m=-post_m,
        source="ground.tif",
    )  # fmt: skip


@pytest.fixture(scope="module")
def ground_files(tmp_path_factory) -> tuple[Path, float]:
    """A folder with a 100 m map averaged from 25 m posts, the middle of these, and the true error [m]."""
    folder, fine = tmp_path_factory.mktemp("maps"), fractal(800, 3)
    coarse = fine.reshape(200, 4, 200, 4).mean(axis=(1, 3))
    write_map(folder / "coarse.tif", grid(coarse, 100.0))
    write_map(folder / "fine.tif", grid(fine[200:600, 200:600], 25.0))
    write_map(folder / "other.tif", grid(fractal(400, 4), 25.0))
    at = (np.mgrid[200:600, 200:600].transpose(1, 2, 0) - 1.5) / 4
    return folder, float(np.std(grid(coarse, 100.0).sample(at) - fine[200:600, 200:600]))


IMPORT = ["--latitude", "30", "--longitude", "12", "--radius", "2000", "--half", "9500", "--json"]


def test_import_measures_the_errors_against_a_finer_map(ground_files, tmp_path, capsys):
    folder, true_m = ground_files
    made = tmp_path / "mine.toml"
    words = ["terrain", "import", str(folder / "coarse.tif"), "-o", str(made), *IMPORT]
    assert main([*words, "--compare", str(folder / "fine.tif")]) == 0
    facts = json.loads(capsys.readouterr().out)
    (ends,) = facts["warnings"]  # of errors there is none
    assert (facts["sigma_from"], ends[:16]) == ("comparison", "the maps end in ")
    assert facts["height_sigma_m"] == pytest.approx(true_m, rel=0.05)
    text = made.read_text()
    assert "# coarse.tif compared with fine.tif" in text
    dem = tomllib.loads(text)["dem"]
    assert dem["horizon_sigma_deg"] == facts["horizon_sigma_deg"] > 0.05
    assert "horizon_waves_sigma_deg:" in text.replace("\n# ", " ")
    assert len(dem["horizon_waves_sigma_deg"]) == 8
    assert 0.0 < dem["horizon_waves_sigma_deg"][0] < dem["horizon_sigma_deg"]

    assert main([*words, "-O"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["sigma_from"] == "map"
    assert 0.7 * true_m < facts["height_sigma_m"] < 2.0 * true_m
    assert "could not be compared with a finer map" in " ".join(made.read_text().split("#")[1:]).replace("\n", "")
    assert "horizon_sigma_deg" not in tomllib.loads(made.read_text())["dem"]


def test_a_map_of_other_ground_is_no_comparison(ground_files, tmp_path, capsys):
    folder, _ = ground_files
    words = ["terrain", "import", str(folder / "coarse.tif"), "-o", str(tmp_path / "mine.toml"), *IMPORT]
    assert main([*words, "--compare", str(folder / "other.tif")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["sigma_from"] == "map"
    assert "differs from other.tif" in facts["warnings"][0]


def test_import_compares_with_shipped_maps(tmp_path, capsys, site01):
    source, made = data_dir("terrain") / "ldem75s-240m.tif", tmp_path / "mine.toml"
    where = ["--latitude", "-89.66", "--longitude", "129.78", "--radius", "8000", "--json"]
    assert main(["terrain", "import", str(source), "-o", str(made), *where]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["sigma_from"] == "comparison"
    assert "site01-10m.tif" in made.read_text()
    assert facts["height_sigma_m"] == pytest.approx(site01.height_sigma_m, rel=0.02)
    assert facts["horizon_sigma_deg"] == pytest.approx(
        0.08, rel=0.25
    )  # the rim, traced on 5 m posts, stands 0.08 higher


def test_maps_of_the_far_side_do_not_overlap():
    fine = grid(fractal(400, 3), 25.0)
    behind = Projection(kind=ORTHOGRAPHIC, latitude_rad=np.radians(-30.0), longitude_rad=np.radians(12.0 - 180.0))
    assert compare_maps(replace(grid(fractal(200, 3), 100.0), projection=behind), fine) is None
    assert compare_maps(grid(fractal(200, 3), 100.0), fine) is not None


@pytest.mark.slow
def test_ground_with_the_stated_errors_is_located_within_them():
    """Ground with 5 m errors at every post, located on the shipped map; benchmarks/map_errors.py has 300 such fixes."""
    whole = load_terrain("shackleton")
    assert isinstance(whole, HeightMap)
    stated = replace(whole, search_radius_m=300.0)
    exact = replace(stated, height_sigma_m=1.0)
    nees: dict[str, list[float]] = {"stated": [], "exact": []}
    for draw in range(4):
        rng = np.random.default_rng(draw)
        ground = replace(stated, maps=tuple(
            replace(one, heights_m=(one.heights_m + rng.normal(0.0, 5.0, one.heights_m.shape)).astype(np.float32))
            for one in stated.maps
        ))  # fmt: skip
        for _ in range(4):
            place = rng.uniform(-180, 180, 2)
            azimuth, above = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(-0.06, 0.06, 2000)
            snr = rng.uniform(1, 4, 2000)
            light = snr * (above > 0) + rng.normal(size=2000)
            evidence = Evidence(
                azimuth_rad=azimuth, elevation_rad=ground.horizon_rad(place[None], azimuth) + above,
                llr=np.clip(snr * light - snr**2 / 2, -9, 9), edge_sigma_rad=np.full(2000, 1e-4),
            )  # fmt: skip
            for name, terrain in (("stated", stated), ("exact", exact)):
                fix = ExactPosterior()(evidence, terrain)
                off = fix.position_enu_m[:2] - place
                nees[name].append(float(off @ np.linalg.solve(fix.covariance_m2, off)))
                if name == "stated":
                    assert np.hypot(*off) < fix.radius999_m
    assert 0.8 < np.mean(nees["stated"]) < 3.5  # 32 degrees of freedom: 2 +- 0.5
    assert np.mean(nees["exact"]) > 1.6 * np.mean(nees["stated"])  # stated as exact, the map is overconfident
