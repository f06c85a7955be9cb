"""The light of the sky in the whole chain: the refined fix, its sources, and the skyline that the image shows."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import QTable

from startrack.api.solution import Solution
from startrack.camera import Camera, load_camera
from startrack.catalog import StarCatalog, load_catalog
from startrack.chain import Inputs, Located, Refused, Settings, pipeline
from startrack.core.errors import Reason
from startrack.core.types import MIDDLES_RAD, Exposure
from startrack.localization import PseudoGradient
from startrack.output import prepare_folder, write_results
from startrack.output.picture.canvas import GAP_PX, Ink
from startrack.output.picture.panorama import (
    ABOVE_PX,
    ENLARGED_PX,
    HEIGHT_PX,
    MARGIN_PX,
    RIGHT_PX,
    WIDTH_PX,
    located_picture,
)
from startrack.output.tables import half_range_rad
from startrack.rendering import Series, Truth, render
from startrack.terrain import load_terrain

CRATER = load_terrain("shackleton-thesis")
CAMERA = replace(
    load_camera("fisheye-2048"), name="fisheye-1024", size_px=(1024, 1024), focal_px=(326.0, 326.0),
    centre_px=(511.5, 511.5),
)  # fmt: skip
EXPOSURE_S = 3.0
PLACES_M = {"near the middle": (1200.0, 800.0), "halfway": (-4500.0, 3100.0)}


@pytest.fixture(scope="module")
def catalog() -> StarCatalog:
    return load_catalog().brighter_than(7.0)


@dataclass(frozen=True)
class Frame:
    """A rendered exposure and its truth."""

    exposure: Exposure
    truth: Truth

    def error_m(self, located: Located) -> float:
        return float(np.linalg.norm((located.fix.position_enu_m - self.truth.position_enu_m)[:2]))


def expose(
    catalog: StarCatalog, place_m: tuple[float, float], sky_v_mag_arcsec2: float | None, camera: Camera = CAMERA,
    heading_rad: float | None = None,
) -> Frame:  # fmt: skip
    """A frame of the crater; None is a black sky."""
    series = Series(
        camera=camera, terrain=CRATER, catalog=catalog, seed=3, time_utc=datetime(2031, 2, 3, tzinfo=UTC),
        east_m=place_m[0], north_m=place_m[1], exposure_s=EXPOSURE_S, faint_v_mag=None, hot_pixels=20,
        sky_v_mag_arcsec2=sky_v_mag_arcsec2, heading_rad=heading_rad,
    )  # fmt: skip
    scene, rng = series.scene(0, "frame")
    exposure, truth = render(scene, rng=rng)
    return Frame(exposure, truth)


def locate(frame: Frame, catalog: StarCatalog, camera: Any = CAMERA, **settings: Any) -> Any:
    return pipeline.locate(frame.exposure, camera, CRATER, catalog, Settings(**settings))


@pytest.fixture(scope="module", params=list(PLACES_M))
def bright(request: Any, catalog: StarCatalog) -> Frame:
    return expose(catalog, PLACES_M[request.param], 21.0)


@pytest.fixture(scope="module")
def by_source(bright: Frame, catalog: StarCatalog) -> dict[str, Located]:
    return {source: locate(bright, catalog, evidence_sources=source) for source in ("both", "stars", "sky")}


def test_the_light_of_the_sky_makes_the_fix_better(bright: Frame, by_source: dict[str, Located]) -> None:
    assert {source: found.status for source, found in by_source.items()} == dict.fromkeys(by_source, "ok")
    both, stars, sky = (by_source[source] for source in ("both", "stars", "sky"))
    assert (both.evidence_source, stars.evidence_source, sky.evidence_source) == ("both", "stars", "sky")
    assert both.fix.radius95_m < 0.5 * stars.fix.radius95_m
    assert bright.error_m(both) < bright.error_m(stars)
    for found in (both, sky):
        assert bright.error_m(found) < found.fix.radius999_m
        off = (found.fix.position_enu_m - bright.truth.position_enu_m)[:2]
        assert off @ np.linalg.solve(found.fix.covariance_m2, off) < 18.4  # 99.99 %
        assert np.linalg.norm(found.fix.position_enu_m - both.fix.position_enu_m) < stars.fix.radius95_m
        assert np.count_nonzero(found.sky_at_skyline.used) > 180
        assert found.fix.blocked is None
    assert stars.sky is None
    assert both.fix.search == stars.fix.search == "proven"
    assert [found.sky_unused for found in by_source.values()] == ["", "", ""]


@pytest.mark.slow
def test_a_lens_that_is_not_quite_its_file_keeps_the_truth_in_the_circle(bright: Frame, catalog: StarCatalog) -> None:
    """The principal point is wrong by a third of a pixel: stars near the skyline show it."""
    found = locate(bright, catalog, replace(CAMERA, centre_px=(511.8, 511.35)))
    assert found.status == "ok" and found.evidence_source == "both"
    assert bright.error_m(found) < found.fix.radius999_m


def test_the_measured_skyline_is_the_true_one(bright: Frame, by_source: dict[str, Located]) -> None:
    for source, least in (("both", 180), ("sky", 180), ("stars", 10)):
        found = by_source[source].skyline
        assert found is not None
        assert len(found) == 240 and np.count_nonzero(found.known) > least
        true = CRATER.horizon_rad(bright.truth.position_enu_m[None, :2], found.azimuth_rad)
        z = ((found.elevation_rad - true) / found.sigma_rad)[found.known]
        # Of a bright sky the sigma holds errors of the levels that neighbouring sectors share.
        assert (0.0 if source == "stars" else 0.2) < np.mean(np.square(z)) < 1.5
        assert abs(np.mean(z)) < 0.6  # the sectors share errors of the attitude
        assert np.array_equal(found.known, found.source != "")
        assert np.array_equal(found.known, np.isfinite(found.sigma_rad))
        names = set(np.unique(found.source)) - {""}
        assert names == {"stars"} if source == "stars" else "sky light" in names | {"sky light"} - {"stars"}
        if source != "stars":
            used = by_source[source].sky_at_skyline.used
            assert np.isin(found.source[used], ("sky light", "both")).all()
            assert (found.source[~used] != "sky light").all()
    sigma = [np.median(by_source[source].skyline.sigma_rad) for source in ("both", "stars")]
    assert sigma[0] < 0.2 * sigma[1]


def test_the_sky_stops_where_the_skyline_is(bright: Frame, by_source: dict[str, Located]) -> None:
    """The heights of the sectors scatter as their pixels' noise and their levels' errors let them, about the truth."""
    assert by_source["sky"].sky is not None
    sky, used, errors = by_source["sky"].sky_at_skyline
    true = CRATER.horizon_rad(bright.truth.position_enu_m[None, :2], MIDDLES_RAD)
    off = sky.shift_px - (true + errors.slopes_rad @ errors.mean - sky.elevation_rad) * sky.px_per_rad
    assert 0.25 < np.mean((np.square(off) / sky.variance_px2)[used]) < 1.2
    assert abs(np.mean(off[used])) < 0.03


@pytest.mark.slow
def test_a_black_sky_leaves_the_stars(catalog: StarCatalog) -> None:
    frame = expose(catalog, PLACES_M["near the middle"], None)
    found = locate(frame, catalog)
    assert found.status == "ok" and found.evidence_source == "stars"
    assert "no step of light" in found.sky_unused
    stars = locate(frame, catalog, evidence_sources="stars")
    assert np.array_equal(found.fix.position_enu_m, stars.fix.position_enu_m)
    assert np.array_equal(found.fix.covariance_m2, stars.fix.covariance_m2)
    alone = locate(frame, catalog, evidence_sources="sky")
    assert isinstance(alone, Refused)
    assert alone.reason == "insufficient_geometry" and "light of the sky" in alone.message


@pytest.mark.slow
def test_a_camera_that_shows_little_of_the_skyline_leaves_the_stars(catalog: StarCatalog) -> None:
    """The frame is a part of the camera's on one side: a quarter of the skyline must be in it."""
    for width, source in ((324, "both"), (184, "stars")):
        camera = replace(CAMERA, size_px=(width, 1024), centre_px=(511.5 - 1024 + width, 511.5))
        found = locate(expose(catalog, (-4500.0, 3000.0), 21.0, camera, heading_rad=0.3), catalog, camera)
        assert found.status == "ok" and found.evidence_source == source
        degrees = re.fullmatch(
            "the image shows sky and ground beside (.*)° of the skyline, and 90° are needed", found.sky_unused
        )
        assert (degrees is None) == (source == "both")
        if degrees is not None:
            assert 30 < float(degrees[1]) < 80


