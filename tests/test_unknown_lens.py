"""Identification without a camera file: lenses of every family, real photographs, and skies that must be refused."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, Decentring, KannalaBrandt, Lens, Pinhole
from startrack.catalog import is_below_horizon, load_catalog
from startrack.chain import identify_blind as identify_picture
from startrack.cli.main import main
from startrack.core.types import Detections, NotIdentified, SmoothImage, Stars
from startrack.estimation.attitude import solve_attitude
from startrack.estimation.radial_fit import largest_angle_rad, radius_of
from startrack.exposure import read_exposure
from startrack.frames import Site, angle_between_rad
from startrack.identification.unknown_lens import UnknownLensSolution, identify_unknown_lens

DATA = Path(__file__).parent / "data"
PHOTO = Path(__file__).parent.parent / "sample_images/lowell-2018-08-06.fits.bz2"
SIZE = (1400, 1100)
ARCSEC = np.pi / 648_000
ORTHOGRAPHIC, EQUISOLID, EQUIDISTANT, STEREOGRAPHIC = -1 / 6, -1 / 24, 0.0, 1 / 12  # bends


@dataclass(frozen=True)
class BentLens(Lens):
    """An ideal lens."""

    model: ClassVar[str] = "bent"

    bend: float

    @property
    def max_invertible_rad(self) -> float:  # type: ignore[override]
        return largest_angle_rad(self.bend)

    def rho(self, angle_rad: np.ndarray) -> np.ndarray:
        return radius_of(angle_rad, self.bend)

    def slope(self, angle_rad: np.ndarray) -> np.ndarray:
        return (self.rho(angle_rad + 1e-6) - self.rho(angle_rad - 1e-6)) / 2e-6


@lru_cache(maxsize=1)
def sky() -> Stars:
    return load_catalog().at(None, None)


def lens_camera(
    lens: Lens, fov: float, radius_px: float, size: tuple[int, int] = SIZE, off: tuple[float, float] = (0, 0),
    mirrored: bool = False,
) -> Camera:  # fmt: skip
    """A camera whose image circle of `fov` degrees has this radius, its centre off the frame's."""
    half = np.radians(fov / 2)
    focal = radius_px / float(lens.rho(np.array(half)))
    centre = ((size[0] - 1) / 2 + off[0], (size[1] - 1) / 2 + off[1])
    return Camera(
        name="truth", size_px=size, focal_px=(focal, focal), centre_px=centre, max_angle_rad=half,
        calibrated_angle_rad=half, lens=lens, mirrored=mirrored,
    )  # fmt: skip


def picture(
    camera: Camera, seed: int, limit: float = 5.0, hidden: float = 0.4, false: float = 0.3,
    brightest: int | None = None,
    hot: int = 0,
) -> tuple[Detections, np.ndarray, np.ndarray]:  # fmt: skip
    """Detections at a random attitude, the true star of each (-1: none), and that attitude.

    One side of the sky is hidden, random false stars are added, and `hot` pixels are brighter than any star.
    """
    rng = np.random.default_rng([seed, 7])
    R = Rotation.random(random_state=rng).as_matrix()
    px, inside = camera.project(sky().rays_icrs @ R.T)
    star = np.flatnonzero(inside & (sky().v_mag < limit))
    side = (px[star] - camera.centre_px) @ rng.normal(size=2)
    star = star[side >= np.quantile(side, hidden)][:brightest]
    v = sky().v_mag[star] + rng.normal(0, 0.2, len(star))
    wrong = rng.uniform(0, 1, (round(false * len(star)), 2)) * camera.size_px
    brighter = rng.uniform(0, 1, (hot, 2)) * camera.size_px
    xy = np.concatenate([px[star] + rng.normal(0, 0.2, (len(star), 2)), wrong, brighter])
    v = np.concatenate([v, rng.choice(v, len(wrong)), np.full(hot, v.min() - 1)])
    order = np.argsort(v)
    truth = np.concatenate([star, np.full(len(wrong) + hot, -1)])
    return detections(xy[order], 10 ** (-0.4 * (v[order] - 18))), truth[order], R


