"""The page: self-contained, in agreement with the results, safe with any text, and reproducible to the byte."""

from __future__ import annotations

import base64
import json
import re
import shutil
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from astropy.table import Table
from html_helpers import NASTY, results_in

from startrack.cli.main import main
from startrack.cli.pictures.report import write_page_of_images
from startrack.core.errors import Reason
from startrack.exposure import insert_png_chunks
from startrack.localization.thesis_methods import point_fix
from startrack.output import page_text, result_at, result_dict, results_under, write_json, write_results
from startrack.output.html.details import SOURCES, ground_map, skyline_of
from startrack.output.html.rows import COLUMNS, facts_of
from startrack.output.record import record_values
from startrack.terrain import load_terrain

VOID = {"meta", "link", "input", "br", "img"}


@pytest.fixture(scope="session")
def results(located, tmp_path_factory) -> Path:
    return results_in(tmp_path_factory.mktemp("results"), located)


@pytest.fixture(scope="session")
def text(results) -> str:
    found, unread = results_under(results)
    return page_text(found, unread=unread, real={"small": (6010.0, -2507.0)})


class Structure(HTMLParser):
    """Every tag closed, every address, and the texts of scripts and title."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.addresses += [
            value for key, value in attrs if key in ("src", "href", "action", "poster", "data", "srcset")
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            name = dict(self.tags[-1][1]).get("id") or self.open[-1]
            self.texts[name] = self.texts.get(name, "") + data


def data_of(text: str, name: str) -> dict:
    return json.loads(Structure(text).texts[name])


def test_the_page_is_whole_in_itself(text):
    assert re.findall(r"https?://|@import|url\(", text) == []
    page = Structure(text)
    assert page.open == []
    assert all(address.startswith(("#", "data:")) for address in page.addresses)
    tags = dict(page.tags)
    assert tags["html"]["lang"] == "en"
    assert text.startswith("<!doctype html>")
    metas = [attrs for tag, attrs in page.tags if tag == "meta"]
    assert {"name": "viewport", "content": "width=device-width,initial-scale=1"} in metas
    (policy,) = [one["content"] for one in metas if one.get("http-equiv") == "Content-Security-Policy"]
    assert {"default-src 'none'", "base-uri 'none'", "form-action 'none'"} <= set(policy.split("; "))
    assert "http" not in policy


def test_texts_of_results_are_escaped(text, results):
    page = Structure(text)
    names = [attrs.get("id") for tag, attrs in page.tags if tag == "script"]
    assert names == ["results", "detail-0", "detail-1", "detail-2", "detail-3", None]
    assert NASTY in [row[COLUMNS.index("image")] for row in data_of(text, "results")["rows"]]
    assert data_of(text, "detail-0")["record"]["message"] == NASTY
    single = page_text([result_at(results / "bad.fix.json")], single=True)
    assert Structure(single).texts["title"] == f"{NASTY} · startrack"
    assert "<b>" not in single


def test_the_same_results_give_the_same_bytes(text, results):
    found, unread = results_under(results)
    assert page_text(found, unread=unread, real={"small": (6010.0, -2507.0)}) == text


def test_rows_agree_with_the_results(text, results, located):
    head = data_of(text, "results")
    rows = {row[1]: dict(zip(head["columns"], row, strict=True)) for row in head["rows"]}
    assert list(rows) == ["bad", "dark", "night 1/two", "small"]
    assert [row["status"] for row in rows.values()] == ["refused", "refused", "ambiguous", "ok"]
    fix, row = located.result.fix, rows["small"]
    assert [row["east_m"], row["north_m"]] == pytest.approx(fix.position_enu_m[:2], abs=0.006)
    assert row["radius95_m"] == pytest.approx(fix.radius95_m, abs=0.006)
    error = fix.position_enu_m[:2] - [6010.0, -2507.0]
    assert row["error_m"] == pytest.approx(np.linalg.norm(error), abs=0.01)
    assert row["nees"] == pytest.approx(error @ np.linalg.solve(fix.covariance_m2, error), rel=1e-3)
    assert head["errors"]["count"] == 1
    assert head["errors"]["mean_m"] == pytest.approx(row["error_m"], abs=0.006)
    assert head["errors"]["inside95"] == float(row["error_m"] <= row["radius95_m"])
    assert rows["dark"]["east_m"] is None and rows["dark"]["nees"] is None
    assert head["words"]["no_stars"][1] != ""


def test_a_position_without_a_circle_has_an_error_only(located, tmp_path):
    located_at = located.result.fix.position_enu_m[:2]
    point = replace(located.result, fix=point_fix(located_at, located.result.terrain))
    write_results(point, tmp_path / "point.fix.json")
    found, unread = results_under(tmp_path)
    head = data_of(page_text(found, unread=unread, real={"point": (6010.0, -2507.0)}), "results")
    row = dict(zip(head["columns"], head["rows"][0], strict=True))
    assert [row[key] for key in ("radius95_m", "radius999_m", "cov_ee", "nees")] == [None] * 4
    assert row["error_m"] == pytest.approx(np.linalg.norm(located_at - [6010.0, -2507.0]), abs=0.01)
    assert head["errors"]["inside95"] is head["errors"]["mean_nees"] is None
    rows = dict(facts_of(record_values(result_dict(point))))["Position"]
    facts = {name: text for name, text, _ in rows}
    assert facts["95 % within"] == "no circle" and facts["Search"] == "approximate"
    assert not {"Sigma", "99.9 % within"} & set(facts)


def test_stars_are_those_of_the_star_table(text, results):
    stars = data_of(text, "detail-3")["stars"]
    table = Table.read(results / "small.stars.ecsv", format="ascii.ecsv")
    columns = stars["columns"]
    assert stars["total"] == len(table)
    assert sum(stars["counts"].values()) == len(table)
    count = len(columns["id"])
    assert count == min(len(table), 4000)
    assert columns["id"] == table["catalog_id"][:count].tolist()
    assert columns["status"] == table["status"][:count].tolist()
    for name, column, tolerance in (("x", "x_px", 0.006), ("el", "elevation_deg", 0.0006), ("ev", "evidence", 0.006)):
        given = [np.nan if value is None else value for value in columns[name]]
        np.testing.assert_allclose(given, np.ma.filled(table[column][:count], np.nan), atol=tolerance)


def test_stars_lie_on_their_image_in_the_picture(text):
    detail = data_of(text, "detail-3")
    picture, columns = detail["picture"], detail["stars"]["columns"]
    kind, encoded = picture["src"].split(",")
    assert kind == "data:image/webp;base64"
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert pixels.shape == (picture["height"], picture["width"])
    seen = [k for k, status in enumerate(columns["status"]) if status == "seen"][:40]
    xy = picture["scale"] * (np.array([[columns["x"][k], columns["y"][k]] for k in seen]) + 0.5) - 0.5

    def light(offset):
        x, y = np.rint(xy + offset).astype(int).T
        return float(np.mean(pixels[y, x]))

    around = [light((dx, dy)) for dx in (-6, 6) for dy in (-6, 6)]
    assert light((0, 0)) > 1.8 * max(around)


def test_the_horizon_is_that_of_the_crater(text, located):
    """On the thesis's cylinder: 2000 m of wall over the distance to the rim, less the camera's height."""
    horizon = np.array(data_of(text, "detail-3")["horizon"])
    azimuth = np.linspace(0, 2 * np.pi, len(horizon))
    east, north = located.result.fix.position_enu_m[:2]
    along = east * np.sin(azimuth) + north * np.cos(azimuth)
    rim_m = -along + np.sqrt(along**2 + 10_000.0**2 - east**2 - north**2)
    np.testing.assert_allclose(horizon, np.degrees(np.arctan2(2000.0 - 1.5, rim_m)), atol=0.002)
    assert data_of(text, "results")["terrains"]["shackleton-thesis"]["rim_m"] == 10_000.0


def test_the_skyline_is_that_of_its_table(text, results, located):
    skyline, stars = data_of(text, "detail-3")["skyline"], data_of(text, "detail-3")["stars"]["columns"]
    table = Table.read(results / "small.skyline.ecsv", format="ascii.ecsv")
    known = table[~np.ma.getmaskarray(table["elevation_deg"])]
    assert len(skyline["az"]) == len(known) > 100
    for name, column in (("az", "azimuth_deg"), ("el", "elevation_deg"), ("sigma", "sigma_deg")):
        np.testing.assert_allclose(skyline[name], known[column], atol=0.0006)
    assert [SOURCES[k] for k in skyline["source"]] == known["source"].tolist()
    result = located.result

    def horizon_deg(azimuth_deg):
        return np.degrees(result.terrain.horizon_rad(result.fix.position_enu_m[None, :2], np.radians(azimuth_deg)))

    raised = np.array(known["elevation_deg"]) - horizon_deg(np.array(known["azimuth_deg"]))
    np.testing.assert_allclose(skyline["above"], raised, atol=0.001)
    assert np.mean(np.abs(raised) + 2 * np.array(known["sigma_deg"]) <= skyline["half"] + 0.001) == pytest.approx(
        0.95, abs=0.02
    )
    heights = np.array(stars["el"]) - horizon_deg(np.array(stars["az"]))
    near = [k for k, _ in skyline["near"]]
    assert near == np.flatnonzero(np.abs(heights) < skyline["half"]).tolist() and near
    np.testing.assert_allclose([height for _, height in skyline["near"]], heights[near], atol=0.001)
    assert len(json.dumps(skyline, separators=(",", ":"))) < 10_000  # bytes, of each image


def test_results_without_a_skyline_or_a_terrain_show_what_there_is(text, results):
    assert [data_of(text, f"detail-{k}")["skyline"] for k in range(3)] == [None] * 3
    shown = skyline_of(results / "small.skyline.ecsv", None, None)
    assert shown is not None and "above" not in shown and len(shown["el"]) > 100
    assert skyline_of(results / "dark.skyline.ecsv", None, None) is None


def test_only_some_images_have_details_and_all_have_a_row(results, tmp_path):
    found, _ = results_under(results)
    text = page_text(found, images=2)
    head = data_of(text, "results")
    assert len(head["rows"]) == 4
    detailed = [row[1] for row in head["rows"] if row[-1]]
    assert detailed == ["bad", "small"]  # one of those that were not solved, and one that was
    assert "detail-1" not in text
    assert len(page_text(found, images=0)) < 120_000
    many = page_text(found * 2500, images=0)
    assert len(data_of(many, "results")["rows"]) == 10_000
    assert len(many) < 4e6


def test_a_terrain_that_is_not_here_is_left_out(results, tmp_path):
    record = json.loads((results / "small.fix.json").read_text())
    record["provenance"]["terrain"] = "nowhere/crater.toml"
    write_json(tmp_path / "small.fix.json", record)
    text = page_text([result_at(tmp_path / "small.fix.json")], single=True)
    assert data_of(text, "results")["terrains"] == {}
    detail = data_of(text, "detail-0")
    assert (detail["horizon"], detail["picture"], detail["stars"]) == (None, None, None)


def test_a_height_map_is_shaded_and_see_through_where_it_ends():
    terrain = load_terrain("kepler")
    ground = ground_map(terrain)
    encoded = np.frombuffer(base64.b64decode(ground["relief"].split(",")[1]), np.uint8)
    relief = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    x = np.linspace(-ground["half_m"], ground["half_m"], relief.shape[1])
    away_m = np.hypot(*np.meshgrid(x, x)) - terrain.reach_m
    cover, cell_m = relief[..., 3], x[1] - x[0]
    assert (cover[away_m < -3 * cell_m] == 255).mean() > 0.99
    assert cover[away_m > 3 * cell_m].max() == 0
    assert 20 < np.std(relief[away_m < -3 * cell_m][:, 0]) < 100  # light and shade


def test_every_reason_has_a_text():
    formats = (Path(__file__).parent.parent / "docs/formats.md").read_text(encoding="utf-8")
    reasons = set(re.findall(r"^\| `(\w+)` \| [134] \|", formats, flags=re.MULTILINE))
    assert reasons == {one.value for one in Reason}
    assert all(one.meaning and one.advice for one in Reason)


@pytest.mark.parametrize(
    "damage",
    [
        '{"image": "x.png"',
        "[" * 100_000,
        '["x"]',
        '{"image": 3, "status": "ok"}',
        '{"image": "x.png", "status": "ok", "reason": []}',
    ],
)
def test_files_that_are_no_results_are_named(tmp_path, capsys, damage):
    (tmp_path / "x.fix.json").write_text(damage)
    (tmp_path / "y.fix.json").write_text(
        '{"image": "y.png", "status": "ok", "position": {"east_m": NaN, "north_m": 1e999, "covariance_m2": 5}}'
    )
    assert main(["report", str(tmp_path), "-q"]) == 0
    head = data_of((tmp_path / "report.html").read_text(encoding="utf-8"), "results")
    (line,) = head["unread"]
    assert re.match(r"x\.fix\.json: (no JSON|holds no|\w+: missing)", line)
    assert capsys.readouterr().err == f"startrack: left out {line}\n"
    assert [row[1] for row in head["rows"]] == ["y"]
    assert main(["report", str(tmp_path / "x.fix.json")]) == 4
    (tmp_path / "y.fix.json").unlink()
    assert main(["report", str(tmp_path)]) == 4
    assert "no result there can be read: x.fix.json" in capsys.readouterr().err


TABLE_DAMAGE = {
    "no text": lambda data: data[:900] + b"\xff\xfe" + data[900:],
    "a column lost": lambda data: data.replace(b"azimuth_deg", b"azimuth"),
    "words": lambda data: data.replace(b".", b"x"),
    "no numbers": lambda data: data.replace(b",1", b",inf").replace(b",2", b",nan").replace(b",3", b",1e300"),
    "long field": lambda data: data + 200_000 * b"7",
}


@pytest.mark.parametrize("damage", TABLE_DAMAGE)
@pytest.mark.parametrize("end", [".stars.ecsv", ".skyline.ecsv"])
def test_a_page_shows_what_can_be_read_of_damaged_tables(results, tmp_path, damage, end):
    out = Path(shutil.copytree(results, tmp_path / "out"))
    table = out / f"small{end}"
    table.write_bytes(TABLE_DAMAGE[damage](table.read_bytes()))
    assert main(["report", str(out / "small.fix.json"), "-q"]) == 0
    assert data_of((out / "small.report.html").read_text(encoding="utf-8"), "detail-0")["picture"] is not None


def test_damaged_layers_of_a_picture_are_left_out(results, tmp_path, capfd):
    """Marks that are no JSON, hold no number, or inflate to much; a picture much larger than ours, or cut."""
    out = Path(shutil.copytree(results, tmp_path / "out"))
    picture = out / "small.annotated.png"
    whole = picture.read_bytes()
    plain = cv2.imencode(".png", np.zeros((40, 60, 3), np.uint8))[1].tobytes()
    jpeg, marks = plain_jpeg(60), zlib.compress(b'{"size": [60, 40]}')
    cases = {
        "marks": (insert_png_chunks(plain, [(b"stPX", jpeg), (b"stOV", marks)]), True),
        "damaged": (insert_png_chunks(plain, [(b"stPX", jpeg), (b"stOV", marks[:-6] + b"123456")]), False),
        "no marks": (
            insert_png_chunks(plain, [(b"stPX", jpeg), (b"stOV", zlib.compress(b'{"size": [NaN, 1]}'))]),
            False,
        ),
        "bomb": (insert_png_chunks(plain, [(b"stPX", jpeg), (b"stOV", zlib.compress(bytes(2**25)))]), False),
        "large": (insert_png_chunks(plain, [(b"stPX", plain_jpeg(5000)), (b"stOV", marks)]), False),
        "cut": (whole[: len(whole) // 2], None),
    }
    for data, has_marks in cases.values():
        picture.write_bytes(data)
        assert main(["report", str(out / "small.fix.json"), "-q"]) == 0
        shown = data_of((out / "small.report.html").read_text(encoding="utf-8"), "detail-0")["picture"]
        assert has_marks is (None if shown is None else "marks" in shown)
    assert capfd.readouterr().err == ""


def plain_jpeg(width: int) -> bytes:
    """A black picture."""
    return bytes(cv2.imencode(".jpg", np.zeros((40, width, 3), np.uint8))[1])


def test_the_command_reads_the_folder_of_true_positions(results, tmp_path, capsys):
    truth = tmp_path / "truth"
    truth.mkdir()
    (truth / "small.truth.json").write_text('{"position_enu_m": [6000.0, -2500.0, 1.5]}')
    page = tmp_path / "p.html"
    assert main(["report", str(results), "--truth", str(truth), "-o", str(page)]) == 0
    assert capsys.readouterr().out == f"page in {page}\n"
    errors = data_of(page.read_text(encoding="utf-8"), "results")["errors"]
    assert errors["count"] == 1
    assert errors["largest_m"] < 100
    for text in ("{}", "[" * 100_000, f'{{"position_enu_m": [{10**400}, 0]}}'):
        (truth / "small.truth.json").write_text(text)
        assert main(["report", str(results), "--truth", str(truth), "-o", str(page)]) == 4
    assert main(["report", str(results), "--truth", str(tmp_path / "none")]) == 4
    assert "no such folder of truth" in capsys.readouterr().err
    assert main(["report", str(results), "--truth", str(page)]) == 4
    assert "is a file, not a folder of truth" in capsys.readouterr().err


def test_where_pages_go(results, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(results, out)
    write_page_of_images(str(out), ["images/small.png"])
    assert (out / "small.report.html").is_file() and not (out / "report.html").exists()
    assert data_of((out / "small.report.html").read_text(encoding="utf-8"), "results")["single"] is True
    write_page_of_images(str(out), ["small.png", "dark.png"])
    assert (out / "report.html").is_file()
    assert main(["report", str(tmp_path / "nothing")]) == 4
    assert "no such folder" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["report", str(tmp_path / "empty")]) == 4


def test_links_are_relative_to_the_page(results, tmp_path):
    found, _ = results_under(results)
    for page in (tmp_path / "a # b/rep.html", tmp_path / "rep.html", results.parent / "rep.html"):
        page.parent.mkdir(exist_ok=True)
        assert main(["report", str(results), "-q", "-o", str(page)]) == 0
        base = unquote(data_of(page.read_text(encoding="utf-8"), "results")["base"])
        assert (page.parent / base).samefile(results)
    assert all(one.folder == results for one in found)
    inside = results / "night 1/two.fix.json"
    assert main(["report", str(inside), "-q", "-o", str(tmp_path / "one.html")]) == 0
    base = unquote(data_of((tmp_path / "one.html").read_text(encoding="utf-8"), "results")["base"])
    assert (tmp_path / base).samefile(inside.parent)


def test_the_advice_of_a_bad_image_fits_every_cause():
    advice = Reason.BAD_IMAGE.advice
    assert advice.startswith("Correct what the message names")
    assert all(word in advice for word in ("channel", "whole", "number in every pixel", "PNG", "sidecar"))


def test_locate_and_batch_add_the_page(tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    (images / "flat.png").write_bytes(cv2.imencode(".png", np.full((2048, 2048), 100, np.uint16))[1].tobytes())
    facts = {"time_utc": "2031-01-01T00:00:00Z", "camera": "fisheye-2048", "terrain": "shackleton-thesis"}
    (images / "flat.json").write_text(json.dumps(facts))
    one, many = tmp_path / "one", tmp_path / "many"
    assert main(["locate", str(images / "flat.png"), "-D", str(one), "--report", "-q", "--no-plots"]) == 3
    assert data_of((one / "flat.report.html").read_text(encoding="utf-8"), "results")["rows"][0][3] == "no_stars"
    assert main(["batch", str(images), "-D", str(many), "--report", "-q", "--no-plots", "-j", "1"]) == 5
    assert data_of((many / "report.html").read_text(encoding="utf-8"), "results")["single"] is False


def test_rows_say_what_they_mean(located):
    groups = dict(facts_of(record_values(result_dict(located.result))))
    helps = {name: meaning for rows in groups.values() for name, _, meaning in rows}
    assert "holds 95 %" in helps["95 % within"] and helps["95 % within"].endswith("[m]")
    assert all(helps.values()) and not any("`" in text for text in helps.values())


def test_a_refused_picture_of_the_earth_is_advised_by_its_message(located, tmp_path):
    write_results(located.result, tmp_path / "a.fix.json")
    (found,), _ = results_under(tmp_path)
    message = "no terrain file is known: give -t FILE or a sidecar with terrain"
    record = {**found.record, "status": "refused", "reason": "bad_terrain", "message": message, "position": None}
    text = page_text([replace(found, record=record)])
    assert "startrack horizon" in data_of(text, "detail-0")["advice"]
    assert data_of(page_text([found]), "detail-0")["advice"] is None
