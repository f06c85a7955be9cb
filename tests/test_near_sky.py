"""Where the camera points, as a user states it: weak frames are identified, and none wrongly."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from star_painter import flux_of, paint
from test_identification import FISHEYE, Frame, frame, make_detections, random_positions, sky

import startrack
from startrack.camera import Camera, Pinhole, Sensor, save_camera
from startrack.cli.main import main
from startrack.core.types import Exposure, Identification, NotIdentified
from startrack.exposure import write_exposure
from startrack.frames import angle_between_rad
from startrack.identification import Identifier, NearSky, identify_unknown_lens
from startrack.identification.attitude_search import MIN_MATCHES, MIN_MATCHES_NEAR_SKY
from startrack.identification.hypotheses import HypothesisSearch, Window
from startrack.identification.lens_guesses import guess_fields
from startrack.identification.similar_triangles import STRAIGHT, patterns_for

SAMPLES = Path(__file__).parents[1] / "sample_images"
BACKGROUND_E, PSF_PX = 100.0, 1.2
TEN_DEGREES = Camera(
    name="10 degrees", size_px=(512, 512), focal_px=(2926.0, 2926.0), centre_px=(255.5, 255.5),
    max_angle_rad=float(np.radians(7.2)), calibrated_angle_rad=float(np.radians(7.2)), lens=Pinhole(),
    sensor=Sensor(zero_point_e_per_s=1e5, psf_sigma_px=PSF_PX),
)  # fmt: skip


def pointing_deg(R_cam_icrs: np.ndarray) -> tuple[float, float]:
    """Right ascension and declination of the optical axis."""
    x, y, z = R_cam_icrs[2]
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(z)))


def near_sky(R_cam_icrs: np.ndarray, radius_deg: float, seed: int, off_1: float = 0.8) -> NearSky:
    """A cap of this radius, its centre off the axis by a part of it in a random direction."""
    ra_deg, dec_deg = pointing_deg(R_cam_icrs)
    side = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    dec = float(np.clip(dec_deg + off_1 * radius_deg * np.sin(side), -90, 90))
    return NearSky.from_degrees((ra_deg + 0.5 * off_1 * radius_deg * np.cos(side), dec, radius_deg))


def identified(one: Frame, camera: Camera, near: NearSky | None) -> Identification | None:
    try:
        return Identifier(near_sky=near)(one.detections, camera, sky())
    except NotIdentified:
        return None


def painted(seed: int, faintest_snr: float = 6.5, brightest: int = 5) -> tuple[Exposure, np.ndarray]:
    """A picture of 10 degrees whose fifth brightest star is barely seen, and its attitude."""
    one = frame(TEN_DEGREES, seed, limit=10.0, false=0.0, hidden=0.0, noise_px=0.0)
    v_mag = sky().v_mag[one.star]
    flux = flux_of(faintest_snr, PSF_PX, BACKGROUND_E) * 10 ** (-0.4 * (v_mag - v_mag[brightest - 1]))
    image = np.full(TEN_DEGREES.size_px[::-1], BACKGROUND_E)
    paint(image, one.detections.xy_px, flux, PSF_PX)
    counts = np.random.default_rng(seed).poisson(image).astype(np.float32)
    return Exposure(pixels_adu=counts, saturation_adu=65535.0, name=f"{seed}.fits"), one.R_cam_icrs


def count_sources(exposure: Exposure) -> int:
    return len(startrack.detect(exposure, camera=TEN_DEGREES).result.detections)


def test_weak_pictures_are_identified_only_with_it() -> None:
    refused = gained = 0
    for seed in range(20):
        exposure, R = painted(seed)
        if startrack.identify(exposure, camera=TEN_DEGREES).status == "ok":
            continue
        refused += 1
        ra, dec = pointing_deg(R)
        found = startrack.identify(exposure, camera=TEN_DEGREES, near_sky=(ra, dec + 1.5, 3.0))
        if found.status == "ok":
            gained += 1
            assert angle_between_rad(found.attitude.rotation.as_matrix()[2], R[2]) < np.radians(0.05)
    assert refused == 6  # with 5 or 6 point sources
    assert gained == 5


@pytest.mark.parametrize(
    ("camera", "how", "least_with", "most_without"),
    [(TEN_DEGREES, {"brightest": 5, "limit": 8.0}, 18, 0),
     (TEN_DEGREES, {"brightest": 5, "limit": 8.0, "false": 0.6}, 18, 0),
     (FISHEYE, {"some": 6, "limit": 4.5, "false": 1.0}, 18, 6),
     (FISHEYE, {"some": 6, "limit": 4.5, "false": 3.0}, 14, 1)],
)  # fmt: skip
def test_few_stars_suffice(camera: Camera, how: dict[str, float], least_with: int, most_without: int) -> None:
    without = with_it = 0
    for seed in range(20):
        one = frame(camera, seed, **{"hidden": 0.0, "false": 0.0} | how)
        without += identified(one, camera, None) is not None
        found = identified(one, camera, near_sky(one.R_cam_icrs, 3.0, seed))
        if found is not None:
            with_it += 1
            assert angle_between_rad(found.R_cam_icrs[2], one.R_cam_icrs[2]) < np.radians(0.2)
    assert with_it >= least_with
    assert without <= most_without


@pytest.mark.slow
@pytest.mark.parametrize("camera", [TEN_DEGREES, FISHEYE])
def test_a_wrong_part_of_the_sky_gives_no_identification(camera: Camera) -> None:
    rng, answers = np.random.default_rng(8), 0
    for seed in range(100):
        limit, stars = 6.0 if camera is FISHEYE else 9.0, int(rng.integers(5, 40))
        one = frame(camera, seed, limit=limit, hidden=0.0, brightest=stars)
        wrong = rng.normal(size=3)
        ra, dec = pointing_deg(np.tile(wrong / np.linalg.norm(wrong), (3, 1)))
        near = NearSky.from_degrees((ra, dec, float(rng.uniform(2, 20))))
        if not near.contains(one.R_cam_icrs):
            answers += identified(one, camera, near) is not None
    assert answers == 0


def test_points_that_are_no_stars_are_not_identified() -> None:
    rng = np.random.default_rng(6)
    for _ in range(60):
        xy = random_positions(TEN_DEGREES, int(rng.integers(MIN_MATCHES_NEAR_SKY, 12)), rng)
        points = make_detections(xy, np.sort(rng.uniform(1, 6, len(xy))), 0.5)
        near = NearSky.from_degrees((rng.uniform(0, 360), rng.uniform(-80, 80), 5.0))
        with pytest.raises(NotIdentified):
            Identifier(near_sky=near)(points, TEN_DEGREES, sky())


def test_names_of_a_good_frame_are_the_same() -> None:
    one = frame(FISHEYE, 3)
    plain, near = identified(one, FISHEYE, None), identified(one, FISHEYE, near_sky(one.R_cam_icrs, 5.0, 3))
    assert plain is not None and near is not None
    np.testing.assert_array_equal(near.star, plain.star)
    np.testing.assert_array_equal(near.detection, plain.detection)


def test_a_part_of_the_sky_has_its_share_of_it() -> None:
    assert NearSky.from_degrees((0, 0, 180)).part == pytest.approx(1.0)
    assert NearSky.from_degrees((0, 0, 90)).part == pytest.approx(0.5)
    near = NearSky.from_degrees((90.0, 30.0, 5.0))
    axis = np.array([0.0, np.cos(np.radians(30)), np.sin(np.radians(30))])
    assert near.contains(np.stack([np.eye(3)[0], np.eye(3)[1], axis]))
    assert not near.contains(np.eye(3))
    assert MIN_MATCHES_NEAR_SKY < MIN_MATCHES


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exposure, R = next(one for one in map(painted, range(20)) if count_sources(one[0]) == MIN_MATCHES_NEAR_SKY)
    image, camera = tmp_path / "weak.fits", tmp_path / "ten.toml"
    write_exposure(image, exposure)
    save_camera(replace(TEN_DEGREES, name="ten"), camera)
    words = ["identify", str(image), "-c", str(camera), "-D", str(tmp_path / "out"), "--no-plots", "--json"]
    assert main(words) == 3
    assert json.loads(capsys.readouterr().out)["reason"] == "not_identified"
    ra, dec = pointing_deg(R)
    assert main([*words, f"--near-sky={ra:.1f},{dec:.1f},2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["stars"]["identified"] == found["stars"]["detected"] == MIN_MATCHES_NEAR_SKY
    assert main([*words, "-O", f"--near-sky={ra:.1f},{-dec:.1f},2"]) == 3
    refused = json.loads(capsys.readouterr().out)
    assert "within 2 degrees about RA" in refused["message"] and "if the axis may point elsewhere" in refused["message"]


def test_locate_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["locate", str(SAMPLES / "near-wall.png"), "--no-plots", "--json", "-D", str(tmp_path)]
    assert main(words) == 0
    plain = json.loads(capsys.readouterr().out)
    ra, dec = (plain["attitude"][key] for key in ("ra_deg", "dec_deg"))
    assert main([*words, f"--near-sky={ra:.2f},{dec:.2f},3"]) == 0
    assert json.loads(capsys.readouterr().out)["position"] == plain["position"]
    assert main([*words, f"--near-sky={ra:.2f},{-dec:.2f},3"]) == 3
    refused = json.loads(capsys.readouterr().out)
    assert refused["reason"] == "not_identified" and "within 3 degrees about RA" in refused["message"]


def test_batch_takes_it_and_repeats_images_for_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exposure, R = painted(0)
    (tmp_path / "night").mkdir()
    write_exposure(tmp_path / "night" / "one.fits", exposure)
    save_camera(replace(TEN_DEGREES, name="ten"), tmp_path / "ten.toml")
    words = ["batch", str(tmp_path / "night"), "-c", str(tmp_path / "ten.toml"), "-t", "shackleton-thesis", "-j", "1",
             "--time", "2030-01-01T00:00:00Z", "-D", str(tmp_path / "out")]  # fmt: skip
    ra, dec = pointing_deg(R)
    causes = []
    for near, kept in ((f"{ra:.9f},{-dec:.2f},3", False), (f"{ra:.9f},{-dec:.2f},3", True),
                       (f"{ra + 1e-7:.9f},{-dec:.2f},3", False)):  # fmt: skip
        assert main([*words, f"--near-sky={near}"]) == 5
        assert ("were there already" in capsys.readouterr().out) == kept
        causes.append(json.loads((tmp_path / "out" / "one.fix.json").read_text())["message"])
    assert all("within 3 degrees about RA" in cause for cause in causes)
    assert "3 degrees" in json.loads((tmp_path / "out" / "manifest.json").read_text())["settings"]["near_sky"]


@pytest.mark.parametrize(
    ("value", "cause"),
    [("10,20", "RA,DEC,RADIUS"), ("10,20,x", "not a number"), ("10,20,0", "RADIUS 0"), ("10,20,181", "RADIUS 181"),
     ("10,91,5", "DEC 91"), ("400,20,5", "RA 400"), ("nan,20,5", "not a number"), ("1,2,3,4", "RA,DEC,RADIUS")],
)  # fmt: skip
def test_bad_values_are_wrong_usage(value: str, cause: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["identify", str(SAMPLES / "near-wall.png"), f"--near-sky={value}"])
    assert stop.value.code == 2
    assert cause in capsys.readouterr().err


def unknown(one: Frame, camera: Camera, fov_deg: float, near: NearSky | None) -> Identification | None:
    try:
        solution = identify_unknown_lens(one.detections, camera.size_px, np.radians(fov_deg), sky(), near_sky=near)
    except NotIdentified:
        return None
    return solution.identification


@pytest.mark.parametrize(
    ("camera", "fov_deg", "radius_deg", "how"),
    [(TEN_DEGREES, 9.5, 3.0, {"brightest": 8, "limit": 9.0, "false": 0.5}),
     (TEN_DEGREES, 10.5, 1.0, {"brightest": 12, "limit": 9.0, "false": 1.0}),
     (FISHEYE, 176.0, 1.0, {"limit": 4.0, "false": 0.6, "hidden": 0.4})],
)  # fmt: skip
def test_a_lens_that_is_not_known_is_found_there_and_nowhere_else(
    camera: Camera, fov_deg: float, radius_deg: float, how: dict[str, float]
) -> None:
    for seed in range(3):
        one = frame(camera, seed, **{"hidden": 0.0, "false": 0.0} | how)
        near = near_sky(one.R_cam_icrs, radius_deg, seed)
        found = unknown(one, camera, fov_deg, near)
        assert found is not None
        assert angle_between_rad(found.R_cam_icrs[2], one.R_cam_icrs[2]) < np.radians(0.5)
        assert near.contains(found.R_cam_icrs)
        ra, dec = pointing_deg(one.R_cam_icrs)
        beside = NearSky.from_degrees((ra, dec + 2 * radius_deg * (-1 if dec > 0 else 1), 1.5 * radius_deg))
        assert (seed > 0 and camera is FISHEYE) or unknown(one, camera, fov_deg, beside) is None


def test_a_part_of_the_sky_ends_the_search_of_a_lens_sooner() -> None:
    tried: dict[str, list[int]] = {"whole": [], "part": []}
    for seed in range(4):
        one = frame(TEN_DEGREES, seed, limit=9.0, hidden=0.0, brightest=12, false=3.0)
        size = TEN_DEGREES.size_px
        for name, near in (("whole", None), ("part", near_sky(one.R_cam_icrs, 3.0, seed))):
            search = HypothesisSearch(one.detections.xy_px[:20], size, near, np.radians(0.5))
            (field,) = guess_fields(size, *np.radians([9.0, 11.0]), (None,))
            patterns = patterns_for(sky(), STRAIGHT.sizes(field.solid_angle_sr))
            hypotheses = search.voted_hypotheses(patterns, field.guesses[0], Window(0, 20))
            assert search.near_sky is None or all(
                search.near_sky.contains(h.view.R_cam_icrs, search.margin_rad) for h in hypotheses
            )
            tried[name].append(len(hypotheses))
            assert search.log_trials == pytest.approx(
                np.log(search.tried) + (0.0 if near is None else np.log(near.part))
            )
    assert sum(tried["part"]) < sum(tried["whole"])


def test_without_a_camera_file_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["identify", str(SAMPLES / "near-wall.png"), "--fov", "180", "--no-plots", "--json", "-D", str(tmp_path)]
    assert main(words) == 0
    plain = json.loads(capsys.readouterr().out)
    ra, dec = (plain["attitude"][key] for key in ("ra_deg", "dec_deg"))
    assert main([*words, f"--near-sky={ra:.2f},{dec:.2f},3"]) == 0
    assert json.loads(capsys.readouterr().out)["stars"]["identified"] == plain["stars"]["identified"]
    assert main([*words, f"--near-sky={ra:.2f},{-dec:.2f},3"]) == 3
    assert "within 3 degrees about RA" in json.loads(capsys.readouterr().out)["message"]


@pytest.mark.parametrize("others", [["--near-attitude", "a.json"]])
def test_it_stands_alone(others: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["identify", str(SAMPLES / "near-wall.png"), "--near-sky", "10,20,5", *others])
    assert stop.value.code == 2
    assert "--near-sky" in capsys.readouterr().err


def test_bad_values_of_the_library() -> None:
    with pytest.raises(ValueError, match="RADIUS 0"):
        startrack.identify(np.zeros((6, 2)), camera="fisheye-2048", near_sky=(0, 0, 0))
    with pytest.raises(ValueError, match="DEC 91"):
        startrack.identify(np.zeros((6, 2)), fov=90, size_px=(10, 10), near_sky=(0, 91, 5))