def detections(xy_px: np.ndarray, flux: np.ndarray, psf_sigma_px: float = 1.0) -> Detections:
    n = len(xy_px)
    return Detections(
        xy_px=xy_px, covariance_px2=np.tile(0.04 * np.eye(2), (n, 1, 1)), flux_e=flux,
        flux_sigma_e=np.sqrt(np.abs(flux) + 1), snr=np.sqrt(np.abs(flux)), saturated=np.zeros(n, dtype=bool),
        psf_sigma_px=psf_sigma_px, image_e=np.zeros((2, 2), np.float32), dead=np.zeros((2, 2), bool),
        background=SmoothImage.of(np.zeros((2, 2), np.float32)), noise=SmoothImage.of(np.ones((2, 2), np.float32)),
    )  # fmt: skip


def photograph_detections(name: str) -> Detections:
    """A real photograph's point sources."""
    with (DATA / name).open(encoding="utf-8") as file:
        lines = file.readlines()
    sigma = next(float(line.split()[-1]) for line in lines if line.startswith("# psf_sigma_px"))
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    xy = np.array([[float(r["x_px"]), float(r["y_px"])] for r in rows])
    return replace(
        detections(xy, np.array([float(r["flux"]) for r in rows]), sigma),
        flux_sigma_e=np.array([float(r["flux_sigma"]) for r in rows]),
        saturated=np.array([r["saturated"] == "1" for r in rows]),
    )


def boresight_off_rad(found: UnknownLensSolution, ra_deg: float, dec_deg: float) -> float:
    ra, dec = np.radians([ra_deg, dec_deg])
    want = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    middle = (np.array(found.camera.size_px) - 1) / 2
    ray = found.camera.unproject(middle) @ found.identification.R_cam_icrs
    return float(angle_between_rad(ray, want))


LENSES = {
    "equidistant, 20 px off centre": (lens_camera(BentLens(EQUIDISTANT), 180, 520, off=(20, -15)), {}, 180),
    "equisolid, mirrored": (lens_camera(BentLens(EQUISOLID), 180, 520, mirrored=True), {}, 180),
    "stereographic": (lens_camera(BentLens(STEREOGRAPHIC), 180, 520), {}, 180),
    "orthographic": (lens_camera(BentLens(ORTHOGRAPHIC), 170, 520), {}, 170),
    "no ideal lens, 185 degrees": (lens_camera(KannalaBrandt((-0.03, 0.02, -0.015, 0.002)), 185, 520), {}, 185),
    "clipped by the frame": (lens_camera(BentLens(EQUISOLID), 180, 640, size=(1400, 900)), {}, 180),
    "twenty hot pixels brighter than the stars": (lens_camera(BentLens(EQUISOLID), 180, 520), {"hot": 20}, 180),
    "a third of the sky": (lens_camera(BentLens(EQUISOLID), 180, 520), {"hidden": 0.67}, 180),
    "30 stars": (lens_camera(BentLens(EQUIDISTANT), 180, 520), {"brightest": 30, "hidden": 0.0}, 180),
    "70 degrees": (lens_camera(Pinhole(), 70, 700), {"limit": 6.0}, 70),
    "20 degrees": (lens_camera(Pinhole(), 20, 700), {"limit": 7.0, "hidden": 0.0}, 20),
    "20 degrees, mirrored": (lens_camera(Pinhole(), 20, 700, mirrored=True), {"limit": 6.5, "hidden": 0.0}, 20),
    "8 stars in 20 degrees": (lens_camera(Pinhole(), 20, 700), {"brightest": 8, "hidden": 0.0, "false": 0.0}, 20),
}


@pytest.mark.parametrize(("case", "wrong_by"), list(zip(LENSES, [1.0, 0.91, 1.09] * len(LENSES), strict=False)))
def test_the_lens_is_found_with_the_stars(case: str, wrong_by: float) -> None:
    camera, how, fov = LENSES[case]
    seen, truth, R = picture(camera, seed=3, **how)
    found = identify_unknown_lens(seen, camera.size_px, np.radians(fov * wrong_by), sky())
    names = found.identification
    assert np.mean(truth[names.detection] == names.star) >= 0.98
    assert len(set(names.star.tolist())) == len(set(names.detection.tolist())) == len(names)
    assert names.false_alarm_probability < 1e-9
    assert found.camera.mirrored == camera.mirrored
    assert found.camera.lens.model == ("pinhole" if fov <= 40 else "kannala_brandt")
    # The projection, not its parameters: inside the calibrated angle the pixels are those of the true lens.
    angle = np.linspace(0, min(found.camera.calibrated_angle_rad, camera.max_angle_rad) * 0.95, 50)
    radii = [c.focal_px[0] * c.lens.rho(angle) for c in (found.camera, camera)]
    assert np.abs(radii[0] - radii[1]).max() < 2.0
    px, inside = camera.project(sky().rays_icrs[:500] @ R.T)
    again, also = found.camera.project(sky().rays_icrs[:500] @ names.R_cam_icrs.T)
    known = inside & also & (found.camera.angle_rad(px) < 0.95 * found.camera.calibrated_angle_rad)
    assert np.linalg.norm(px - again, axis=1)[known].max() < 1.0


