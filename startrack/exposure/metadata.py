"""Time and its sigma, exposure seconds, camera, terrain of an image: from a flag, else its sidecar, else its header."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from startrack.core.types import Exposure, Mask
from startrack.exposure.header import header_number, header_pattern, header_reference, header_time
from startrack.exposure.sidecar import (
    NUMBERS,
    read_sidecar,
    sidecar_reference,
    sidecar_time,
    sidecar_value,
    unknown_key_warnings,
)
from startrack.frames import as_utc


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Metadata of an exposure besides its pixels; None if not known.

    Raises ValueError for an unusable `time_sigma_s`.
    """

    time_utc: datetime | None = None  # mid-exposure, timezone-aware
    time_sigma_s: float | None = None  # standard deviation of the clock's error
    exposure_s: float | None = None
    camera: str | None = None  # path, or name of a shipped file
    terrain: str | None = None  # path, or name of a shipped file
    mask: str | None = None  # path
    dark: str | None = None  # path of the dark frame
    flat: str | None = None  # path of the flat field
    bayer_pattern: str | None = None  # RGGB and the like: the pixels are a mosaic of colours
    warnings: tuple[str, ...] = ()  # values that were ignored, and why

    def __post_init__(self) -> None:
        if self.time_sigma_s is not None:
            object.__setattr__(self, "time_sigma_s", check_time_sigma_s(self.time_sigma_s, "time_sigma_s"))


def check_time_sigma_s(value: Any, name: str) -> float:
    """The standard deviation `value` [s] of a clock's error. Raises ValueError with a line that names it `name`."""
    return float(NUMBERS["time_sigma_s"].check(value, name))


def with_facts(
    exposure: Exposure,
    *,
    time_utc: datetime | None = None,
    time_sigma_s: float | None = None,
    exposure_s: float | None = None,
    camera: str | None = None,
    terrain: str | None = None,
    mask: str | Mask | None = None,
) -> Exposure:
    """The exposure with the values given here in place of its own; `time_utc` is mid-exposure.

    `time_sigma_s` is the standard deviation of the clock's error. `camera` and `terrain` are names or paths of files,
    `mask` is a path or the mask itself.

    A mid-exposure time computed from DATE-OBS and a header's EXPTIME does not change with a new `exposure_s`; give it
    to `read_exposure` for that. Raises ValueError for a time without zone and an unusable `time_sigma_s`.
    """
    given: dict[str, Any] = {"exposure_s": exposure_s, "camera": camera, "terrain": terrain, "mask": mask}
    given["time_utc"] = None if time_utc is None else as_utc(time_utc)
    if time_sigma_s is not None:
        given |= {"time_sigma_s": check_time_sigma_s(time_sigma_s, "time_sigma_s"), "time_sigma_is_stated": True}
    return replace(exposure, **{key: value for key, value in given.items() if value is not None})


def resolve_facts(image: Path, header: Mapping[str, Any], given: Facts) -> Facts:
    """The metadata of `image` from, in this order: `given` (flags), its sidecar, its header.

    A source is read only for values that the sources before it do not have. An unusable value in a sidecar raises
    BadInput (bad_image, or no_time); in a header, which any program may have written, it gives a warning.
    """
    sidecar, values = read_sidecar(image)
    notes: list[str] = [*given.warnings, *unknown_key_warnings(sidecar, values)]

    def first_number(key: str, flag: float | None) -> float | None:
        stated = sidecar_value(sidecar, values, key) if flag is None else flag
        return header_number(header, key, notes) if stated is None else stated

    exposure_s = first_number("exposure_s", given.exposure_s)
    time_utc = given.time_utc
    if time_utc is None:
        time_utc = sidecar_time(sidecar, values.get("time_utc"))
    if time_utc is None:
        time_utc = header_time(header, exposure_s, notes)
    return Facts(
        time_utc=None if time_utc is None else as_utc(time_utc),
        time_sigma_s=first_number("time_sigma_s", given.time_sigma_s),
        exposure_s=exposure_s,
        camera=given.camera
        or sidecar_reference(sidecar, values, "camera")
        or header_reference(image, header, "STCAMERA", notes),
        terrain=given.terrain
        or sidecar_reference(sidecar, values, "terrain")
        or header_reference(image, header, "STTERRAI", notes),
        mask=given.mask or sidecar_reference(sidecar, values, "mask"),
        dark=given.dark or sidecar_reference(sidecar, values, "dark"),
        flat=given.flat or sidecar_reference(sidecar, values, "flat"),
        bayer_pattern=sidecar_value(sidecar, values, "bayer_pattern") or header_pattern(header, notes),
        warnings=tuple(notes),
    )