def test_a_method_without_a_posterior_does_not_use_the_sky(bright: Frame, catalog: StarCatalog) -> None:
    found = locate(bright, catalog, localizer=PseudoGradient())
    assert found.status == "ok" and found.evidence_source == "stars"
    assert found.fix.search == "approximate"
    assert found.sky_unused == "the method of localization has no posterior"
    assert found.skyline is None and Solution(found).skyline is None


def test_unknown_sources_are_refused() -> None:
    with pytest.raises(ValueError, match="evidence_sources 'moon': known are both, stars, sky"):
        Settings(evidence_sources="moon")


def test_the_table_of_the_skyline(by_source: dict[str, Located], tmp_path: Path) -> None:
    found = by_source["both"]
    path = tmp_path / "frame.fix.json"
    write_results(found, path, plots=False)
    assert json.loads(path.read_text(encoding="utf-8"))["position"]["evidence"] == "both"
    table = QTable.read(tmp_path / "frame.skyline.ecsv", format="ascii.ecsv")
    skyline = found.skyline
    assert skyline is not None
    assert table["azimuth_deg"].value == pytest.approx(np.degrees(skyline.azimuth_rad), abs=1e-6)
    known = skyline.known
    assert table["elevation_deg"].value[known] == pytest.approx(np.degrees(skyline.elevation_rad)[known], abs=1e-4)
    assert table["sigma_deg"].value[known] == pytest.approx(np.degrees(skyline.sigma_rad)[known], abs=1e-4)
    assert np.array_equal(np.ma.filled(table["source"], ""), skyline.source)
    assert np.array_equal(np.ma.getmaskarray(table["elevation_deg"]), ~known)
    assert [table[name].unit for name in ("azimuth_deg", "elevation_deg", "sigma_deg")] == ["deg"] * 3
    shown = Solution(found).skyline
    assert shown is not None and shown.colnames == table.colnames
    assert np.array_equal(np.ma.filled(shown["source"], ""), skyline.source)