@pytest.mark.parametrize(
    ("case", "aspect"),
    [("equisolid, mirrored", 0.9), ("no ideal lens, 185 degrees", 0.8), ("stereographic", 0.95),
     ("clipped by the frame", 1.067), ("20 degrees", 0.8), ("20 degrees, mirrored", 1.067)],
)  # fmt: skip
def test_squeezed_pictures_are_identified(case: str, aspect: float) -> None:
    ideal, how, fov = LENSES[case]
    camera = replace(ideal, focal_px=(ideal.focal_px[0] * aspect, ideal.focal_px[0]))
    seen, truth, _ = picture(camera, seed=4, **how)
    found = identify_unknown_lens(seen, camera.size_px, np.radians(fov / (aspect if fov < 100 else 1)), sky())
    names = found.identification
    assert np.mean(truth[names.detection] == names.star) >= 0.98
    focal_px, covariance = np.array(found.camera.focal_px), found.camera.covariance
    assert covariance is not None
    by_focal = np.array([1.0, -1.0]) / focal_px
    sigma = np.sqrt(by_focal @ covariance[:2, :2] @ by_focal)
    assert abs(np.log(focal_px[0] / focal_px[1] / aspect)) < 4 * sigma < 0.004


@pytest.mark.parametrize("case", ["equisolid, mirrored", "70 degrees", "20 degrees", "a third of the sky"])
def test_a_range_of_fields_is_one_search(case: str) -> None:
    camera, how, _ = LENSES[case]
    seen, truth, _ = picture(camera, seed=5, **how)
    found = identify_unknown_lens(seen, camera.size_px, (np.radians(2.0), np.radians(190.0)), sky())
    names = found.identification
    assert np.mean(truth[names.detection] == names.star) >= 0.98
    assert names.false_alarm_probability < 1e-9


@pytest.mark.slow
def test_noise_is_refused_in_bounded_time() -> None:
    rng = np.random.default_rng(5)
    for n, fov in ((40, 180), (300, 15)):
        noise = detections(rng.uniform(0, 1, (n, 2)) * SIZE, np.sort(rng.pareto(1.5, n) + 1)[::-1])
        with pytest.raises(NotIdentified, match="better than chance") as refusal:
            identify_unknown_lens(noise, SIZE, np.radians(fov), sky())
        assert refusal.value.evidence["tried"] < 1_500_000  # patterns: the measure of its time


def test_too_few_stars_are_refused_at_once() -> None:
    with pytest.raises(NotIdentified, match="too few"):
        identify_unknown_lens(detections(np.arange(12.0).reshape(6, 2) * 80, np.ones(6)), SIZE, np.pi, sky())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ra_deg", "dec_deg", "arcsec"),
    [("narrow-alt40-azi-45.csv", 172.3676, 57.6493, 8), ("narrow-alt60-azi135.csv", 286.4356, 28.9442, 8)],
)
def test_narrow_photographs_agree_with_two_other_solvers(
    name: str, ra_deg: float, dec_deg: float, arcsec: float
) -> None:
    seen = photograph_detections(name)
    for fov in (10.4, 11.4, 12.4):
        found = identify_unknown_lens(seen, (1024, 768), np.radians(fov), sky())
        assert boresight_off_rad(found, ra_deg, dec_deg) < arcsec * ARCSEC
        assert 2 * np.degrees(np.arctan(512 / found.camera.focal_px[0])) == pytest.approx(11.423, abs=0.01)
        assert len(found.identification) >= 70
        assert not found.camera.mirrored


@pytest.mark.slow
def test_an_overcast_photograph_is_refused() -> None:
    with pytest.raises(NotIdentified, match="better than chance"):
        identify_unknown_lens(photograph_detections("overcast.csv"), (1392, 1040), np.pi, sky())


