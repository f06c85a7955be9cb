"""The error of the clock in results: of a fix that has one, and of one that has none."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from astropy import units as u
from jsonschema import Draft202012Validator, ValidationError
from stage_helpers import as_stage

from startrack.api.solution import Solution
from startrack.applications.batch.tables import COLUMNS, column_values, table_values
from startrack.chain.stages import Measured, Refused
from startrack.core.types import ClockError, Mode
from startrack.output import SCHEMAS, result_dict, verbose_text
from startrack.output.html.rows import facts_of
from startrack.output.record import record_values

CLOCK = ClockError(offset_s=-12.3456, sigma_s=0.25)
CHECK = Draft202012Validator(SCHEMAS["fix"])


def with_clock(located, clock):
    result = replace(located.result, fix=replace(located.result.fix, clock=clock))
    return replace(result, exposure=replace(result.exposure, time_sigma_s=20.0))


def test_a_fix_with_a_clock_states_its_error(located):
    result = with_clock(located, CLOCK)
    record = result_dict(result)
    CHECK.validate(json.loads(json.dumps(record)))
    assert record["clock"] == {"offset_s": -12.3456, "sigma_s": 0.25}
    assert record["provenance"]["time_sigma_s"] == 20.0
    assert "  clock      offset -12.346 s; sigma 0.250 s\n" in verbose_text(result)
    assert shown_at_position(record)["Clock"] == "−12.346 s ± 0.250 s"


def test_a_fix_without_a_clock_has_null(located):
    result = with_clock(located, None)
    record = result_dict(result)
    CHECK.validate(record)
    assert record["clock"] == {"offset_s": None, "sigma_s": None}
    assert "\n  clock " not in verbose_text(result)
    assert "Clock" not in shown_at_position(record)


def shown_at_position(record):
    """Texts of the rows about the position, by their names."""
    return {name: text for name, text, _ in dict(facts_of(record_values(record)))["Position"]}


@pytest.mark.parametrize("wrong", [{"sigma_s": -1.0}, {"offset_s": "late"}])
def test_a_wrong_clock_does_not_fit_the_schema(located, wrong):
    record = result_dict(with_clock(located, CLOCK))
    with pytest.raises(ValidationError):
        CHECK.validate({**record, "clock": {**record["clock"], **wrong}})


def test_records_of_earlier_versions_fit_the_schema(located):
    record = result_dict(with_clock(located, None))
    del record["clock"], record["provenance"]["time_sigma_s"]
    CHECK.validate(record)


def test_only_a_fix_has_a_clock(located):
    result = with_clock(located, CLOCK)
    refused = Refused(reason="inconsistent_evidence", message="no", reached=as_stage(result, Measured))
    assert result_dict(refused)["clock"] is None
    for record in (result_dict(result, "identification"), result_dict(result, "detections")):
        assert "clock" not in record
        assert record["provenance"]["time_sigma_s"] == 20.0
    assert Solution(refused).clock is None


def test_an_unknown_time_has_no_sigma(located):
    exposure = replace(located.result.exposure, time_utc=None)
    assert result_dict(replace(located.result, exposure=exposure))["provenance"]["time_sigma_s"] is None


def test_an_ambiguous_fix_keeps_its_clock(located):
    modes = (Mode(east_m=6000.0, north_m=-2500.0, weight=0.7), Mode(east_m=-3000.0, north_m=4000.0, weight=0.3))
    result = with_clock(located, CLOCK)
    ambiguous = replace(result, fix=replace(result.fix, modes=modes, ambiguous=True))
    record = result_dict(ambiguous)
    CHECK.validate(record)
    assert record["clock"]["offset_s"] == CLOCK.offset_s
    assert Solution(ambiguous).clock is not None


def test_the_table_of_a_batch_has_columns_of_the_clock(located):
    records = [table_values(result_dict(with_clock(located, clock))) for clock in (CLOCK, None)]
    columns = {one.name: one for one in COLUMNS}
    assert column_values(columns["clock_offset_s"], records) == [CLOCK.offset_s, None]
    assert column_values(columns["clock_sigma_s"], records) == [CLOCK.sigma_s, None]
    assert column_values(columns["time_sigma_s"], records) == [20.0, 20.0]
    assert {columns[name].unit for name in ("clock_offset_s", "clock_sigma_s", "time_sigma_s")} == {"s"}


def test_a_solution_has_the_clock_with_units(located):
    solution = Solution(with_clock(located, CLOCK))
    clock = solution.clock
    assert (clock.offset.to_value(u.ms), clock.sigma.to_value(u.s)) == (pytest.approx(-12345.6), 0.25)
    assert repr(clock) == "ClockOffset\n  clock  -12.346 s ± 0.250 s"
    assert "-12.346 s ± 0.250 s" in clock._repr_html_() and "-12.346 s" in solution._repr_html_()
    assert "\n  clock          -12.346 s ± 0.250 s" in repr(solution.position)
    without = Solution(with_clock(located, None))
    assert without.clock is None
    assert "clock" not in repr(without.position)
