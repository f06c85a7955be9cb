"""Reader of a file as an `Exposure`: its pixels and its metadata."""

from __future__ import annotations

import hashlib
import os
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.types import TIME_SIGMA_S, Bools, Exposure
from startrack.exposure import decoding
from startrack.exposure.correction import correct_counts, correction_warnings, mask_of
from startrack.exposure.facts import Facts, resolve_facts
from startrack.exposure.mosaic import MOSAIC_WARNING, equalize_mosaic
from startrack.exposure.sidecar import stem


def read_exposure(
    path: str | os.PathLike[str],
    *,
    time_utc: datetime | None = None,
    time_sigma_s: float | None = None,
    exposure_s: float | None = None,
    camera: str | None = None,
    terrain: str | None = None,
    mask: str | None = None,
    dark: str | None = None,
    flat: str | None = None,
) -> Exposure:
    """The image at `path` (PNG, TIFF, JPEG or FITS by its content, or camera raw by its suffix) with its metadata.

    Pixels (H, W) are the counts in the file [ADU], 16 bits kept; pixel (0, 0) is the first of the first row stored,
    in FITS too; orientation tags are ignored. `time_utc` (mid-exposure), `time_sigma_s` (of the clock), `exposure_s`,
    `camera`, `terrain`, `mask` (path of an 8-bit image), `dark` and `flat` (paths of a dark frame and a flat field)
    replace the values of sidecar and header, which are then not read. The counts are corrected by dark frame and flat
    field, as in `correct_counts`. `warnings` lists ignored facts and causes, and a time of the file that differs from
    `time_utc`.

    Raises:
        BadInput: bad_image with file and cause in one line; no_time if a sidecar's time is not UTC; size_mismatch for
            a dark frame or flat field of another size.
        ValueError: `time_sigma_s` is no usable number of seconds.
    """
    raw, decoded = decoding.decode_file(path)
    given = Facts(
        time_utc=time_utc, time_sigma_s=time_sigma_s, exposure_s=exposure_s, camera=camera, terrain=terrain, mask=mask,
        dark=dark, flat=flat,
    )  # fmt: skip
    facts = resolve_facts(Path(path), decoded.header, given)
    return exposure_of_decoded(decoded, facts, raw=raw, name=stem(Path(path)), path=os.fspath(path))


def exposure_of_decoded(decoded: decoding.Decoded, facts: Facts, *, raw: bytes, name: str, path: str) -> Exposure:
    """The exposure of pixels `decoded` from the bytes `raw`, with its `facts`, `name` (stem) and `path`.

    They are corrected by the dark frame and the flat field of the facts; then the pixels of a mosaic are equalized.
    Raises BadInput (bad_image, size_mismatch) for a dark frame or flat field that cannot be used.
    """
    pixels, correction, notes = decoded.pixels_adu, None, decoded.warnings
    colour_already = decoded.mosaic is None and decoding.COLOUR_WARNING in decoded.warnings
    mosaic = not colour_already and bool(decoded.mosaic or facts.bayer_pattern)
    if facts.dark is not None or facts.flat is not None:
        pixels, correction = correct_counts(pixels, decoded.saturation_adu, facts.dark, facts.flat, mosaic=mosaic)
        notes += correction_warnings(facts.dark, facts.flat, facts.exposure_s)
    if mosaic:
        pixels = equalize_mosaic(pixels, decoded.saturation_adu)
        notes += (MOSAIC_WARNING,)
    return Exposure(
        pixels_adu=pixels,
        name=name,
        path=path,
        time_utc=facts.time_utc,
        time_sigma_s=TIME_SIGMA_S if facts.time_sigma_s is None else facts.time_sigma_s,
        time_sigma_is_stated=facts.time_sigma_s is not None,
        exposure_s=facts.exposure_s,
        camera=facts.camera,
        terrain=facts.terrain,
        air=facts.air,
        mask=facts.mask,
        obstacles=facts.obstacles,
        saturation_adu=decoded.saturation_adu,
        sha256=hashlib.sha256(raw).hexdigest(),
        header_site_rad=facts.site_rad,
        row_order=facts.row_order,
        warnings=notes + facts.warnings,
        correction=correction,
    )


def exposure_of(
    pixels: NDArray[Any], *, time_utc: datetime | None = None, name: str = "array", masked: Bools | None = None
) -> Exposure:
    """The counts `pixels` (H, W) [ADU], or colours (H, W, 3), as an exposure with `time_utc` and `name` alone.

    Pixels do not count where `masked`, of the same shape, is true in any colour. `sha256` is that of type, shape and
    values. Raises BadInput bad_image.
    """
    flat_grey = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if not flat_grey or pixels.dtype.kind not in "uif":
        raise decoding.bad_image(
            f"an array of {pixels.dtype} {pixels.shape}; startrack takes numbers (H, W) or (H, W, 3)"
        )
    decoding.check_size(pixels.shape[1], pixels.shape[0])
    if masked is not None:  # the values there, which may be anything, are no part of the exposure
        pixels = np.where(masked, pixels.dtype.type(0), pixels)
    grey, notes = decoding.grey_float32(pixels)
    return Exposure(
        pixels_adu=grey,
        name=name,
        time_utc=time_utc,
        mask=None if masked is None else mask_of(masked if masked.ndim == 2 else np.any(masked, axis=2)),
        saturation_adu=decoding.largest_value(pixels.dtype),
        sha256=hashlib.sha256(f"{pixels.dtype.str} {pixels.shape}".encode() + pixels.tobytes()).hexdigest(),
        warnings=notes,
    )
