"""Lengths as text."""

import pytest

from startrack.core.errors import length_text


@pytest.mark.parametrize(
    ("metres", "digits", "text"),
    [(183.4, 2, "180 m"), (12345.0, 3, "12300 m"), (0.0421, 2, "0.042 m"), (6.0, 2, "6 m"),
     (999.6, 3, "1000 m")],
)  # fmt: skip
def test_a_length_has_no_exponent(metres, digits, text):
    assert length_text(metres, digits) == text
