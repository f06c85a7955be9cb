"""The contract of `Lens` on every lens of LENSES, against derivatives by differences, astropy's WCS and drawn stars."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

from startrack.applications.calibration import fit_lens, observations
from startrack.camera import Camera, Lens, lenses, load_camera, save_camera
from startrack.core.types import Array
from startrack.output.wcs import header_block, wcs_cards

SHAPES = [shape for kind in lenses.LENSES for shape in kind.typical_shapes()]
NEAR_RAD = np.array([1e-2, 1e-3])
STEP_RAD = 1e-6


@dataclass(frozen=True)
class Nonsense(Lens):
    """A lens whose focal length is not its scale on the axis, and whose slope belongs to another one."""

    model: ClassVar[str] = "nonsense"
    label: ClassVar[str] = "nonsense"

    def rho(self, angle_rad: Array) -> Array:
        return np.square(np.sin(angle_rad))

    def slope(self, angle_rad: Array) -> Array:
        return np.square(np.cos(angle_rad))


@dataclass(frozen=True)
class Quadratic(Nonsense):
    """rho = a + a^2 / 10: no lens that is the same on both sides of its axis."""

    def rho(self, angle_rad: Array) -> Array:
        return angle_rad + 0.1 * np.square(angle_rad)

    def slope(self, angle_rad: Array) -> Array:
        return 1.0 + 0.2 * np.asarray(angle_rad)


def check_scale_on_axis(lens: Lens) -> None:
    """rho(a) = a + O(a^3): the third-order term is the same at two small angles, and small."""
    third = (lens.rho(NEAR_RAD) - NEAR_RAD) / NEAR_RAD**3
    assert np.abs(third).max() < 10.0
    assert abs(third[1] - third[0]) < 1e-3 + 0.1 * abs(third[0])


def check_slope(lens: Lens) -> None:
    angle = angles_of(lens)
    numeric = (lens.rho(angle + STEP_RAD) - lens.rho(angle - STEP_RAD)) / (2 * STEP_RAD)
    np.testing.assert_allclose(lens.slope(angle), numeric, rtol=1e-6, atol=1e-8)
    assert (numeric > 0).all()


def angles_of(lens: Lens) -> Array:
    """Angles [rad] at which the lens is used: below those at which its picture hardly grows any more."""
    angle = np.linspace(0.01, 0.99 * min(lens.max_invertible_rad, lens.max_fit_rad, np.radians(95.0)), 200)
    return angle[lens.slope(angle) > 0.2]


def camera_of(lens: Lens) -> Camera:
    top = float(angles_of(lens)[-1])
    focal = 900.0 / float(lens.rho(np.array(top)))
    return Camera(
        name="contract", size_px=(2048, 1900), focal_px=(focal, focal), centre_px=(1030.0, 930.0), lens=lens,
        max_angle_rad=top, calibrated_angle_rad=top,
    )  # fmt: skip


def rays_in(camera: Camera, count: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    z, b = rng.uniform(np.cos(camera.max_angle_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(b), np.sqrt(1 - z * z) * np.sin(b), z], axis=1)


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
def test_the_focal_length_is_the_scale_on_the_axis(lens: Lens) -> None:
    check_scale_on_axis(lens)


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
def test_the_slope_is_the_derivative_and_rises(lens: Lens) -> None:
    check_slope(lens)


def test_a_wrong_lens_breaks_the_contract() -> None:
    wrong = (check_scale_on_axis, Nonsense()), (check_slope, Nonsense()), (check_scale_on_axis, Quadratic())
    for check, lens in wrong:
        with pytest.raises(AssertionError):
            check(lens)
    check_slope(Quadratic())


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
def test_derivatives_by_parameters(lens: Lens) -> None:
    angle = angles_of(lens)
    for name in lens.parameter_names:
        numeric = (lens.with_update({name: 1e-6}).rho(angle) - lens.with_update({name: -1e-6}).rho(angle)) / 2e-6
        np.testing.assert_allclose(lens.derivative(name, angle), numeric, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
@pytest.mark.parametrize("mirrored", [False, True])
def test_pixels_give_the_rays_back(lens: Lens, mirrored: bool) -> None:
    np.testing.assert_allclose(lens.angle_rad(lens.rho(angles_of(lens))), angles_of(lens), atol=1e-9)
    camera = replace(camera_of(lens), mirrored=mirrored)
    rays = rays_in(camera, 500, 1)
    assert np.abs(camera.unproject(camera.project(rays)[0]) - rays).max() < 1e-9


@pytest.mark.parametrize("lens", [one for one in SHAPES if wcs_cards(camera_of(one), np.eye(3))], ids=repr)
def test_world_coordinates_are_those_of_the_lens(lens: Lens) -> None:
    """Of lenses that a FITS projection describes."""
    camera, R = camera_of(lens), Rotation.random(rng=np.random.default_rng(3)).as_matrix()
    cards = wcs_cards(camera, R)
    assert cards is not None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The WCS transformation has more axes")
        wcs = WCS(fits.Header.fromstring(header_block(cards).decode("ascii")))
    rays = rays_in(replace(camera, max_angle_rad=min(camera.max_angle_rad, 1.5) - 1e-6), 1000, 2)
    px, _ = camera.project(rays)
    ra, dec = np.radians(wcs.all_pix2world(px, 0).T)
    sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert np.abs(camera.project_unlimited(sky @ R.T) - px).max() < 0.1


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
def test_a_camera_file_holds_the_lens(lens: Lens, tmp_path) -> None:
    camera = camera_of(lens)
    save_camera(camera, tmp_path / "own.toml")
    again = load_camera(tmp_path / "own.toml")
    assert again.lens.model == lens.model
    assert np.array_equal(again.lens.rho(angles_of(lens)), lens.rho(angles_of(lens)))


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
def test_stars_calibrate_the_lens(lens: Lens, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a rough start to 0.05 px, where no other lens is tried."""
    monkeypatch.setattr(lenses, "LENSES", (type(lens),))
    camera, rng = camera_of(lens), np.random.default_rng(5)
    seen = [rays_in(camera, 300, 10 + k) for k in range(4)]
    R = Rotation.random(4, rng=rng).as_matrix()
    xy = [camera.project_unlimited(rays) + rng.normal(0, 0.05, (len(rays), 2)) for rays in seen]
    near = lens.with_update({name: -0.1 * value for name, value in lens.parameters.items()})
    rough = replace(camera, focal_px=tuple(0.99 * f for f in camera.focal_px), centre_px=(1027.0, 934.0), lens=near)
    start = Rotation.from_rotvec([0.005, -0.004, 0.006]).as_matrix() @ R
    sky = [rays @ r for rays, r in zip(seen, R, strict=True)]
    found = fit_lens(rough, start, observations(xy, sky, 0.05**2), square=True).camera
    rays = rays_in(camera, 500, 20)
    # A rotation of the frame and the lens share what a centre moves: compare beyond it.
    turn = Rotation.align_vectors(found.unproject(camera.project_unlimited(rays)), rays)[0]
    moved = found.project_unlimited(turn.apply(rays)) - camera.project_unlimited(rays)
    assert np.sqrt(np.mean(np.square(moved))) < 0.05
    assert found.lens.model == lens.model
