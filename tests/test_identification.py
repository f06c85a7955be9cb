"""Identification on synthetic detections of the real catalogue: right names, and refusals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from startrack.camera import Camera, Pinhole, load_camera
from startrack.catalog import load_catalog
from startrack.core.types import Detections, Identification, NotIdentified, SmoothImage, Stars
from startrack.estimation.false_alarm import coincidence_probability, density_per_sr, log_p_value
from startrack.frames import angle_between_rad
from startrack.identification import Identifier
from startrack.identification.triangles import triangles

ARCSEC = np.pi / 648_000
FISHEYE = load_camera("fisheye-2048")
NARROW = Camera(
    name="20 degrees", size_px=(1024, 1024), focal_px=(2900.0, 2900.0), centre_px=(511.5, 511.5),
    max_angle_rad=float(np.radians(15)), calibrated_angle_rad=float(np.radians(15)), lens=Pinhole(),
)  # fmt: skip
ZERO_MAG = 18.0  # of one electron


@lru_cache(maxsize=1)
def sky() -> Stars:
    return load_catalog().at(None, None)


@dataclass(frozen=True)
class Frame:
    detections: Detections
    star: np.ndarray  # true index into sky() of each detection, -1 for a false one
    R_cam_icrs: np.ndarray

    def clear_stars(self, camera: Camera) -> np.ndarray:
        """True stars with no other within 3.6 px that is at most 1.5 mag fainter: not blended."""
        px, inside = camera.project(sky().rays_icrs @ self.R_cam_icrs.T)
        seen = np.flatnonzero(inside)
        near = cKDTree(px[seen]).query_ball_point(self.detections.xy_px, 3.6)
        v = sky().v_mag

        def is_alone(s: int, others: list[int]) -> bool:
            return s >= 0 and not any(seen[j] != s and v[seen[j]] < v[s] + 1.5 for j in others)

        return np.array([is_alone(s, others) for s, others in zip(self.star, near, strict=True)])


def frame(
    camera: Camera, seed: int, limit: float = 6.0, false: float = 0.2, hidden: float = 0.5, noise_px: float = 0.2,
    brightest: int | None = None, some: int | None = None,
) -> Frame:  # fmt: skip
    """Stars above the limit at a random attitude, one side of the field hidden, with random false stars."""
    rng = np.random.default_rng([seed, camera.size_px[0]])
    R = Rotation.random(random_state=rng).as_matrix()
    px, inside = camera.project(sky().rays_icrs @ R.T)
    star = np.flatnonzero(inside & (sky().v_mag < limit))
    side = (px[star] - camera.centre_px) @ rng.normal(size=2)
    star = star[side >= np.quantile(side, hidden)][:brightest]
    star = star if some is None else np.sort(rng.permutation(star)[:some])
    wrong = random_positions(camera, round(false * len(star)), rng)
    xy = np.concatenate([px[star] + rng.normal(0, noise_px, (len(star), 2)), wrong])
    v = sky().v_mag[star] + rng.normal(0, 0.1, len(star))
    v = np.concatenate([v, rng.choice(v, len(wrong))])
    order = np.argsort(v)
    truth = np.concatenate([star, np.full(len(wrong), -1)])
    return Frame(make_detections(xy[order], v[order], noise_px), truth[order], R)


def random_positions(camera: Camera, n: int, rng: np.random.Generator) -> np.ndarray:
    xy = rng.uniform(0, np.array(camera.size_px) - 1, (3 * n + 10, 2))
    return xy[camera.angle_rad(xy) < camera.max_angle_rad][:n]


def make_detections(xy_px: np.ndarray, v_mag: np.ndarray, sigma_px: float) -> Detections:
    """Detections, brightest first, from positions and magnitudes."""
    n, flux = len(xy_px), 10 ** (-0.4 * (v_mag - ZERO_MAG))
    return Detections(
        xy_px=xy_px, covariance_px2=np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)), flux_e=flux,
        flux_sigma_e=np.sqrt(flux + 1e8), snr=flux / np.sqrt(flux + 1e8), saturated=np.zeros(n, dtype=bool),
        psf_sigma_px=1.0, image_e=np.zeros((2, 2), np.float32), dead=np.zeros((2, 2), bool),
        background=SmoothImage.of(np.zeros((2, 2), np.float32)), noise=SmoothImage.of(np.ones((2, 2), np.float32)),
    )  # fmt: skip


def attitude_error_rad(found: Identification, truth: Frame) -> float:
    """Attitude error [rad]."""
    return float(Rotation.from_matrix(truth.R_cam_icrs @ found.R_cam_icrs.T).magnitude())


CASES = {
    "a crater's floor": (FISHEYE, {}, 30),
    "a tenth of the sky": (FISHEYE, {"hidden": 0.9}, 60),
    "half a pixel of noise": (FISHEYE, {"noise_px": 0.5}, 60),
    "four false ones for each true": (FISHEYE, {"false": 4.0, "limit": 5.0}, 40),
    "a long exposure": (FISHEYE, {"limit": 7.5}, 15),
    "20 degrees of sky": (NARROW, {"limit": 8.0, "hidden": 0.0}, 40),
    "20 degrees, half hidden": (NARROW, {"limit": 8.0}, 60),
}


@pytest.mark.parametrize("case", CASES)
def test_random_attitudes_are_identified(case: str) -> None:
    camera, how, arcsec = CASES[case]
    right = named = plain = plain_named = 0
    for seed in range(3 if camera is FISHEYE else 1):
        truth = frame(camera, seed, **how)
        found = Identifier()(truth.detections, camera, sky())
        assert attitude_error_rad(found, truth) < arcsec * ARCSEC
        assert found.false_alarm_probability < 1e-30
        assert len(set(found.star.tolist())) == len(set(found.detection.tolist())) == len(found)  # one to one
        right += int(np.count_nonzero(truth.star[found.detection] == found.star))
        named += len(found)
        clear = truth.clear_stars(camera)
        plain += int(clear.sum())
        plain_named += int(clear[found.detection].sum())
    assert right >= 0.995 * named  # precision
    assert plain_named >= (0.97 if "noise_px" in how else 0.99) * plain  # recall, of stars that are not blends


FEW = {
    "the 10 brightest": {"brightest": 10, "limit": 5.0},
    "the 8 brightest": {"brightest": 8, "limit": 5.0},
    "10 of those above V 4": {"some": 10, "limit": 4.0},
    "8 of those above V 4": {"some": 8, "limit": 4.0},
    "10 bright and 4 false": {"brightest": 10, "limit": 5.0, "false": 0.4},
}


@pytest.mark.parametrize("case", FEW)
def test_a_handful_of_stars_is_enough(case: str) -> None:
    solved = 0
    for seed in range(6):
        truth = frame(FISHEYE, seed, **({"false": 0.0} | FEW[case]))
        try:
            found = Identifier()(truth.detections, FISHEYE, sky())
        except NotIdentified:
            continue
        solved += 1
        assert attitude_error_rad(found, truth) < 200 * ARCSEC
        assert np.array_equal(truth.star[found.detection], found.star)
        assert found.false_alarm_probability < 1e-9
    assert solved == 6


def test_ten_stars_in_a_narrow_field() -> None:
    for seed in range(2):
        truth = frame(NARROW, seed, brightest=10, limit=7.0, hidden=0.0, false=0.0)
        found = Identifier()(truth.detections, NARROW, sky())
        assert np.array_equal(truth.star[found.detection], found.star)


@pytest.mark.parametrize("count", [20, 300])
@pytest.mark.parametrize("clustered", [False, True], ids=["uniform", "clustered"])
def test_random_detections_are_refused(count: int, clustered: bool) -> None:
    rng = np.random.default_rng(count)
    xy = random_positions(FISHEYE, count, rng)
    if clustered:
        middles = rng.uniform(500, 1500, (5, 2))
        xy = middles[rng.integers(5, size=count)] + rng.normal(0, 90, (count, 2))
    v = np.sort(6 + np.log(rng.random(len(xy))) / 1.08)  # the magnitudes of a real sky
    with pytest.raises(NotIdentified, match="chance") as caught:
        Identifier()(make_detections(xy, v, 0.2), FISHEYE, sky())
    assert caught.value.reason == "not_identified"
    assert caught.value.evidence["detected"] == count


def test_random_detections_in_a_narrow_field_are_refused() -> None:
    rng = np.random.default_rng(3)
    xy = random_positions(NARROW, 60, rng)
    with pytest.raises(NotIdentified, match="chance"):
        Identifier()(make_detections(xy, np.sort(rng.uniform(3, 8, len(xy))), 0.2), NARROW, sky())


CHANCE_FIELDS = {"wide": (FISHEYE, 10.0, 1.0, 400), "narrow": (NARROW, 2.0, 0.15, 8000)}  # cap and radius [deg], stars


@pytest.mark.parametrize("field", CHANCE_FIELDS)
@pytest.mark.parametrize("clustered", [False, True], ids=["uniform", "clustered"])
def test_stated_false_alarm_probabilities_are_true(clustered: bool, field: str) -> None:
    """p-values of random attitudes over random detections: at least as large as the true ones, and not much larger."""
    camera, cap_deg, radius_deg, stars = CHANCE_FIELDS[field]
    rng, width = np.random.default_rng(4), camera.size_px[0]
    bright = sky().rays_icrs[:stars]
    radius, p_values = np.radians(radius_deg), []
    for _ in range(12):
        xy = random_positions(camera, 150, rng)
        if clustered:
            xy = rng.uniform(0.3, 0.7, (6, 2))[rng.integers(6, size=150)] * width
            xy += rng.normal(0, 0.06 * width, (150, 2))
        rays = camera.unproject(xy)
        density = density_per_sr(rays, np.radians(cap_deg))
        each = coincidence_probability(density * np.pi * radius**2)
        tree = cKDTree(rays)
        for R in Rotation.random(60, random_state=rng).as_matrix():
            cam = bright @ R.T
            cam = cam[camera.project(cam)[1]]
            hits = np.count_nonzero(tree.query(cam)[0] < 2 * np.sin(radius / 2))
            p_values.append(np.exp(log_p_value(hits, len(cam), each, free=0)))
    p = np.array(p_values)
    for level in (0.2, 0.05, 0.01):
        share = np.mean(p <= level)
        assert share <= level + 3 * np.sqrt(level / len(p))
        assert clustered or share > 0.15 * level


def test_a_mirrored_frame_is_named_as_such() -> None:
    truth = frame(FISHEYE, 1)
    flipped = truth.detections.xy_px * [-1, 1] + [2 * FISHEYE.centre_px[0], 0]
    mirrored = replace(truth.detections, xy_px=flipped)
    with pytest.raises(NotIdentified, match="mirror image") as caught:
        Identifier()(mirrored, FISHEYE, sky())
    assert caught.value.reason == "mirrored"
    found = Identifier()(mirrored, replace(FISHEYE, mirrored=True), sky())
    assert attitude_error_rad(found, truth) < 30 * ARCSEC


@pytest.mark.parametrize("error", [0.97, 0.99, 1.01, 1.03])
def test_a_wrong_focal_length_is_refused(error: float) -> None:
    """Triangles of neighbours match at focal lengths 1 to 3 % off; the attitude would be 1 to 3 degrees off."""
    wrong = replace(FISHEYE, focal_px=(652.0 * error, 652.0 * error))
    with pytest.raises(NotIdentified, match=r"calibration of this lens|camera file right") as caught:
        Identifier()(frame(FISHEYE, 0).detections, wrong, sky())
    assert caught.value.reason == "not_identified"


def test_a_slightly_wrong_focal_length_gives_a_small_error() -> None:
    truth = frame(FISHEYE, 0)
    found = Identifier()(truth.detections, replace(FISHEYE, focal_px=(652.65, 652.65)), sky())  # 1.5 px at the rim
    assert np.mean(truth.star[found.detection] == found.star) > 0.99
    assert attitude_error_rad(found, truth) < 250 * ARCSEC


def test_a_rough_camera_may_be_used_to_begin_a_calibration() -> None:
    truth, wrong = frame(FISHEYE, 0), replace(FISHEYE, focal_px=(650.0, 650.0))
    found = Identifier(whole_field=False)(truth.detections, wrong, sky())
    assert np.mean(truth.star[found.detection] == found.star) > 0.95
    assert attitude_error_rad(found, truth) < np.radians(1)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_detections_are_refused(count: int) -> None:
    xy = random_positions(FISHEYE, 50, np.random.default_rng(5))[:count]
    with pytest.raises(NotIdentified, match=f"{count} point sources?: too few"):
        Identifier()(make_detections(xy, np.linspace(1, 3, count), 0.2), FISHEYE, sky())


def test_detections_outside_the_image_circle_are_ignored() -> None:
    truth = frame(FISHEYE, 2)
    corner = np.stack([np.linspace(1, 120, 200), np.linspace(120, 1, 200)], axis=1)
    v = np.concatenate([np.full(200, -5.0), -2.5 * np.log10(truth.detections.flux_e) + ZERO_MAG])
    crowded = make_detections(np.concatenate([corner, truth.detections.xy_px]), v, 0.2)
    found = Identifier()(crowded, FISHEYE, sky())
    assert attitude_error_rad(found, truth) < 30 * ARCSEC
    assert found.detection.min() >= 200


def test_bright_false_detections_are_counted_as_unexplained() -> None:
    truth = frame(FISHEYE, 3, false=0.0)
    strangers = random_positions(FISHEYE, 9, np.random.default_rng(6))
    v = np.concatenate([np.full(9, -3.0), -2.5 * np.log10(truth.detections.flux_e) + ZERO_MAG])
    found = Identifier()(make_detections(np.concatenate([strangers, truth.detections.xy_px]), v, 0.2), FISHEYE, sky())
    assert attitude_error_rad(found, truth) < 30 * ARCSEC
    assert 7 <= found.unexplained <= 9  # one or two of them may lie beside a faint star
    assert not np.isin(found.detection, np.arange(9)).any()


def test_saturated_stars_may_be_brighter_than_they_look() -> None:
    truth = frame(FISHEYE, 4, false=0.0)
    d = truth.detections
    clipped = np.minimum(d.flux_e, 3e5)
    dull = replace(d, flux_e=clipped, saturated=d.flux_e > 3e5)
    found = Identifier()(dull, FISHEYE, sky())
    bright = np.flatnonzero((d.flux_e > 3e5) & truth.clear_stars(FISHEYE))
    assert len(bright) > 40
    assert np.isin(bright, found.detection).mean() > 0.95


def test_the_order_of_equal_inputs_does_not_matter_and_the_answer_is_repeatable() -> None:
    truth = frame(FISHEYE, 5)
    once, again = (Identifier()(truth.detections, FISHEYE, sky()) for _ in range(2))
    assert np.array_equal(once.R_cam_icrs, again.R_cam_icrs)
    assert np.array_equal(once.star, again.star)


def rays_about(n: int, half_rad: float, seed: int) -> np.ndarray:
    """Random rays within an angle of the z axis."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(np.cos(half_rad), 1, n)
    azimuth = rng.uniform(0, 2 * np.pi, n)
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)