def test_the_skyline_is_measured_once(
    by_source: dict[str, Located], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*given: object) -> None:
        raise AssertionError("the skyline is measured again")

    monkeypatch.setattr("startrack.chain.two_looks.skyline_of_image", fail)
    write_results(by_source["both"], tmp_path / "frame.fix.json")
    assert Solution(by_source["both"]).skyline is not None
    assert {path.name for path in tmp_path.glob("frame.skyline.*")} == {"frame.skyline.ecsv", "frame.skyline.png"}


def test_the_picture_shows_the_skyline_above_the_horizon(by_source: dict[str, Located]) -> None:
    """Raised by some hundredths of a degree, its marks stand higher by their share of the enlarged plot's height."""
    found, skyline = by_source["both"], by_source["both"].skyline
    assert skyline is not None
    by_sky = skyline.source == "sky light"
    horizon_rad = CRATER.horizon_rad(found.fix.position_enu_m[None, :2], skyline.azimuth_rad)
    heights_px = []
    for raised_deg in (-0.02, 0.02):
        at = replace(
            skyline, elevation_rad=np.where(by_sky, horizon_rad + np.radians(raised_deg), np.nan),
            sigma_rad=np.where(by_sky, np.radians(0.02), np.inf), source=np.where(by_sky, skyline.source, ""),
        )  # fmt: skip
        picture = located_picture(found, at)
        assert picture.shape == (HEIGHT_PX + ENLARGED_PX, WIDTH_PX, 3)
        plot = picture[HEIGHT_PX + int(ABOVE_PX) + 2 : -int(5 * GAP_PX) - 2, int(MARGIN_PX) + 2 : -int(RIGHT_PX) - 2]
        rows = np.flatnonzero((plot == Ink.MEASURED).all(axis=-1).sum(axis=1) > 50)
        assert len(rows) > 0
        heights_px.append(plot.shape[0] / 2 - rows.mean())
    half_deg = 0.06  # 0.02 and two sigma
    px_per_deg = (ENLARGED_PX - ABOVE_PX - 5 * GAP_PX) / (2 * half_deg)
    assert heights_px == pytest.approx([-0.02 * px_per_deg, 0.02 * px_per_deg], abs=1.5)


def test_the_enlarged_range_holds_the_skyline_and_not_its_outliers() -> None:
    raised, sigma = np.append(np.full(99, 2e-3), [0.05, np.nan]), np.append(np.full(100, 1e-3), np.inf)
    assert half_range_rad(raised, sigma) == pytest.approx(4e-3)
    assert half_range_rad(raised * 1e-3, sigma * 1e-3) == pytest.approx(np.radians(0.02))
    assert half_range_rad(raised * 1e3, sigma) == half_range_rad(np.array([np.nan]), sigma[-1:]) == np.radians(5.0)


def test_a_refusal_removes_the_table(by_source: dict[str, Located], tmp_path: Path) -> None:
    path = tmp_path / "frame.fix.json"
    write_results(by_source["both"], path, plots=False)
    assert (tmp_path / "frame.skyline.ecsv").exists()
    prepare_folder(path, by_source["both"].exposure.sha256, overwrite=True, remedy="")
    refused = Refused(reason=Reason.NO_TIME, message="no time", reached=Inputs(exposure=by_source["both"].exposure))
    write_results(refused, path, plots=False)
    assert not (tmp_path / "frame.skyline.ecsv").exists()
    assert Solution(refused).skyline is None
