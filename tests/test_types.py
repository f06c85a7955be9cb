"""Values: what they convert, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from startrack.core.types import Evidence

ROWS = {"azimuth_rad": [0.1, 7.0, -1.0], "elevation_rad": [0.1, np.pi / 2, -0.1], "llr": [2.0, -3.0, 0.0]}


def test_a_number_stands_for_all_rows_of_evidence() -> None:
    plain = Evidence(**ROWS)
    assert (plain.edge_sigma_rad == 0).all() and (plain.extended_nats == 0).all()
    given = Evidence(**ROWS, edge_sigma_rad=0.01, extended_nats=np.float64(2.0))
    np.testing.assert_array_equal(given.edge_sigma_rad, [0.01] * 3)
    np.testing.assert_array_equal(given.extended_nats, [2.0] * 3)
    assert not given.edge_sigma_rad.flags.writeable
    np.testing.assert_array_equal(given.take([2, 0]).edge_sigma_rad, [0.01] * 2)
    assert ((given.azimuth_rad >= 0) & (given.azimuth_rad < 2 * np.pi)).all()
    assert len(Evidence(azimuth_rad=[], elevation_rad=[], llr=[], edge_sigma_rad=0.01)) == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"elevation_rad": [10.0, 45.0, 80.0]}, r"elevation_rad: 80 is beyond pi/2, the zenith: is it in radians\?"),
        ({"elevation_rad": [0.1, 0.2, -3.0]}, "elevation_rad: 3 is beyond pi/2"),
        ({"edge_sigma_rad": [0.1, -0.01, 0.1]}, "edge_sigma_rad: -0.01 is negative"),
        ({"edge_sigma_rad": -0.01}, "edge_sigma_rad: -0.01 is negative"),
        ({"extended_nats": -1.0}, "extended_nats: -1 is negative"),
        ({"edge_sigma_rad": np.nan}, "edge_sigma_rad holds NaN"),
        ({"edge_sigma_rad": [0.1, 0.2]}, "edge_sigma_rad: shape"),
        ({"llr": 2.0}, "llr: 0 dimensions"),  # every ray has its own
        ({"llr": [np.inf, 0.0, 0.0]}, "infinite"),
    ],
)
def test_impossible_evidence_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Evidence(**{**ROWS, **given})