def test_triangles_are_all_that_there_are() -> None:
    rays, reach = rays_about(25, 0.6, 1), 0.45
    found = triangles(rays, reach)
    listed = {tuple(sorted(v)) for v in found.vertices.tolist()}
    expected = set()
    for i, j, k in combinations(range(25), 3):
        sides = np.sort([float(angle_between_rad(rays[a], rays[b])) for a, b in ((i, j), (j, k), (i, k))])
        flat = abs(np.dot(rays[i], np.cross(rays[j], rays[k]))) <= 0.025 * sides[2] ** 2
        if sides[2] < reach and not flat and np.diff(sides).min() > 0.01 * sides[2]:
            expected.add((i, j, k))
    assert listed == expected
    assert len(found) == len(listed) > 100
    for (a, b, c), sides, handed in zip(found.vertices, found.sides_rad, found.handedness, strict=True):
        opposite = [angle_between_rad(rays[p], rays[q]) for p, q in ((b, c), (c, a), (a, b))]
        assert sides == pytest.approx(opposite, abs=1e-12)  # each vertex is listed by the side opposite to it
        assert np.all(np.diff(sides) > 0)
        assert handed == np.sign(np.dot(rays[a], np.cross(rays[b], rays[c])))


def test_triangles_keep_their_sides_under_rotation_and_change_handedness_in_a_mirror() -> None:
    rays = rays_about(15, 0.5, 2)
    plain = triangles(rays, 0.6)
    rotated = triangles(rays @ Rotation.random(random_state=3).as_matrix().T, 0.6)
    assert np.array_equal(rotated.vertices, plain.vertices)
    assert rotated.sides_rad == pytest.approx(plain.sides_rad, abs=1e-12)
    assert np.array_equal(rotated.handedness, plain.handedness)
    assert np.array_equal(triangles(rays * [-1, 1, 1], 0.6).handedness, -plain.handedness)


def test_few_rays_make_no_triangles_and_a_cap_keeps_the_brightest() -> None:
    assert len(triangles(np.zeros((0, 3)), 0.5)) == 0
    assert len(triangles(rays_about(2, 0.3, 4), 0.5)) == 0
    capped = triangles(rays_about(30, 0.3, 5), 0.6, most=200)
    assert len(capped) <= 200
    assert capped.vertices.max() < 15
