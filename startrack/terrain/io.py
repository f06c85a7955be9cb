"""Terrain files (TOML): their keys, the terrain that they describe, and files with errors written in."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from startrack.core.declaration import Choice, Either, List, Number, Table, Text
from startrack.core.errors import Reason
from startrack.core.files import parse_toml, printable, read_text, resolve_named
from startrack.core.obstacles import read_obstacles
from startrack.core.types import Array, BadInput
from startrack.frames import AIR_TABLE, Site
from startrack.terrain.cylinder import CYLINDER_TABLE, make_cylinder
from startrack.terrain.dem import DEM_TABLE, FILE, HEIGHT, make_height_map, paths_of
from startrack.terrain.protocol import Terrain, TerrainFile
from startrack.terrain.shape import (
    AMOUNT,
    BIAS,
    CAMERA_ERROR,
    CYLINDER_FACTS,
    DEPTH,
    DIAMETER,
    LENGTH,
    OFFSETS,
    REFRACTION,
    REFRACTION_1,
    STRETCH,
    WAVE_PER_POST,
    WAVES,
    Fact,
    vertical_fact,
)

BORDER_RAD = np.radians(0.2)  # over which one patch goes over to the next
_LIGHT = Number(low=0.0, high=1000.0)
_PATCHES = {
    "low": Number(low=0.0, high=1000.0, required=True),
    "high": Number(low=0.0, high=1000.0, required=True),
    "size_deg": Number(low=1.0, high=360.0, required=True, description="of a patch in azimuth, about"),
    "seed": Number(low=0, high=2**32 - 1, integer=True, default=0),
}
GROUND_TABLE = Table(
    description="For pictures that are rendered.",
    keys={
        "brightness": Either(
            kinds=(_LIGHT, Table(keys=_PATCHES, closed=True)),
            description="light of the ground over that of the sky above it: a number, or patches of random brightness",
        )
    },
)


class Kind(NamedTuple):
    """A kind of ground in terrain files: the table of its keys, and the function that makes the terrain.

    `make` takes the checked keys of a file, the folder that its paths are relative to, and by name what all terrains
    have: name, site, camera_height_m and file.
    """

    keys: Table
    make: Callable[..., Terrain]


GROUNDS = {  # by the name of their table
    "cylinder": Kind(CYLINDER_TABLE, make_cylinder),
    "dem": Kind(DEM_TABLE, make_height_map),
}
KEYS = Table(
    keys={
        "format": Choice(values=(1,), default=1),
        "name": Text(max_chars=200),
        "body": Choice(values=("moon", "earth"), required=True),
        "origin": Table(
            description="Where the frame enu stands: moon, on the 1737.4 km sphere; earth, geodetic WGS 84.",
            required=True,
            keys={
                "latitude_deg": Number(low=-90.0, high=90.0, required=True),
                "longitude_deg": Number(low=-360.0, high=360.0, required=True, description="east positive"),
                "height_m": replace(HEIGHT, default=0.0),
            },
        ),
        **{name: kind.keys for name, kind in GROUNDS.items()},
        "air": replace(
            AIR_TABLE,
            keys={
                **AIR_TABLE.keys,
                "terrestrial_refraction": Number(low=-1.0, high=0.8, default=REFRACTION_1,
                                                 description="curvature of a level sight line to the ground, "
                                                             "relative to the Earth's"),
                REFRACTION.key: REFRACTION.limits,
            },
        ),
        "ground": GROUND_TABLE,
        "obstacles": replace(FILE, description="CSV file, relative to this one: azimuth_deg from north through east, "
                             "elevation_deg below which something that is on no map hides the skyline"),
        "rover": Table(
            default={},
            keys={
                "camera_height_m": replace(AMOUNT, default=1.5),
                CAMERA_ERROR.key: CAMERA_ERROR.limits,
            }
        ),
        "search": Table(
            default={},
            keys={
                "radius_m": LENGTH,
                "max_slope_deg": Number(low=0.0, high=90.0, above=True, default=90.0),
                "glare_deg": List(each=List(each=Number(low=-720.0, high=720.0), count=2),
                                  description="azimuth ranges that the Sun lights"),
            },
        ),
    },
)  # fmt: skip
HEIGHT_KEY = "height_sigma_m"


@dataclass(frozen=True, kw_only=True)
class GroundBrightness:
    """Light of the ground over that of the sky above it: patches in azimuth, each with a random number.

    The patches are equally wide, `size_rad` about, and begin at a random azimuth; the numbers are uniform between `low`
    and `high`. The same `seed` gives the same patches.
    """

    low: float
    high: float
    size_rad: float = 2 * np.pi
    seed: int = 0

    @classmethod
    def of(cls, stated: float | Mapping[str, Any]) -> Self:
        """The brightness that is `stated` as a value of the key `ground.brightness`.

        Raises BadInput bad_terrain for a `low` above `high`.
        """
        if not isinstance(stated, Mapping):
            return cls(low=stated, high=stated)
        low, high = stated["low"], stated["high"]
        if low > high:
            raise BadInput("bad_terrain", f"ground.brightness: low {low:g} is above high {high:g}")
        return cls(low=low, high=high, size_rad=float(np.radians(stated["size_deg"])), seed=stated["seed"])

    def __call__(self, azimuth_rad: Array) -> Array:
        """Brightness (...) at azimuths `azimuth_rad` (...) in enu."""
        at, patches_1 = self._knots
        return np.interp(azimuth_rad, at, patches_1, period=2 * np.pi)

    @property
    def value(self) -> float | dict[str, float]:
        """Value of the key `ground.brightness` that states this brightness."""
        if self.low == self.high:
            return self.low
        return {"low": self.low, "high": self.high, "size_deg": float(np.degrees(self.size_rad)), "seed": self.seed}

    @cached_property
    def _knots(self) -> tuple[Array, Array]:
        """Azimuths (n,) of the ends of all patches, and the brightness there, linear between them."""
        rng, count = np.random.default_rng(self.seed), max(round(2 * np.pi / self.size_rad), 1)
        begins = rng.uniform(0, 2 * np.pi) + np.arange(count) * 2 * np.pi / count
        ends = np.stack([begins + BORDER_RAD / 2, begins + 2 * np.pi / count - BORDER_RAD / 2], axis=1)
        return ends.ravel(), np.repeat(rng.uniform(self.low, self.high, count), 2)


def load_terrain(name_or_path: str | Path) -> Terrain:
    """The terrain of a file `name_or_path`: a path if it ends in .toml or contains a separator, else a shipped name.

    Raises BadInput bad_terrain with the file and the cause, out_of_memory for lack of memory.
    """
    path = resolve_named(name_or_path, "terrain", "bad_terrain")
    text = read_text(path, "bad_terrain")
    try:
        return _load_cached(path.absolute(), text, _file_stamps(path.parent, read_keys(text)))
    except BadInput as cause:
        reason = cause.reason if cause.reason is Reason.OUT_OF_MEMORY else "bad_terrain"
        raise BadInput(reason, f"{printable(path)}: {cause}") from cause


def files_of_terrain(path: str | Path) -> tuple[Path, ...]:
    """The files that the terrain of the file at `path` is read from, beside it; also where it cannot be loaded."""
    try:
        return load_terrain(path).file.paths
    except BadInput:  # refused when it is used; a map that is missing may come
        with suppress(BadInput):
            return _files_beside(read_keys(read_text(path, "bad_terrain")), Path(path).parent)
        return ()


def site_of_terrain(name_or_path: str | Path) -> Site:
    """The site of the terrain file that `load_terrain` finds by `name_or_path`; its maps are not read.

    Raises BadInput bad_terrain.
    """
    path = resolve_named(name_or_path, "terrain", "bad_terrain")
    return site_of_keys(read_keys(read_text(path, "bad_terrain")))


def site_of_keys(keys: dict[str, Any]) -> Site:
    """The site that the checked `keys` of a terrain file state."""
    origin = keys["origin"]
    site = Site(
        body=keys["body"],
        latitude_rad=float(np.radians(origin["latitude_deg"])),
        longitude_rad=float(np.radians(origin["longitude_deg"])),
        height_m=origin["height_m"],
    )
    return site.with_air(keys.get("air"))


def read_keys(text: str) -> dict[str, Any]:
    """The checked keys of a terrain file's text. Raises BadInput bad_terrain."""
    return KEYS.read(parse_toml(text, "bad_terrain"), "bad_terrain")


