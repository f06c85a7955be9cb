"""YAML in and out, numbers to the last digit."""

from __future__ import annotations

from typing import Any


def parsed(text: str) -> dict[str, Any]:
    """The mapping of a YAML file. Raises ValueError where it is none."""
    import yaml

    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as cause:
        raise ValueError(str(cause)) from cause
    if not isinstance(value, dict):
        raise ValueError("no keys")
    return value


def flow(values: list[float]) -> str:
    """A list in one line; YAML wants a point in a float that has an exponent."""
    return "[" + ", ".join(_number(v) for v in values) + "]"


def _number(value: float) -> str:
    text = repr(float(value))
    mantissa, exponent, power = text.partition("e")
    return mantissa + (".0" if exponent and "." not in mantissa else "") + exponent + power