def test_a_moonlit_photograph_is_identified() -> None:
    found = identify_unknown_lens(photograph_detections("moonlit.csv"), (1392, 1040), np.pi, sky())
    assert len(found.identification) >= 300
    assert found.camera.focal_px[0] == pytest.approx(337.2, abs=1.0)  # of the same camera on another night
    assert found.camera.centre_px == pytest.approx((709.7, 489.7), abs=1.0)


@pytest.fixture(scope="module")
def photo():
    return read_exposure(PHOTO)


def test_a_photograph_is_identified_cold(photo) -> None:
    result = identify_picture(photo, np.radians(170.0), load_catalog())
    assert result.status == "ok", result.message
    with (DATA / "lowell-2018-08-06-stars.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    px = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    hip = np.array([int(row["hip"]) for row in rows])
    found = result.identification
    assert len(found) >= 1500
    distance, nearest = cKDTree(px).query(result.detections.xy_px[found.detection])
    both = distance < 1.5
    assert both.sum() >= 400
    assert np.mean(result.stars.hip[found.star][both] == hip[nearest[both]]) >= 0.99
    assert result.attitude_fit.rms_px < 0.4
    assert result.camera.calibrated_angle_rad > np.radians(70)


def test_place_and_time_leave_out_the_sky_below_the_horizon(photo) -> None:
    site = Site("earth", *np.radians([34.7443, -111.4223]), 2361.0)
    result = identify_picture(photo, np.radians(170.0), load_catalog(), site=site)
    assert result.status == "ok" and result.site == site
    named = result.stars.rays_icrs[result.identification.star]
    assert not is_below_horizon(named, site, photo.time_utc).any()
    anywhere = identify_picture(photo, np.radians(170.0), load_catalog())
    assert len(named) >= len(anywhere.identification)  # refraction is no error of the lens
    opposite = Site("earth", -site.latitude_rad, site.longitude_rad + np.pi, 0.0)
    refused = identify_picture(photo, np.radians(170.0), load_catalog(), site=opposite)
    assert refused.reason == "not_identified" and "check the site (signs) and the time" in refused.message


def test_its_half_covered_mirror_image_is_reported_as_mirrored(photo, tmp_path, capsys) -> None:
    from PIL import Image

    pixels = photo.pixels_adu[:, ::-1].copy()
    pixels[:, :600] = np.median(pixels)  # a wall
    eight_bits = np.clip((pixels - 2000) / 16, 0, 255).astype(np.uint8)
    path = tmp_path / "flipped.png"
    Image.fromarray(eight_bits).save(path)
    code = main(["identify", "--fov", "180", "--no-plots", "-D", str(tmp_path), str(path)])
    assert code == 0
    said = capsys.readouterr().out
    assert "lens found" in said and ", mirrored" in said and "startrack calibrate" in said
    record = json.loads((tmp_path / "flipped.identification.json").read_text())
    assert record["camera"]["mirrored"] is True
    assert record["camera"]["model"] == "kannala_brandt"
    assert record["camera"]["focal_px"][0] == pytest.approx(337.2, abs=1.5)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "lists"), [("equisolid, mirrored", 30), ("70 degrees", 12), ("20 degrees", 12)])
def test_the_attitude_sigma_is_right_with_a_lens_from_the_same_stars(name: str, lists: int) -> None:
    """Of lenses as they are made: centre, ratio of the focal lengths and decentring are a little off the ideal ones."""
    ideal, picture_of, fov = LENSES[name]
    nees = []
    for seed in range(100, 100 + lists):
        off = np.random.default_rng(seed).normal(size=5)
        camera = replace(
            ideal, centre_px=tuple(ideal.centre_px + 15.0 * off[:2]), decentring=Decentring(*3e-4 * off[2:4]),
            focal_px=(ideal.focal_px[0], ideal.focal_px[0] * (1.0 + 0.003 * off[4])),
        )  # fmt: skip
        seen, _, R = picture(camera, seed, **picture_of)
        found = identify_unknown_lens(seen, camera.size_px, np.radians(fov), sky())
        named = found.identification
        attitude = solve_attitude(
            found.camera, seen.xy_px[named.detection], seen.covariance_px2[named.detection],
            sky().rays_icrs[named.star], named.R_cam_icrs,
        ).attitude  # fmt: skip
        w = Rotation.from_matrix(R @ attitude.R_cam_icrs.T).as_rotvec()
        nees.append(w @ np.linalg.solve(attitude.covariance_rad2, w))
    assert abs(np.mean(nees) - 3.0) < 3.5 * np.sqrt(6.0 / lists)
    assert max(nees) < 25