@lru_cache(maxsize=2)
def _load_cached(path: Path, text: str, stamps: tuple[Any, ...]) -> Terrain:
    """Terrain of a file's `text`, read once for many images: it takes some 0.3 GB and half a second."""
    return terrain_from_dict(parse_toml(text, "bad_terrain"), default_name=printable(path.stem), folder=path.parent)


def _map_files(keys: dict[str, Any], folder: Path) -> list[Path]:
    """Paths of the maps of the keys: those of its ground's key `file`, if it has one."""
    ground: dict[str, Any] = next((keys[name] for name in GROUNDS if name in keys), {})
    return paths_of(ground.get("file", ()), folder)


def _files_beside(keys: dict[str, Any], folder: Path) -> tuple[Path, ...]:
    """Paths of the files that the keys name: obstacles, and maps with the masks and labels that stand beside some."""
    obstacles = [folder / keys["obstacles"]] if "obstacles" in keys else []
    maps = _map_files(keys, folder)
    if not maps:
        return tuple(obstacles)
    from startrack.terrain.maps.reading import files_of_map

    return tuple(dict.fromkeys([*(file for path in maps for file in files_of_map(path)), *obstacles]))


def _file_stamps(folder: Path, keys: dict[str, Any]) -> tuple[Any, ...]:
    """Values that change when one of the files beside the terrain file does."""
    stamps: list[tuple[Any, ...]] = []
    for path in _files_beside(keys, folder):
        with suppress(OSError, ValueError):  # who reads it reports it
            status = path.stat()
            stamps.append((path.name, status.st_ino, status.st_size, status.st_mtime_ns))
    return tuple(stamps)


