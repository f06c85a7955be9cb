"""Units of heights, as map files spell them."""

from __future__ import annotations

from functools import cache

from startrack.terrain.earth_projection import FOOT_M

SURVEY_FOOT_M = 1200 / 3937
PREFIXES = {"": 1.0, "k": 1e3, "d": 0.1, "c": 0.01, "m": 1e-3, "kilo": 1e3, "deci": 0.1, "centi": 0.01, "milli": 1e-3}
METRES = {"": ("m",), "long": ("metre", "meter")}  # after a short and after a long prefix
FEET = "ft", "foot", "feet"
SURVEY_WORDS = "us survey {}", "survey {}", "us {}", "{} us", "{}us", "us{}", "{} us survey", "u.s. survey {}"
INTERNATIONAL_WORDS = "{}", "international {}", "intl {}", "{} international", "{} i"
SURVEY_FOOT_WORD = "sft"  # of BT files


def metres_of(unit: str) -> float | None:
    """The length [m] of a `unit` as map files spell it; None for one that is not known."""
    word = " ".join(unit.lower().strip(" \t\n\0'\"<>[]").replace("_", " ").replace("-", " ").split())
    word = word.replace("(", "").replace(")", "")
    return _units_m().get(word)


@cache
def _units_m() -> dict[str, float]:
    """Lengths [m] by their lower-case names: those of PROJ, and common spellings."""
    from pyproj.database import get_units_map

    found = {name.lower(): float(unit.conv_factor) for name, unit in get_units_map(category="linear").items()}
    for prefix, factor in PREFIXES.items():
        names = METRES["" if len(prefix) == 1 else "long"] + (METRES[""] if not prefix else ())
        found |= {f"{prefix}{name}{plural}": factor for name in names for plural in ("", "s") if name + plural != "ms"}
    found |= {form.format(foot): SURVEY_FOOT_M for form in SURVEY_WORDS for foot in FEET}
    found |= {form.format(foot): FOOT_M for form in INTERNATIONAL_WORDS for foot in FEET}
    return found | {SURVEY_FOOT_WORD: SURVEY_FOOT_M}
