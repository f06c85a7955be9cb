"""Error estimates of height maps: measured, interpolated, and without heights."""

from __future__ import annotations

import json

import numpy as np
import pytest
from map_helpers import polar_stereographic
from scipy.ndimage import map_coordinates

from startrack.cli.main import main
from startrack.core.types import Array, BadInput
from startrack.terrain import Raster, load_terrain, write_map
from startrack.terrain.imports.roughness import carried_spacing, error_between_posts_m


def grid(heights_m: Array, post_m: float = 100.0) -> Raster:
    half_m = 0.5 * post_m * (len(heights_m) - 1)
    return Raster(
        heights_m=heights_m.astype(np.float32), projection=polar_stereographic(), x0_m=-half_m, y0_m=half_m,
        dx_m=post_m, dy_m=-post_m,
    )  # fmt: skip


def rough_ground(exponent: float) -> Array:
    """Self-affine ground, (500, 500), with that Hurst exponent."""
    rng = np.random.default_rng(1)
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(512), np.fft.rfftfreq(512), indexing="ij"))
    wave[0, 0] = np.inf
    ground = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(512, 512))) * wave ** -(exponent + 1))[:500, :500]
    return np.asarray(ground * 10 / np.diff(ground, axis=0).std())


def estimate_errors() -> Array:
    terrain = load_terrain("shackleton")
    at = terrain.site.latitude_rad, terrain.site.longitude_rad
    return np.asarray(terrain.maps[0].crop_around(*at, 60_000.0).heights_m, dtype=np.float64)


def interpolate_ground(ground: Array, every: int, order: int) -> Array:
    """The ground sampled at every n-th post and interpolated by a spline of the given order."""
    posts = ground[::every, ::every]
    at = [np.arange((n - 1) * every + 1) / every for n in posts.shape]
    return np.asarray(map_coordinates(posts, np.meshgrid(*at, indexing="ij"), order=order, mode="nearest"))


GROUNDS = [rough_ground(0.8), rough_ground(0.95), estimate_errors()]


@pytest.mark.parametrize("ground", GROUNDS, ids=["rough 0.8", "rough 0.95", "240 m map"])
@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("every", [2, 4])
def test_the_error_of_an_interpolated_map_is_that_of_what_it_was_made_from(ground, order, every):
    made = interpolate_ground(ground, every, order)
    off = (made - ground[: made.shape[0], : made.shape[1]])[8:-8, 8:-8]
    true = float(np.sqrt(np.mean(off**2)))
    assert 1 / 1.5 < error_between_posts_m(grid(made)) / true < 1.5
    assert carried_spacing(made) == pytest.approx(every, rel=0.2)


@pytest.mark.parametrize("ground", GROUNDS[:2], ids=["rough 0.8", "rough 0.95"])
def test_the_error_of_a_map_of_ground_is_what_lies_between_its_posts(ground):
    posts = ground[::2, ::2]
    assert carried_spacing(posts) == 1.0
    true = np.sqrt(np.mean((ground[::2, 1:-1:2] - 0.5 * (posts[:, 1:] + posts[:, :-1])) ** 2))
    assert 1 / 1.5 < error_between_posts_m(grid(posts)) / true < 1.5


@pytest.mark.parametrize("name", ["shackleton", "kepler"])
def test_measured_maps_carry_what_their_products_do(name):
    """The 240 m map was averaged from 120 m; Kepler's 48 m posts from a 118 m product."""
    made = load_terrain(name).maps[0]
    carried_m = carried_spacing(made.heights_m.astype(np.float64)) * made.post_m
    assert carried_m == pytest.approx(240.0 if name == "shackleton" else 150.0, rel=0.3)


@pytest.mark.parametrize("side", [5, 100])
def test_a_map_without_heights_is_refused(side):
    with pytest.raises(BadInput, match="no post has a height") as refused:
        error_between_posts_m(grid(np.full((side, side), np.nan)))
    assert refused.value.reason == "bad_terrain"


def test_holes_are_left_out():
    made = GROUNDS[0].copy()
    whole = error_between_posts_m(grid(made))
    made[100:140, 200:300] = np.nan
    assert error_between_posts_m(grid(made)) == pytest.approx(whole, rel=0.1)


def test_import_warns_of_an_interpolated_map(tmp_path, capsys):
    made = interpolate_ground(GROUNDS[0][:161, :161], 4, 3)
    for name, heights in (("made", made), ("ground", GROUNDS[0][:161, :161])):
        write_map(tmp_path / f"{name}.tif", grid(heights))
        words = ["--latitude", "-90", "--longitude", "0", "--radius", "2000", "--half", "7900", "--json"]
        out = str(tmp_path / f"{name}.toml")
        assert main(["terrain", "import", str(tmp_path / f"{name}.tif"), "-o", out, *words]) == 0
        said = capsys.readouterr()
        facts = json.loads(said.out)
        assert any("interpolated" in warning for warning in facts["warnings"]) == (name == "made")
        assert ("interpolated" in said.err) == (name == "made")
        if name == "made":
            assert f"{facts['height_sigma_m']:g} m" in facts["warnings"][-1]