def terrain_from_dict(values: dict[str, Any], default_name: str = "terrain", folder: Path | None = None) -> Terrain:
    """The terrain of a terrain file's `values`, called `default_name` without a name; paths are relative to `folder`.

    Raises BadInput bad_terrain with the key that is wrong.
    """
    keys = KEYS.read(values, "bad_terrain")
    site = site_of_keys(keys)
    only_earth = [key for key in ("geoid_m", "geoid_slope_arcsec") if key in keys.get("dem", {})]
    if site.body != "earth" and only_earth:
        raise BadInput("bad_terrain", f"{only_earth[0]} is for the Earth, and the body is the {site.body.title()}")
    kinds = [kind for ground, kind in GROUNDS.items() if ground in keys]
    if len(kinds) != 1:
        what = "it has two grounds" if kinds else "it has no ground"
        raise BadInput("bad_terrain", f"{what}: give a [cylinder] with diameter_m and depth_m, or a [dem] with file")
    shared = {
        "name": keys.get("name", default_name), "site": site, "camera_height_m": keys["rover"]["camera_height_m"],
        "file": _file_facts(keys, folder or Path()),
    }  # fmt: skip
    return kinds[0].make(keys, folder or Path(), **shared)


def _file_facts(keys: dict[str, Any], folder: Path) -> TerrainFile:
    """Facts that the `keys` of a terrain file in a `folder` state beside the ground. Raises BadInput bad_terrain."""
    brightness = keys.get("ground", {}).get("brightness")
    obstacles = read_obstacles(folder / keys["obstacles"], "bad_terrain") if "obstacles" in keys else None
    light = None if brightness is None else GroundBrightness.of(brightness)
    return TerrainFile(paths=_files_beside(keys, folder), obstacles=obstacles, ground_brightness=light)


@dataclass(frozen=True)
class StateableError:
    """A key of a terrain file that states an error."""

    table: str  # of the file
    key: str
    meaning: str
    default: str  # what counts where the key is absent
    is_missing: bool  # and matters


