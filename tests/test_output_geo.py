"""A fix as GeoJSON and KML: read again with programs of others, the circle measured on the sphere."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from startrack.cli.main import main
from startrack.frames import Site
from startrack.output.geo import _circle

SAMPLE = Path(__file__).parents[1] / "sample_images/near-wall.png"
KML = "{http://www.opengis.net/kml/2.2}"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("geo")
    words = ["locate", str(SAMPLE), "-D", str(folder), "--no-plots", "-q", "--format", "geojson,kml"]
    assert main(words) == 0
    return folder


def moon_distance_m(lonlat: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Haversine on the sphere of 1737.4 km."""
    (lon, lat), (lon0, lat0) = np.radians(lonlat.T), np.radians(centre)
    h = np.sin((lat - lat0) / 2) ** 2 + np.cos(lat) * np.cos(lat0) * np.sin((lon - lon0) / 2) ** 2
    return 2 * 1_737_400.0 * np.arcsin(np.sqrt(h))


def test_the_geojson_has_position_circle_and_attitude(out: Path) -> None:
    fix = json.loads((out / "near-wall.fix.json").read_text())
    whole = json.loads((out / "near-wall.geojson").read_text())
    assert whole["crs"]["properties"]["name"] == "urn:ogc:def:crs:IAU_2015::30100"
    point, circle = whole["features"]
    position = fix["position"]
    expected = [position["longitude_deg"], position["latitude_deg"]]
    np.testing.assert_allclose(point["geometry"]["coordinates"], expected, atol=1e-9)
    assert point["properties"]["heading_deg"] == fix["attitude"]["heading_deg"]
    ring = np.array(circle["geometry"]["coordinates"][0])
    assert ring[0].tolist() == ring[-1].tolist()
    distance = moon_distance_m(ring, np.array(expected))
    np.testing.assert_allclose(distance, position["radius95_m"], rtol=2e-3)  # the floor is not on the sphere


def test_the_kml_names_the_moon_and_holds_the_same_numbers(out: Path) -> None:
    text = (out / "near-wall.kml").read_text()
    root = ElementTree.fromstring(text)
    assert root.attrib["hint"] == "target=moon"
    assert "On the Moon" in root.findtext(f"{KML}Document/{KML}description", "")
    features = json.loads((out / "near-wall.geojson").read_text())["features"]
    point = root.findtext(f".//{KML}Point/{KML}coordinates", "")
    assert [float(word) for word in point.split(",")] == features[0]["geometry"]["coordinates"]
    ring = root.findtext(f".//{KML}LinearRing/{KML}coordinates", "").split()
    assert len(ring) == len(features[1]["geometry"]["coordinates"][0])


def test_no_former_file_stands_beside_another_result(out: Path, tmp_path: Path) -> None:
    words = ["locate", str(SAMPLE), "-D", str(tmp_path), "--no-plots", "-q", "--format", "geojson"]
    assert main(words) == 0
    assert (tmp_path / "near-wall.geojson").exists() and not (tmp_path / "near-wall.kml").exists()
    assert main([*words, "--near", "-6000,4700,10"]) == 3
    assert not (tmp_path / "near-wall.geojson").exists()


def test_another_format_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["locate", str(SAMPLE), "--format", "geojson,shp"])
    assert end.value.code == 2
    assert "'geojson,shp' is not geojson, kml or geojson,kml" in capsys.readouterr().err


def test_a_circle_across_180_degrees_is_whole_and_one_about_the_pole_is_left_out() -> None:
    across = _circle(Site("earth", 0.3, np.pi), np.zeros(3), 1000.0)
    assert across is not None and np.ptp(np.array(across)[:, 0]) < 0.1
    assert _circle(Site("moon", -np.pi / 2 + 1e-5, 0.0), np.zeros(3), 1000.0) is None
