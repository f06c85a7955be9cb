"""Results in words."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from stage_helpers import as_stage

from startrack.chain.stages import Detected, Oriented, Refused
from startrack.core.types import Mode
from startrack.localization.thesis_methods import point_fix
from startrack.output import refusal_line, summary_line, verbose_text
from startrack.output.values import chance_text


def test_one_line_for_a_fix(located):
    line = summary_line(located.result, seconds=3.14)
    found = re.fullmatch(
        r"small  ok  E (-?\d+\.\d) m  N (-?\d+\.\d) m  ±(\d+\.\d) m \(95 %\)  heading (\d+\.\d)°  (\d+) stars  "
        r"3\.1 s",
        line,
    )
    assert found is not None, line
    east, north, radius, heading, stars = map(float, found.groups())
    assert east == pytest.approx(located.truth.position_enu_m[0], abs=3 * radius)
    assert north == pytest.approx(located.truth.position_enu_m[1], abs=3 * radius)
    assert heading == pytest.approx(30.0, abs=0.11)
    assert stars == len(located.result.identification)


def test_a_position_without_a_circle_is_called_approximate(located):
    fix = located.result.fix
    point = replace(located.result, fix=point_fix(fix.position_enu_m[:2], located.result.terrain), sky=None)
    line = summary_line(point, seconds=3.14)
    assert re.fullmatch(r"small  ok  E \S+ m  N \S+ m  approximate, no circle  heading .* stars  3\.1 s", line), line
    assert "error      evidence stars; search approximate; no circle\n" in verbose_text(point)
    own = replace(located.result, fix=replace(fix, search="approximate"))  # of a user's own method, with a circle
    assert re.search(r"±\S+ m \(95 %\)  approximate  heading", summary_line(own))


def test_a_search_that_proved_nothing_is_visible(located):
    """In the line and by a warning that says what it means; of a proven one neither."""
    fix = replace(located.result.fix, search="beam", dropped_probability=None)
    unproven = replace(located.result, fix=fix)
    assert re.search(r"±\S+ m \(95 %\)  search: beam  heading", summary_line(unproven))
    (warning,) = (text for text in unproven.warnings if "beam" in text)
    assert "before the proof that no other position fits" in warning and "--near" in warning
    proven = replace(located.result, fix=replace(fix, search="proven"))
    assert "beam" not in summary_line(proven) + " ".join(proven.warnings)


def test_without_a_time_of_its_own_the_stages_are_added_up(located):
    seconds = sum(located.result.timing_ms.values()) / 1e3
    assert summary_line(located.result).endswith(f"  {seconds:.1f} s")


def test_other_results(located):
    result = located.result
    two = (
        Mode(east_m=6000.0, north_m=-2500.0, weight=0.7, radius95_m=3.46),
        Mode(east_m=-3000.4, north_m=4000.0, weight=0.3),
    )
    ambiguous = replace(result, fix=replace(result.fix, modes=two, ambiguous=True))
    places = "E 6000.0 m N -2500.0 m ±3.5 m (95 %), probability 70 %; E -3000.4 m N 4000.0 m, probability 30 %"
    assert f"ambiguous  2 positions fit: {places}" in summary_line(ambiguous)
    assert f"  places     {places}; search {result.fix.search}\n" in verbose_text(ambiguous)
    identified = as_stage(result, Oriented, terrain=None)
    assert re.search(
        r"small  ok  RA \d+\.\d{4}°  Dec [+-]\d+\.\d{4}° ± 0\.0\d+°  [\d.]+\"/px  up \d+\.\d{2}°  \d+ stars",
        summary_line(identified),
    )
    detected = as_stage(result, Detected)
    assert summary_line(detected, seconds=0.2) == f"small  ok  {len(result.detections)} point sources  0.2 s"


def test_refusals_are_one_line_with_reason_and_message(located):
    refused = Refused(reason="no_stars", message="the frame\nis flat", reached=located.result)
    assert summary_line(refused, seconds=1.0) == "small  refused  no_stars: the frame is flat"
    line = "b.png  refused  bad_image: it is truncated"
    assert refusal_line("night/b.png", "bad_image", "it is truncated") == line
    assert refusal_line("night/b.png", "bad_image", "night/b.png: it is truncated") == line


def test_a_heading_of_nearly_360_degrees_is_0(located):
    from startrack.output.values import Angle

    assert f"{Angle(359.99999):.1f}" == "0.0"
    assert f"{Angle(57.2957795):.3f}" == "57.296"


def test_verbose_gives_more_lines(located):
    text = verbose_text(located.result)
    assert all(line.startswith("  ") for line in text.splitlines())
    for part in ("position   E ", "latitude -89.", "error      sigma", "boresight  RA", "heading ", "identified"):
        assert part in text
    angles = re.search(r"heading (\S+)°, pitch (\S+)°, roll (\S+)°", text)
    assert angles is not None
    assert [float(angle) for angle in angles.groups()] == pytest.approx(located.heading_pitch_roll_deg, abs=0.01)
    assert "2030-06-01T00:00:00" in text
    total = sum(located.result.timing_ms.values())
    assert re.search(rf"locate \d+; all stages {total:.0f}$", text.splitlines()[-1])
    warned = replace(
        located.result, exposure=replace(located.result.exposure, warnings=("EXIF turned",), time_utc=None)
    )
    assert "EXIF turned" in verbose_text(warned)
    assert "not known" in verbose_text(warned)


def test_probabilities_too_small_for_a_float():
    assert chance_text(2.17e-12) == "2e-12"
    assert chance_text(1e-300) == chance_text(0.0) == "below 1e-100"  # smaller values are beyond the model


def test_a_wide_circle_of_999_of_1000_stands_in_the_line(located):
    """Where it is five times that of 95 %: a gross error is then possible that the smaller circle does not tell."""
    fix = located.result.fix
    for factor, is_told in ((4.9, False), (5.1, True)):
        wide = replace(located.result, fix=replace(fix, radius999_m=factor * fix.radius95_m))
        told = f", {factor * fix.radius95_m:.1f} m (99.9 %)"
        assert (told in summary_line(wide)) == is_told == ("(99.9 %)" in summary_line(wide))
