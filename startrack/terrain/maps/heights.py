"""Heights from the values of a map file: their unit, as files spell it, voids, and whether a body has such ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import Array, BadInput, Bools
from startrack.frames import MOON_RADIUS_M
from startrack.terrain.maps.projections import FOOT_M, MAX_NUMBER
from startrack.terrain.maps.raster import Raster
from startrack.terrain.shape import MAX_LENGTH_M

MARKS = -9999.0, -99_999.0, -32_768.0, -32_767.0, 32_767.0, 9999.0, 99_999.0, -(2.0**31)  # usual values for voids
FEWEST_SHARED = 3  # posts of one value that may be a void, where the value is not one of MARKS
STEEPEST_SHARE = 0.999  # of the steps between neighbours on the ground: most steps onto a void are higher
MAX_STEPS = 2_000_000  # that are looked at
FLAT_M = 20.0  # heights of the whole Moon or Earth in kilometres differ by less
FLAT_SHARE = 0.98  # of the posts, the middle ones, that differ by less on a map that is flat
CLIFF_M, CLIFF_SLOPE = 1_500.0, 2.0  # between neighbours: the highest wall (Mount Thor, 1250 m), and slopes over more
UNSTATED = "", "none", "unknown", "unspecified"  # units as decoders fill them in
UNITS_TO_TRY = {"feet": FOOT_M, "decimetres": 0.1, "centimetres": 0.01, "millimetres": 0.001}
AS_THEY_ARE = "if they are right, give --unusual-heights, or unusual_heights = true in [dem]"
SURVEY_FOOT_M = 1200 / 3937
PREFIXES = {"": 1.0, "k": 1e3, "d": 0.1, "c": 0.01, "m": 1e-3, "kilo": 1e3, "deci": 0.1, "centi": 0.01, "milli": 1e-3}
METRES = {"": ("m",), "long": ("metre", "meter")}  # after a short and after a long prefix
FEET = "ft", "foot", "feet"
SURVEY_WORDS = "us survey {}", "survey {}", "us {}", "{} us", "{}us", "us{}", "{} us survey", "u.s. survey {}"
INTERNATIONAL_WORDS = "{}", "international {}", "intl {}", "{} international", "{} i"
SURVEY_FOOT_WORD = "sft"  # of BT files


class Ground(NamedTuple):
    """The range of heights that the ground of a body has."""

    lowest_m: float
    highest_m: float  # above its sphere, or above the sea
    radii_km: tuple[float, float]  # from its centre

    def has(self, height_m: float) -> bool:
        """Whether the body has ground at a height [m] above its sphere or the sea, or from its centre."""
        low_km, high_km = self.radii_km
        return self.lowest_m <= height_m <= self.highest_m or low_km <= height_m / 1000.0 <= high_km


GROUNDS = {
    "moon": Ground(-9_200.0, 10_800.0, (1_700.0, 1_750.0)),
    "earth": Ground(-11_050.0, 9_000.0, (6_345.0, 6_395.0)),  # the deepest sea and the highest mountain, and 100 m
}


class Mark(NamedTuple):
    """A value of many posts of a map, onto which steps are higher than elsewhere on it."""

    value: float
    posts: int
    is_void: bool  # ground cannot be so; else it may be

    def note(self) -> str:
        """Text for the user: what posts of this value are taken as."""
        kind = "voids: the file does not state it, and no ground leads up to it" if self.is_void else (
            "ground, though most steps onto them are steeper than elsewhere: is it the value for voids? Then state it "
            f"(rio edit-info --nodata {self.value:g} FILE)"
        )  # fmt: skip
        return f"{self.posts} posts of value {self.value:g} are taken as {kind}; {AS_THEY_ARE}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Stored:
    """The content of a map file: height = unit x (offset + scale x value)."""

    values: Raster  # as the file has them
    missing: Bools  # (rows, columns), posts that the file marks as voids
    scale: float | None = None  # None where the file does not state it
    offset: float = 0.0
    units: tuple[str, ...] = ()  # every one that the file states
    notes: tuple[str, ...] = ()


def heights_of(stored: Stored, name: str, scale: float | None, offset_m: float | None, unusual: bool) -> Raster:
    """The map with heights [m above the sphere], NaN where it has none; its `notes` say what no tag states.

    scale and offset_m: of a flag or key, in the place of the file's. unusual: heights are taken as they are.
    Raises BadInput bad_terrain, with the `name` of the map, for values that are no heights of its body.
    """
    raster, values = stored.values, stored.values.heights_m
    if values.ndim != 2 or min(values.shape) < 2:
        raise BadInput(
            "bad_terrain",
            f"{name}: too small for a height map: {' x '.join(map(str, values.shape))} posts; give a larger one",
        )
    if values.dtype.kind not in "iuf":
        raise BadInput("bad_terrain", f"{name}: values of type {values.dtype} are no heights")
    scale, offset_m = _scale_and_offset(stored, name, scale, offset_m)
    numbers = (raster.x0_m, raster.y0_m, raster.dx_m, raster.dy_m, scale, offset_m)
    if not np.isfinite(numbers).all() or 0.0 in numbers[2:5] or max(map(abs, numbers)) > MAX_NUMBER:
        raise BadInput(
            "bad_terrain", f"{name}: its position, its scale or its offset is not a usable number: {numbers}"
        )
    known = ~stored.missing & np.isfinite(values)
    ground = GROUNDS[raster.projection.body]
    marks = () if unusual else find_marks(values, known, (scale, offset_m), raster.post_m, ground)
    for mark in marks:
        known &= (values != mark.value) | (not mark.is_void)
    with np.errstate(over="ignore", invalid="ignore"):
        heights = values.astype(np.float64) * scale + offset_m
    known &= np.abs(heights) < MAX_LENGTH_M
    if not known.any():
        raise BadInput("bad_terrain", f"{name}: no post has a height")
    if raster.projection.body == "moon" and np.median(heights[known]) > MOON_RADIUS_M / 2:  # counted from its centre
        heights -= MOON_RADIUS_M
    heights[~known] = np.nan
    if not unusual:
        _require_heights(heights[known], values[known], (scale, offset_m), raster.projection.body, name)
        _require_slopes(heights, raster.post_m, name)
    return replace(
        raster, heights_m=heights.astype(np.float32), notes=(*stored.notes, *(mark.note() for mark in marks))
    )


def _scale_and_offset(
    stored: Stored, name: str, scale: float | None, offset_m: float | None
) -> tuple[float, float]:  # fmt: skip
    """Metres of one step of the values, and the height of value 0 [m]. Raises BadInput bad_terrain."""
    units_m = {unit: metres_of(unit) for unit in stored.units if unit.strip().lower() not in UNSTATED}
    needed = scale is None or (offset_m is None and stored.offset != 0.0)
    for unit, metres in units_m.items():
        if metres is None and needed:
            flags = "--scale" if stored.offset == 0.0 else "--scale and --offset"
            raise BadInput(
                "bad_terrain",
                f"{name}: its unit of heights, {unit[:80]!r}, is not known: give the metres of one unit with {flags} "
                "of terrain import, or as scale and offset_m in [dem]",
            )
    known = [metres for metres in units_m.values() if metres is not None]
    if needed and known and max(known) > 1.0001 * min(known):  # the two feet differ by 2e-6
        raise BadInput(
            "bad_terrain",
            f"{name}: it states different units of heights ({', '.join(map(repr, units_m))}): give the metres of one "
            "unit with --scale of terrain import, or as scale in [dem]",
        )
    unit_m = known[0] if known else 1.0
    if scale is None and stored.scale is None and not known and stored.values.heights_m.dtype.kind in "iu":
        raise BadInput(
            "bad_terrain",
            f"{name}: it holds whole numbers and no scale: give the metres of one unit (1 where they are "
            "metres), with --scale of terrain import or as scale in [dem]",
        )
    own_scale = 1.0 if stored.scale is None else stored.scale
    return own_scale * unit_m if scale is None else scale, stored.offset * unit_m if offset_m is None else offset_m


def find_marks(
    values: NDArray[np.generic], known: Bools, scaling: tuple[float, float], post_m: float, ground: Ground
) -> tuple[Mark, ...]:  # fmt: skip
    """Values that are voids among the `known` posts of `values` (rows, columns), and 0 m where it may be one.

    scaling: metres of a step of the values, and height of value 0. post_m: spacing of the posts.
    The lowest value, the highest, or 0, which many posts share, is a void where most steps onto it are higher than
    those between other neighbours, and it is one of MARKS, or the `ground` has no such height or step.
    """
    known = known.copy()
    found: list[Mark] = []
    while known.any():
        inside = values[known]
        doubtful: list[Mark] = []
        for value in dict.fromkeys((float(inside.min()), float(inside.max()), 0.0)):
            count = int(np.count_nonzero(inside == value))
            if count < (1 if value in MARKS else FEWEST_SHARED):
                continue
            step_m, height_m = abs(scaling[0]) * _step_onto(values, known, value), scaling[0] * value + scaling[1]
            if step_m > 0 and (value in MARKS or not ground.has(height_m) or step_m > highest_step_m(post_m)):
                found.append(Mark(value, count, True))
                known &= values != value
                break
            if height_m == 0.0 and step_m > CLIFF_SLOPE * post_m:
                doubtful.append(Mark(value, count, False))
        else:
            return (*found, *doubtful)
    return tuple(found)


def highest_step_m(post_m: float) -> float:
    """Largest difference [m] of the heights of ground between posts `post_m` apart."""
    return CLIFF_M + CLIFF_SLOPE * post_m


def _step_onto(values: NDArray[np.generic], known: Bools, value: float) -> float:
    """Median step, in units of `values`, onto posts of a `value`; 0 unless higher than steps between others."""
    here = known & (values == value)
    others = known & ~here
    if not others.any() or np.ptp(values[others]) == 0:
        return 0.0
    onto: list[Array] = []
    between: list[Array] = []
    stride = max(1, values.size // MAX_STEPS)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        edge = (here[first] & others[second]) | (others[first] & here[second])
        onto.append(np.abs(values[first][edge].astype(np.float64) - values[second][edge].astype(np.float64)))
        rows = np.s_[::stride]
        both = others[first][rows] & others[second][rows]
        a, b = values[first][rows][both], values[second][rows][both]
        between.append(np.abs(a.astype(np.float64) - b.astype(np.float64)))
    steps = np.concatenate(onto)
    if not len(steps):  # surrounded by posts that are voids anyway
        steps = np.abs(values[others].astype(np.float64) - value).min(keepdims=True)
    rest = np.concatenate(between)
    step = float(np.median(steps))
    return step if step > (np.quantile(rest, STEEPEST_SHARE) if len(rest) else 0.0) else 0.0


def _require_heights(
    heights_m: Array, values: NDArray[np.generic], scaling: tuple[float, float], body: str, name: str
) -> None:  # fmt: skip
    """Raise BadInput bad_terrain, with the likely cause, for heights (n,) that no ground of the body has.

    values (n,): as the file has them; scaling: metres of their steps, and height of value 0.
    """
    ground, a_map = GROUNDS[body], f"{name}: "
    low, middle, high = np.quantile(heights_m, [0.5 - 0.5 * FLAT_SHARE, 0.5, 0.5 + 0.5 * FLAT_SHARE])
    quarters = np.quantile(heights_m, [0.25, 0.75])
    in_km = _advice_to_scale(scaling, 1000.0)
    if ground.radii_km[0] <= middle <= ground.radii_km[1] and np.ptp(quarters) <= FLAT_M:
        raise BadInput(
            "bad_terrain",
            f"{a_map}half of its heights are {quarters[0]:.6g} to {quarters[1]:.6g} m: are they kilometres from the "
            f"centre of the {body.title()}? {in_km}; {AS_THEY_ARE}",
        )
    outside = (heights_m < ground.lowest_m) | (heights_m > ground.highest_m)
    if outside.any():
        cause = _cause_of_range(heights_m, values, outside, scaling, ground)
        raise BadInput(
            "bad_terrain",
            f"{a_map}heights from {heights_m.min():.0f} to {heights_m.max():.0f} m are not of the {body.title()}'s "
            f"ground ({ground.lowest_m:.0f} to {ground.highest_m:.0f} m): {cause}; {AS_THEY_ARE}",
        )
    if high - low <= FLAT_M:
        raise BadInput(
            "bad_terrain",
            f"{a_map}{100 * FLAT_SHARE:.0f} % of its heights are {low:.6g} to {high:.6g} m, flatter than ground is: "
            f"are they kilometres? {in_km}; {AS_THEY_ARE}",
        )


def _advice_to_scale(scaling: tuple[float, float], metres: float) -> str:
    """Advice on what to state where the heights of a scale and an offset are in a unit of so many `metres`."""
    scale, offset = (f"{metres * value:.10g}" for value in scaling)
    if not scaling[1]:
        return f"Then state --scale {scale} of terrain import, or scale = {scale} in [dem]"
    return (
        f"Then state --scale {scale} --offset {offset} of terrain import, or scale = {scale} and offset_m = {offset} "
        "in [dem]"
    )


def _require_slopes(h: Array, post_m: float, name: str) -> None:
    """Raise BadInput bad_terrain for steps of heights `h` between neighbours that no ground has: voids of any value."""
    most = max(float(np.nanmax(np.abs(np.diff(h, axis=axis)), initial=0.0)) for axis in (0, 1))
    if most > highest_step_m(post_m):
        raise BadInput(
            "bad_terrain",
            f"{name}: neighbouring posts, {post_m:.3g} m apart, differ by up to {most:.0f} m, and heights are "
            f"{np.nanmin(h):.6g} to {np.nanmax(h):.6g} m: is one of these a value for voids? Then state it "
            f"(rio edit-info --nodata VALUE FILE); {AS_THEY_ARE}",
        )


def _cause_of_range(
    heights_m: Array, values: NDArray[np.generic], outside: Bools, scaling: tuple[float, float], ground: Ground
) -> str:  # fmt: skip
    """Likely faults of heights (n,), some `outside` of what the ground has: a void, the unit, the level."""
    wrong, counts = np.unique(values[outside], return_counts=True)
    most = int(np.argmax(counts))
    if 2 * counts[most] > len(heights_m[outside]) and 2 * np.count_nonzero(outside) < len(heights_m):
        return (
            f"is {float(wrong[most]):g}, the value of {counts[most]} posts, that for voids? Then state it "
            f"(rio edit-info --nodata {float(wrong[most]):g} FILE)"
        )
    causes = [
        f"are they {unit}? {_advice_to_scale(scaling, metres)}"
        for unit, metres in UNITS_TO_TRY.items()
        if metres * heights_m.min() >= ground.lowest_m and metres * heights_m.max() <= ground.highest_m
    ][:1]
    if np.ptp(heights_m) <= ground.highest_m - ground.lowest_m:
        causes.append(
            "do they count from another level? Then state the height of value 0: --offset, or offset_m in [dem]"
        )
    return "; ".join(causes) or "is a value for voids unstated (rio edit-info --nodata), or the unit another (--scale)?"


def note_bands(count: int, alphas: Sequence[int], descriptions: Sequence[str | None]) -> tuple[str, ...]:
    """Notes (none or one) on bands of a map file that are not read: all but the first and those of alpha."""
    others = [k for k in range(1, count) if k not in alphas]
    if not others:
        return ()
    named = [f"{k + 1} ({descriptions[k]})" if descriptions[k] else f"{k + 1}" for k in others[:5]]
    return (f"the first of its {count} bands is taken as the heights; not read: {', '.join(named)}",)


def metres_of(unit: str) -> float | None:
    """Length [m] of a `unit` as map files spell it; None for one that is not known."""
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
