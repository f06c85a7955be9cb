"""The contract of `Lens` on every lens of LENSES, against derivatives by differences, astropy's WCS and drawn stars."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation

from startrack.applications.calibration import fit_lens, observations
from startrack.camera import Camera, Lens, camera_keys, lenses, load_camera, save_camera
from startrack.core.declaration import Flag, Key, List, Number
from startrack.core.types import Array
from startrack.output.wcs import header_block, wcs_cards

SHAPES = [shape for kind in lenses.LENSES for shape in kind.typical_shapes()]
WITHOUT_WCS: tuple[type[Lens], ...] = ()  # lenses that no FITS projection describes
NEAR_RAD = np.array([1e-2, 1e-3])
STEP = 1e-6  # of a difference, of angles [rad] and of parameters
CHANGE = 0.05  # of each parameter: what is right at one value may be wrong beside it
MOST_RAD = np.radians(95.0)


def changed(lens: Lens) -> list[Lens]:
    """The lens, and those beside it: each parameter changed to either side."""
    return [lens, *(lens.with_update({name: by}) for name in lens.parameter_names for by in (CHANGE, -CHANGE))]


CHANGED = [lens for shape in SHAPES for lens in changed(shape)]


def angles_of(lens: Lens, count: int = 201) -> Array:
    """Angles [rad] from near the axis to where the radius, by itself, stops rising, or a calibration ends."""
    angle = np.linspace(0.0, min(lens.max_fit_rad, MOST_RAD), 4001)
    rising = np.diff(lens.rho(angle)) > 0
    top = angle[-1] if rising.all() else angle[np.argmin(rising)]
    return np.linspace(0.01, 0.98 * top, count)


def slope_by_difference(lens: Lens, angle_rad: Array) -> Array:
    return (lens.rho(angle_rad + STEP) - lens.rho(angle_rad - STEP)) / (2 * STEP)


def check_scale_on_axis(lens: Lens) -> None:
    """rho(a) = a + O(a^3): the third-order term is the same at two small angles, and small."""
    third = (lens.rho(NEAR_RAD) - NEAR_RAD) / NEAR_RAD**3
    assert np.abs(third).max() < 10.0
    assert abs(third[1] - third[0]) < 1e-3 + 0.1 * abs(third[0])


def check_smoothness(lens: Lens) -> None:
    """Over half the step the slope changes by half: it has no jump."""
    fine = slope_by_difference(lens, angles_of(lens, 401))
    assert np.abs(np.diff(fine)).max() < 0.7 * np.abs(np.diff(fine[::2])).max() + 1e-6


def check_slope(lens: Lens) -> None:
    angle = angles_of(lens)
    numeric = slope_by_difference(lens, angle)
    np.testing.assert_allclose(lens.slope(angle), numeric, rtol=1e-6, atol=1e-8)
    assert (numeric > 0).all()


def check_derivatives(lens: Lens) -> None:
    angle = angles_of(lens)
    for name in lens.parameter_names:
        more, less = (lens.with_update({name: by}).rho(angle) for by in (STEP, -STEP))
        np.testing.assert_allclose(lens.derivative(name, angle), (more - less) / (2 * STEP), rtol=1e-6, atol=1e-8)


def check_inverse(lens: Lens) -> None:
    np.testing.assert_allclose(lens.angle_rad(lens.rho(angles_of(lens))), angles_of(lens), atol=1e-9)


CHECKS = check_scale_on_axis, check_smoothness, check_slope, check_derivatives, check_inverse


@pytest.mark.parametrize("lens", CHANGED, ids=repr)
@pytest.mark.parametrize("check", CHECKS)
def test_the_law_of_every_lens(check: Callable[[Lens], None], lens: Lens) -> None:
    check(lens)


@dataclass(frozen=True)
class Nonsense(Lens):
    """An equidistant lens, which the classes below make wrong."""

    model: ClassVar[str] = "nonsense"
    label: ClassVar[str] = "nonsense"
    parameter_names: ClassVar[tuple[str, ...]] = ("k1",)
    k1: float = 0.0

    def rho(self, angle_rad: Array) -> Array:
        return np.asarray(angle_rad) + self.k1 * np.power(angle_rad, 3)

    def slope(self, angle_rad: Array) -> Array:
        return 1.0 + 3.0 * self.k1 * np.square(angle_rad)

    def derivative(self, name: str, angle_rad: Array) -> Array:
        return np.power(angle_rad, 3)


class OtherScale(Nonsense):
    """Its focal length is not its scale on the axis."""

    def rho(self, angle_rad: Array) -> Array:
        return 1.1 * super().rho(angle_rad)

    def slope(self, angle_rad: Array) -> Array:
        return 1.1 * super().slope(angle_rad)

    def derivative(self, name: str, angle_rad: Array) -> Array:
        return 1.1 * super().derivative(name, angle_rad)


class Quadratic(Nonsense):
    """Not the same on both sides of its axis."""

    def rho(self, angle_rad: Array) -> Array:
        return super().rho(angle_rad) + 0.1 * np.square(angle_rad)

    def slope(self, angle_rad: Array) -> Array:
        return super().slope(angle_rad) + 0.2 * np.asarray(angle_rad)


class Kinked(Nonsense):
    """Beyond 0.5 rad its picture hardly grows."""

    def rho(self, angle_rad: Array) -> Array:
        return super().rho(np.minimum(angle_rad, 0.5)) + 0.1 * np.maximum(np.asarray(angle_rad) - 0.5, 0.0)

    def slope(self, angle_rad: Array) -> Array:
        return np.where(np.asarray(angle_rad) < 0.5, super().slope(angle_rad), 0.1)

    def derivative(self, name: str, angle_rad: Array) -> Array:
        return super().derivative(name, np.minimum(angle_rad, 0.5))


class FlatSlope(Nonsense):
    """Its slope beyond 0.5 rad is not its radius's."""

    def slope(self, angle_rad: Array) -> Array:
        return np.where(np.asarray(angle_rad) < 0.5, super().slope(angle_rad), 0.15)


