"""A lens of a user's own: one class and one line in the list of lenses serve files, projection, WCS and calibration."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import jsonschema
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

from startrack.applications.calibration import fit_lens, observations
from startrack.camera import (
    Camera,
    KannalaBrandt,
    Lens,
    Pinhole,
    camera_from_dict,
    camera_keys,
    camera_to_dict,
    lens_jacobian,
    lenses,
    load_camera,
    save_camera,
    with_update,
)
from startrack.camera import foreign_text as to_text
from startrack.cli.main import main
from startrack.core.types import Array, BadInput
from startrack.output.wcs import header_block, wcs_cards


@dataclass(frozen=True)
class Sine(Lens):
    """rho = m sin(a / m): equisolid with m = 2, orthographic with m = 1."""

    model: ClassVar[str] = "sine"
    label: ClassVar[str] = "sine"
    parameter_names: ClassVar[tuple[str, ...]] = ("m",)
    m: float = 2.0

    def rho(self, angle_rad: Array) -> Array:
        return self.m * np.sin(np.asarray(angle_rad) / self.m)

    def slope(self, angle_rad: Array) -> Array:
        return np.cos(np.asarray(angle_rad) / self.m)

    def derivative(self, name: str, angle_rad: Array) -> Array:
        a = np.asarray(angle_rad) / self.m
        return np.sin(a) - a * np.cos(a)


@dataclass(frozen=True)
class Steep(Lens):
    """rho = tan a: no odd polynomial fits it to 88 degrees."""

    model: ClassVar[str] = "steep"
    label: ClassVar[str] = "steep"
    max_invertible_rad: ClassVar[float] = 1.56

    def rho(self, angle_rad: Array) -> Array:
        return np.tan(np.asarray(angle_rad))

    def slope(self, angle_rad: Array) -> Array:
        return 1.0 / np.square(np.cos(np.asarray(angle_rad)))


CAMERA = Camera(
    name="own", size_px=(2048, 1900), focal_px=(652.0, 650.0), centre_px=(1030.0, 930.0), lens=Sine(1.9),
    max_angle_rad=float(np.radians(100)), calibrated_angle_rad=1.6, mirrored=True,
)  # fmt: skip
ORDER = ("fx", "fy", "cx", "cy", "m", "p1", "p2")


@pytest.fixture(autouse=True)
def register_lenses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lenses, "LENSES", (*lenses.LENSES, Sine))


def rays_to(angle_rad: float, count: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z, b = rng.uniform(np.cos(angle_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(b), np.sqrt(1 - z * z) * np.sin(b), z], axis=1)


def test_camera_file(tmp_path: Path) -> None:
    covariance = np.diag([0.04, 0.04, 0.01, 0.01, 1e-6, 1e-8, 1e-8])
    camera = replace(CAMERA, covariance_order=ORDER, covariance=covariance)
    save_camera(camera, tmp_path / "own.toml")
    text = (tmp_path / "own.toml").read_text()
    assert 'model = "sine"\n' in text and "m = 1.9\n" in text
    again = load_camera(tmp_path / "own.toml")
    assert again.lens == Sine(1.9)
    assert again.covariance_order == ORDER and np.array_equal(again.covariance, covariance)
    (tmp_path / "own.toml").write_text(text.replace("m = 1.9", 'm = "x"'))
    with pytest.raises(BadInput, match="m must be a number"):
        load_camera(tmp_path / "own.toml")
    (tmp_path / "own.toml").write_text(text.replace('"m"', '"k1"'))
    with pytest.raises(BadInput, match=r"covariance\.order"):
        load_camera(tmp_path / "own.toml")


def test_files_of_other_lenses_are_read_as_before() -> None:
    assert load_camera("fisheye-2048").lens == KannalaBrandt((0.0, 0.0, 0.0, 0.0))
    with pytest.raises(BadInput, match="m is missing"):
        camera_from_dict({key: value for key, value in camera_to_dict(CAMERA).items() if key != "m"})


def test_report_of_the_camera_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_camera(CAMERA, tmp_path / "own.toml")
    assert main(["calibrate", "show", str(tmp_path / "own.toml")]) == 0
    first, second = capsys.readouterr().out.splitlines()[:2]
    assert first.startswith("own: sine, 2048 x 1900 px, mirrored") and second.endswith("; m 1.9")


def test_schema() -> None:
    schema = camera_keys().schema()
    assert "sine" in schema["properties"]["model"]["enum"]
    keys = {"model": "sine", "m": 1.9, "size_px": [9, 9], "focal_px": [9, 9], "centre_px": [4, 4], "max_angle_deg": 90}
    jsonschema.validate(keys, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(keys | {"m": "x"}, schema)


def test_projection_and_its_inverse() -> None:
    rays = rays_to(CAMERA.max_angle_rad, 500)
    px, _ = CAMERA.project(rays)
    assert np.abs(CAMERA.unproject(px) - rays).max() < 1e-12
    assert Sine(1.9).max_invertible_rad == pytest.approx(1.9 * np.pi / 2, abs=1e-3)


def test_derivative_with_respect_to_the_ray() -> None:
    rays, step = rays_to(CAMERA.max_angle_rad, 200), 1e-6
    turned = [CAMERA.project_unlimited(Rotation.from_rotvec(step * axis).apply(rays)) for axis in np.eye(3)]
    back = [CAMERA.project_unlimited(Rotation.from_rotvec(-step * axis).apply(rays)) for axis in np.eye(3)]
    numeric = np.stack([(a - b) / (2 * step) for a, b in zip(turned, back, strict=True)], axis=-1)
    assert np.abs(CAMERA.jacobian_px_per_rad(rays) - numeric).max() < 1e-4


@pytest.mark.parametrize("lens", [Sine(1.9), KannalaBrandt((0.01, -0.002)), Pinhole()], ids=lambda lens: lens.model)
def test_derivatives_with_respect_to_the_parameters(lens: Lens) -> None:
    camera, step = replace(CAMERA, lens=lens, max_angle_rad=1.3), 1e-6
    rays, order = rays_to(1.3, 200), ("f", "fx", "fy", "cx", "cy", *lens.parameter_names, "p1", "p2")

    def pixels_after(name: str, by: float) -> np.ndarray:
        return with_update(camera, {name: by}).project_unlimited(rays)

    numeric = [(pixels_after(name, step) - pixels_after(name, -step)) / (2 * step) for name in order]
    np.testing.assert_allclose(lens_jacobian(camera, rays, order), np.stack(numeric, axis=-1), atol=1e-4)


def test_a_parameter_that_the_lens_does_not_have() -> None:
    with pytest.raises(ValueError, match="pinhole lens has no parameter k1"):
        lens_jacobian(replace(CAMERA, lens=Pinhole()), rays_to(0.5, 3), ("k1",))


@pytest.mark.parametrize("top_deg", [69, 120])
def test_world_coordinates_are_a_fit_with_its_error(top_deg: int) -> None:
    camera = replace(CAMERA, max_angle_rad=float(np.radians(top_deg)))
    R = Rotation.random(random_state=3).as_matrix()
    cards = wcs_cards(camera, R)
    assert cards is not None and "largest error" in str(cards["COMMENT2"])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The WCS transformation has more axes")
        wcs = WCS(fits.Header.fromstring(header_block(cards).decode("ascii")))
    rays = rays_to(camera.max_angle_rad - 1e-6, 2000)
    px, _ = camera.project(rays)
    ra, dec = np.radians(wcs.all_pix2world(px, 0).T)
    sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert np.abs(camera.project_unlimited(sky @ R.T) - px).max() < 0.07


def test_no_world_coordinates_rather_than_wrong_ones() -> None:
    assert wcs_cards(replace(CAMERA, lens=Steep(), max_angle_rad=float(np.radians(88))), np.eye(3)) is None


def test_formats_without_this_lens_refuse_it() -> None:
    for program in ("ros", "kalibr", "colmap", "opencv"):
        with pytest.raises(BadInput, match="sine"):
            to_text(replace(CAMERA, mirrored=False), program)


def calibrate_simulated(stars: int = 400, frames: int = 4, sigma_px: float = 0.1) -> tuple[Camera, tuple[str, ...]]:
    """Camera and candidates from simulated stars of CAMERA, from a rough equidistant start."""
    rng = np.random.default_rng(5)
    camera = replace(CAMERA, focal_px=(652.0, 652.0), mirrored=False)
    seen = [rays_to(np.radians(90), stars, seed) for seed in range(frames)]
    R = Rotation.random(frames, random_state=4).as_matrix()
    xy = [camera.project_unlimited(rays) + rng.normal(0, sigma_px, (stars, 2)) for rays in seen]
    rough = replace(camera, focal_px=(640.0, 640.0), centre_px=(1023.5, 949.5), lens=KannalaBrandt())
    sky = [rays @ r for rays, r in zip(seen, R, strict=True)]
    start = Rotation.from_rotvec([0.01, -0.008, 0.012]).as_matrix() @ R
    fit = fit_lens(rough, start, observations(xy, sky, sigma_px**2), square=True)
    return fit.camera, tuple(candidate.name for candidate in fit.candidates)


def test_calibration_tries_it_beside_the_others() -> None:
    camera, candidates = calibrate_simulated()
    assert "sine with m" in candidates and "Kannala-Brandt with 4 k" in candidates
    assert "pinhole" not in candidates  # stars beyond 65 degrees
    truth = replace(CAMERA, focal_px=(652.0, 652.0), mirrored=False)
    rays = rays_to(1.5, 500)
    assert np.abs(camera.project_unlimited(rays) - truth.project_unlimited(rays)).max() < 0.3


def test_calibration_of_it_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(lenses, "LENSES", (Sine,))
    camera, candidates = calibrate_simulated()
    assert candidates == ("sine with m",)
    assert camera.covariance is not None and camera.covariance_order == ("fx", "fy", "cx", "cy", "m")
    sigma = float(np.sqrt(camera.covariance[4, 4]))
    assert sigma < 1e-3
    assert abs(camera.lens.parameters["m"] - 1.9) < 4 * sigma
    save_camera(camera, tmp_path / "own.toml")
    assert load_camera(tmp_path / "own.toml").lens == camera.lens
