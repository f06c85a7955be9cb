"""`startrack locate --explain`: what a refused or wide answer would need."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stage_helpers import as_stage

from startrack.chain.stages import Detected, Measured, Refused
from startrack.cli.main import main
from startrack.core.errors import Reason
from startrack.core.types import Mode, Sectors, UnstatedFact
from startrack.output import SCHEMAS, explain

SAMPLE = str(Path(__file__).parents[1] / "sample_images/near-centre.png")


def with_fix(located: Any, **changes: Any) -> Any:
    return replace(located.result, fix=replace(located.result.fix, **changes))


def refused(located: Any, to: type, reason: Reason, **changes: Any) -> Refused:
    reached: Any = replace(as_stage(located.result, to), **changes)
    return Refused(reason=reason, message="why", reached=reached)


def test_a_small_circle_needs_nothing(located: Any) -> None:
    assert located.result.fix.unstated == ()
    assert explain(with_fix(located, radius95_m=5.0)) == []


@pytest.mark.parametrize("by_sky", [True, False])
def test_a_longer_exposure_shows_more_stars_and_narrows_the_circle(located: Any, by_sky: bool) -> None:
    light = located.result.photometry
    noisy = replace(with_fix(located, radius95_m=30.0), photometry=replace(light, sigma_e=6.0 * light.sigma_e))
    (text,) = explain(noisy if by_sky else replace(noisy, sky=None))
    seconds = located.result.exposure.exposure_s
    assert text.startswith(f"4 times the exposure ({4 * seconds:.3g} s): ")
    then, now = map(int, re.findall(r"(\d+) stars near the skyline, in place of (\d+),", text)[0])
    assert 1.5 * now < then < 20 * now
    circle_m = float(re.findall(r"circle of about ([\d.]+) m", text)[0])
    assert circle_m == pytest.approx(15.0 if by_sky else 30.0 * now / then, abs=0.06)


def test_facts_are_named_by_what_they_gain(located: Any) -> None:
    facts = (
        UnstatedFact("rim_tilt_sigma_deg", 12.0),
        UnstatedFact("time_sigma_s", 35.0),
        UnstatedFact("depth_sigma_m", 45.0),
    )
    tilt, clock, exposure, *rest = explain(with_fix(located, radius999_m=50.0, radius95_m=8.0, unstated=facts))
    assert "with rim_tilt_sigma_deg stated and exact the 99.9 % circle would be 12.0 m, not 50.0 m" in tilt
    assert "startrack terrain state FILE" in tilt and "--time-sigma" in clock
    assert exposure.endswith(" m if all facts were stated")
    assert not any("depth_sigma_m" in text for text in rest)
    small = UnstatedFact("time_sigma_s", 20.0)
    assert explain(with_fix(located, radius999_m=50.0, radius95_m=8.0, unstated=(small,))) == []


def test_several_positions_need_another_one(located: Any) -> None:
    modes = Mode(east_m=0.0, north_m=0.0, weight=0.6), Mode(east_m=300.0, north_m=-400.0, weight=0.4)
    first, *_ = explain(with_fix(located, ambiguous=True, modes=modes))
    assert first.startswith("another position: the two likeliest are 500 m apart; --near with a sigma of 100 m")


def test_a_skyline_out_of_view_and_a_blocked_one_are_named(located: Any) -> None:
    narrow = replace(located.result.camera, calibrated_angle_rad=np.radians(70.0))
    blocked = np.zeros(240)
    blocked[20:40] = 1.0
    outcome = replace(with_fix(located, radius95_m=30.0, blocked=Sectors(blocked)), camera=narrow)
    _, out_of_view, ridge = explain(outcome)
    assert out_of_view.startswith("more of the skyline: azimuths ") and "wider lens" in out_of_view
    assert ridge.startswith("a free view: the skyline is not the map's at azimuths 30 to 60 degrees")


def test_a_contradiction_names_what_may_be_wrong(located: Any) -> None:
    texts = explain(refused(located, Measured, Reason.INCONSISTENT_EVIDENCE))
    for text, what in zip(texts, ("time", "terrain", "camera file"), strict=False):
        assert text.startswith(f"the right {what}: ")
    assert "2030-06-01T00:00:00 UTC" in texts[0] and "shackleton-thesis" in texts[1] and "fisheye-1024" in texts[2]
    assert "--mask" in texts[3]


def test_an_open_position_names_exposure_and_silent_facts(located: Any) -> None:
    clock = replace(located.result.clock, gross_probability=0.01, gross_sigma_s=3600.0)
    first, *_, last = explain(refused(located, Measured, Reason.INSUFFICIENT_GEOMETRY, clock=clock))
    assert first.startswith("4 times the exposure") and "of the search area's middle" in first
    assert last.startswith("facts: time_sigma_s are not stated") and "--time-sigma" in last


def test_too_few_sources_need_a_longer_exposure(located: Any) -> None:
    few = located.result.detections
    few = few.take(np.arange(10)) if hasattr(few, "take") else few
    texts = explain(refused(located, Detected, Reason.NOT_IDENTIFIED, detections=few))
    assert texts == ["6 times the exposure: it has 10 point sources, and 30 are enough"]
    many = explain(refused(located, Detected, Reason.NOT_IDENTIFIED))
    assert many[0].startswith("the right camera file: ")


def test_other_refusals_have_their_advice(located: Any) -> None:
    assert explain(refused(located, Detected, Reason.NO_STARS)) == [Reason.NO_STARS.advice]


def test_the_command_prints_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["locate", SAMPLE, "--evidence", "stars", "--no-plots", "-D", str(tmp_path)]
    assert main([*words, "--explain"]) == 0
    heard = capsys.readouterr()
    assert "  needs 4 times the exposure (1.58 s): " in heard.err and "needs" not in heard.out
    assert main([*words, "--explain", "--json"]) == 0
    heard = capsys.readouterr()
    record = json.loads(heard.out)
    assert record["explain"][0].startswith("4 times the exposure") and "needs" not in heard.err
    assert json.loads((tmp_path / "near-centre.fix.json").read_text()) == record
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["explain"] == []
    assert "explain" in SCHEMAS["fix"]["properties"] and "explain" not in SCHEMAS["fix"]["required"]


def test_a_map_that_dominates_asks_for_a_finer_one(located: Any) -> None:
    wide = np.array([[400.0, 0.0], [0.0, 4.0]])
    dominated = with_fix(located, radius999_m=60.0, covariance_m2=wide, exact_map_radius999_m=9.0)
    (text,) = explain(dominated)
    assert "make the 99.9 % circle 60.0 m, not 9.0 m" in text and "azimuths 90 and 270" in text
    assert explain(with_fix(located, radius999_m=60.0, exact_map_radius999_m=50.0)) == []