class EndedSlope(Nonsense):
    """Its slope says that it ends at 0.5 rad, where its radius rises on."""

    def slope(self, angle_rad: Array) -> Array:
        return np.where(np.asarray(angle_rad) < 0.5, super().slope(angle_rad), 0.0)


class FirstOrder(Nonsense):
    """Its derivative by the parameter is right where that is 0."""

    def rho(self, angle_rad: Array) -> Array:
        return super().rho(angle_rad) + self.k1**2 * np.power(angle_rad, 5)

    def slope(self, angle_rad: Array) -> Array:
        return super().slope(angle_rad) + 5.0 * self.k1**2 * np.power(angle_rad, 4)


class FixedInverse(Nonsense):
    """Its inverse is right where the parameter is 0."""

    def angle_rad(self, rho: Array) -> Array:
        return np.asarray(rho)


WRONG: dict[type[Lens], set[Callable[[Lens], None]]] = {  # lenses, and the checks that they fail
    Nonsense: set(),
    OtherScale: {check_scale_on_axis},
    Quadratic: {check_scale_on_axis},
    Kinked: {check_smoothness},
    FlatSlope: {check_slope, check_inverse},
    EndedSlope: {check_slope, check_inverse},
    FirstOrder: {check_derivatives},
    FixedInverse: {check_inverse},
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_lens_breaks_the_contract(kind: type[Lens]) -> None:
    broken = set()
    for check in CHECKS:
        for lens in (one for shape in kind.typical_shapes() for one in changed(shape)):
            try:
                check(lens)
            except AssertionError:
                broken.add(check)
    assert broken == WRONG[kind]


@pytest.mark.parametrize("kind", lenses.LENSES)
def test_a_key_of_a_camera_file_has_one_declaration(kind: type[Lens]) -> None:
    """The schema of camera files, which is for all lenses, has the keys that a file of this lens is checked by."""
    of_all = camera_keys().keys
    for key, declared in camera_keys(kind).keys.items():
        assert replace(of_all[key], required=False) == replace(declared, required=False), key


@pytest.mark.parametrize(
    ("key", "declared", "agrees"),
    [
        ("k", Number(), False),  # of another lens
        ("size_px", Number(), False),  # of every camera file
        ("mirrored", Number(), False),
        ("mirrored", Flag(default=False, required=True), True),
        ("k", List(each=Number(low=-1e3, high=1e3), most=4, description="k1 to k4", required=True), True),
        ("q", Number(), True),
    ],
)
def test_a_key_that_a_lens_declares_otherwise_is_named(
    monkeypatch: pytest.MonkeyPatch, key: str, declared: Key, agrees: bool
) -> None:
    class Renamed(Nonsense):
        @classmethod
        def file_keys(cls) -> dict[str, Key]:
            return {key: declared}

    before = camera_keys().keys
    monkeypatch.setattr(lenses, "LENSES", (*lenses.LENSES, Renamed))
    if agrees:
        after = camera_keys().keys
        assert set(after) == {*before, key}
        assert {one for one in before if after[one] != before[one]} == {"model"}
    else:
        with pytest.raises(ValueError, match=f"the nonsense lens declares the key '{key}' .* otherwise"):
            camera_keys()


def camera_of(lens: Lens, least_slope: float = 0.0) -> Camera:
    """A camera to the last of `angles_of` at which the slope is more than `least_slope`."""
    angle = angles_of(lens)
    top = float(angle[slope_by_difference(lens, angle) > least_slope][-1])
    focal = 900.0 / float(lens.rho(np.array(top)))
    return Camera(
        name="contract", size_px=(2048, 1900), focal_px=(focal, focal), centre_px=(1030.0, 930.0), lens=lens,
        max_angle_rad=top, calibrated_angle_rad=top,
    )  # fmt: skip


def rays_in(camera: Camera, count: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    z, b = rng.uniform(np.cos(camera.max_angle_rad), 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(b), np.sqrt(1 - z * z) * np.sin(b), z], axis=1)


@pytest.mark.parametrize("lens", CHANGED, ids=repr)
@pytest.mark.parametrize("mirrored", [False, True])
def test_pixels_give_the_rays_back(lens: Lens, mirrored: bool) -> None:
    camera = replace(camera_of(lens), mirrored=mirrored)
    rays = rays_in(camera, 500, 1)
    assert np.abs(camera.unproject(camera.project(rays)[0]) - rays).max() < 1e-9


@pytest.mark.parametrize("lens", CHANGED, ids=repr)
def test_world_coordinates_are_those_of_the_lens(lens: Lens) -> None:
    camera, R = camera_of(lens), Rotation.random(rng=np.random.default_rng(3)).as_matrix()
    cards = wcs_cards(camera, R)
    assert (cards is None) == isinstance(lens, WITHOUT_WCS)
    if cards is None:
        return
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The WCS transformation has more axes")
        wcs = WCS(fits.Header.fromstring(header_block(cards).decode("ascii")))
    rays = rays_in(replace(camera, max_angle_rad=min(camera.max_angle_rad, 1.5) - 1e-6), 1000, 2)
    px, _ = camera.project(rays)
    ra, dec = np.radians(wcs.all_pix2world(px, 0).T)
    sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert np.abs(camera.project_unlimited(sky @ R.T) - px).max() < 0.1


@pytest.mark.parametrize("lens", CHANGED, ids=repr)
def test_a_camera_file_holds_the_lens(lens: Lens, tmp_path) -> None:
    camera = camera_of(lens)
    save_camera(camera, tmp_path / "own.toml")
    again = load_camera(tmp_path / "own.toml")
    assert again.lens.model == lens.model
    assert np.array_equal(again.lens.rho(angles_of(lens)), lens.rho(angles_of(lens)))


@pytest.mark.parametrize("lens", SHAPES, ids=repr)
def test_stars_calibrate_the_lens(lens: Lens, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a rough start, whose radius may turn earlier, to 0.05 px, where no other lens is tried."""
    monkeypatch.setattr(lenses, "LENSES", (type(lens),))
    camera, rng = camera_of(lens, 0.2), np.random.default_rng(5)
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