def stateable_errors(text: str) -> list[StateableError]:
    """The errors that a terrain file with this `text` states or could state. Raises BadInput bad_terrain."""
    keys = read_keys(text)
    vertical = vertical_fact(keys["body"])
    dem, rover, cylinder = keys.get("dem", {}), keys.get("rover", {}), keys.get("cylinder")
    if cylinder is None and not dem:
        raise BadInput("bad_terrain", "the file has neither [cylinder] nor [dem]: its errors are not known")
    if cylinder is not None:
        sizes_m = {DEPTH.key: cylinder["depth_m"], DIAMETER.key: cylinder["diameter_m"]}
        inexact = not cylinder.get("exact", False)
        rows = [
            ("cylinder", fact, _default_text(fact, sizes_m.get(fact.key)), inexact and fact.key not in cylinder)
            for fact in CYLINDER_FACTS
        ]
        rows.append(("rover", CAMERA_ERROR, "0", False))
    else:
        rows = [
            ("dem", BIAS, f"three times what {HEIGHT_KEY} makes of the horizon", BIAS.key not in dem),
            *(("dem", fact, _default_text(fact), fact.key not in dem) for fact in (STRETCH, vertical)),
            ("dem", WAVES, _waves_text(), WAVES.key not in dem),
            ("dem", OFFSETS, _default_text(OFFSETS), OFFSETS.key not in dem and not isinstance(dem["file"], str)),
            ("rover", CAMERA_ERROR, _default_text(CAMERA_ERROR), CAMERA_ERROR.key not in rover),
        ]
        if keys["body"] == "earth":
            rows.append(("air", REFRACTION, _default_text(REFRACTION), REFRACTION.key not in keys.get("air", {})))
    found = [
        StateableError(table=table, key=fact.key, meaning=fact.meaning, default=default, is_missing=missing)
        for table, fact, default, missing in rows
    ]
    if cylinder is not None:
        return found
    meaning, default = "error of single heights of the map [m]", "0, with a warning"
    return [StateableError("dem", HEIGHT_KEY, meaning, default, is_missing=HEIGHT_KEY not in dem), *found]


def _waves_text() -> str:
    """Text of what counts where a file leaves the waves out."""
    gross = f"with probability {100 * WAVES.gross_probability:g} % a seam of {np.degrees(WAVES.gross_sigma):.4g}"
    return f"{WAVE_PER_POST:g} of what {HEIGHT_KEY} makes of the horizon, and {gross}"


def _default_text(fact: Fact, size_m: float | None = None) -> str:
    """Text of the prior of a `fact` that a file leaves out, in its key's unit; a relative error is one of `size_m`."""
    unit = 180.0 / np.pi if fact.key.endswith("_deg") else size_m or 1.0
    text = f"{fact.sigma * unit:.4g}"
    if fact.gross_probability:
        text += f", and with probability {100 * fact.gross_probability:g} % {fact.gross_sigma * unit:.4g}"
    return text


def state_errors(text: str, values: Mapping[tuple[str, str], float | bool]) -> str:
    """Text of a terrain file: `text` with `values`, by table and key, written in; all else is as before.

    Raises BadInput bad_terrain where a key is there already, or the file's notation leaves no place for it.
    """
    for (table, key), value in values.items():
        before = parse_toml(text, "bad_terrain")
        if key in before.get(table, {}):
            raise BadInput("bad_terrain", f"it states {table}.{key} already")
        wanted = {**before, table: {**before.get(table, {}), key: value}}
        line = f"{key} = {str(value).lower() if isinstance(value, bool) else repr(float(value))}"
        fits = (changed for changed in _places(text, table, line) if _keys_of(changed) == wanted)
        found = next(fits, None)
        if found is None:
            raise BadInput("bad_terrain", f"startrack finds no place for it: write `{line}` into [{table}] by hand")
        text = found
    return text


def _keys_of(text: str) -> dict[str, Any] | None:
    """Keys of a TOML `text`; None for any other text."""
    try:
        return parse_toml(text, "bad_terrain")
    except BadInput:
        return None


def _places(text: str, table: str, line: str) -> Iterator[str]:
    """Texts with the line after the last key of the table, after its header, or in a table of its own at the end."""
    end = "\r\n" if "\r\n" in text else "\n"
    lines = text.splitlines(keepends=True)
    for at, one in enumerate(lines):
        if re.match(rf"\s*\[\s*{table}\s*\]", one):
            rest = at + 1
            while rest < len(lines) and not re.match(r"\s*\[", lines[rest]):
                rest += 1
            while rest > at + 1 and re.match(r"\s*(#|$)", lines[rest - 1]):
                rest -= 1
            for place in (rest, at + 1):
                head = "".join(lines[:place])
                yield head + ("" if head.endswith("\n") else end) + line + end + "".join(lines[place:])
    yield text + ("" if text.endswith("\n") else end) + f"{end}[{table}]{end}{line}{end}"
