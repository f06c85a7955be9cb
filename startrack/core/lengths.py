"""Lengths as text for messages."""

from __future__ import annotations

from decimal import Decimal


def length_text(metres: float, digits: int = 2) -> str:
    """A length with so many significant digits and without an exponent, such as "180 m"."""
    return f"{Decimal(f'{metres:.{digits}g}'):f} m"
