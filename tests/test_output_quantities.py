"""The table of output quantities: a new quantity is one entry; and values of some quantities."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from startrack.api.solution import Solution
from startrack.chain import Located, Measured
from startrack.core.errors import Reason
from startrack.core.types import Attitude
from startrack.frames import R_from_rotvec, heading_pitch_roll_from_R_body_enu
from startrack.output import (
    SCHEMAS,
    Quantity,
    quantities,
    record,
    result_dict,
    rows,
    schema_of,
    show_everywhere,
    stage_values,
    table_columns,
    text,
)
from startrack.output.quantity import Listed
from startrack.output.record import record_values
from startrack.output.values import body_sigmas_deg

ROOT = Path(__file__).parent.parent
ARCSEC = np.pi / 648_000


def test_a_new_quantity_is_one_entry(located, monkeypatch):
    new = Quantity(
        "position.twice_m", "m", Located, lambda v: 2 * v.fix.radius95_m, "twice the radius", "positive", optional=True,
        form="%.2f", shown=show_everywhere("Twice", "{:.1f} m", "error"),
        listed=Listed("Twice", 1),
    )  # fmt: skip
    table = (*quantities.QUANTITIES, new)
    for module in (quantities, record, text):
        monkeypatch.setattr(module, "QUANTITIES", table)
    monkeypatch.setitem(quantities.BY_PATH, new.path, new)
    at, found = stage_values(located.result), result_dict(located.result)
    assert found["position"]["twice_m"] == 2 * located.result.fix.radius95_m
    assert Solution(located.result).position.twice.to_value("m") == found["position"]["twice_m"]
    assert schema_of(table, "position")["properties"]["twice_m"]["minimum"] == 0
    assert table_columns()[-1].name == "twice_m"
    words = f"{2 * located.result.fix.radius95_m:.1f} m"
    assert f"; twice {words}" in dict(rows("text", at))["error"]
    for place, values in (("panel", at), ("notebook", at), ("page", record_values(found))):
        assert dict(rows(place, values))["twice" if place == "notebook" else "Twice"] == words


def test_documentation_is_made_from_the_table(monkeypatch):
    spec = importlib.util.spec_from_file_location("make_tables", ROOT / "docs/make_tables.py")
    assert spec is not None and spec.loader is not None
    make_tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_tables)
    table = make_tables.markdown_table(quantities.QUANTITIES, "key")
    assert all(f"`{one.path}`" in table for one in quantities.QUANTITIES if one.recorded and not one.derived)
    assert all(f"`{one.value}` | {one.exit_code} |" in make_tables.reason_table() for one in Reason)


def test_old_columns_keep_their_order_and_new_ones_follow():
    names = [column.name for column in table_columns()]
    assert tuple(names[: len(quantities.FIRST_COLUMNS)]) == quantities.FIRST_COLUMNS
    assert {"search", "sigma_heading_deg", "sky_mag_arcsec2"} <= set(names[len(quantities.FIRST_COLUMNS) :])


@pytest.mark.parametrize("pitch_deg", [0.0, 35.0])
def test_sigmas_of_the_body_are_those_of_a_monte_carlo(located, pitch_deg):
    rng = np.random.default_rng(8)
    spread = np.diag([300.0, 120.0, 700.0]) * ARCSEC @ R_from_rotvec([0.3, -0.5, 0.2])
    fit = located.result.attitude_fit
    R = R_from_rotvec([np.radians(pitch_deg), 0.0, 0.0]) @ fit.attitude.R_cam_icrs
    attitude = Attitude(R_cam_icrs=R, covariance_rad2=spread @ spread.T)
    value: Measured = replace(located.result, attitude_fit=replace(fit, attitude=attitude))
    body_cam = value.camera.R_body_cam
    angles = np.array([
        heading_pitch_roll_from_R_body_enu(body_cam @ R_from_rotvec(spread @ rng.standard_normal(3)) @ value.R_cam_enu)
        for _ in range(3000)
    ])  # fmt: skip
    away = (angles - angles[0] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(body_sigmas_deg(value), np.degrees(away.std(axis=0)), rtol=0.06)


def test_the_sky_is_as_bright_as_it_was_rendered(located):
    """22 mag/arcsec2, of which the wall reflects 4 %; residuals of the stars add some hundredths."""
    found = result_dict(located.result)["sky"]["brightness_mag_arcsec2"]
    assert found == pytest.approx(22.0 - 2.5 * np.log10(0.96), abs=0.12)


@pytest.mark.parametrize("kind", ["fix", "identification", "detection"])
def test_every_reason_fits_the_schemas(kind):
    for one in Reason:
        if one is not Reason.AMBIGUOUS:
            record = {"format": f"startrack.{kind}/1", "image": "a.png", "status": "refused", "reason": one.value}
            Draft202012Validator(SCHEMAS[kind]).validate({**record, "message": ""})
