"""Refusals in words: what each reason means for whoever took the picture, and what to try."""

from __future__ import annotations

# reason: (in words, what to try)
WORDS: dict[str, tuple[str, str]] = {
    "bad_image": (
        "The image cannot be used",
        "Mend what the message names: startrack takes one whole picture of one channel or three, a number in every "
        "pixel, as PNG, TIFF, FITS, JPEG or camera raw, and its sidecar, if any, in valid JSON.",
    ),
    "size_mismatch": (
        "The image's size is not the camera's",
        "Give the right camera file with -c, and the picture as it left the camera, neither cropped nor scaled.",
    ),
    "no_time": (
        "The time is not known",
        "Give the middle of the exposure in UTC: --time, time_utc in NAME.json, or DATE-AVG in a FITS header.",
    ),
    "no_calibration": (
        "No camera file is known",
        "Give one with -c or in NAME.json; startrack calibrate makes one from pictures of the open sky.",
    ),
    "bad_calibration": (
        "The camera file cannot be used",
        "Mend what the message names; docs/formats.md lists every key with its unit.",
    ),
    "bad_terrain": (
        "The terrain cannot be used",
        "Give a terrain file with -t or in NAME.json, and mend what the message names.",
    ),
    "no_stars": (
        "No stars stand out of the noise",
        "Expose longer, keep stray light out, check the lens cap and the focus.",
    ),
    "not_identified": (
        "The point sources match no part of the sky",
        "Check that the camera file is that of this lens; expose longer for more stars; where the lens is not known, "
        "startrack identify --fov finds it.",
    ),
    "mirrored": (
        "The image is a mirror image",
        "Read the sensor the other way round, or set mirrored in the camera file.",
    ),
    "insufficient_geometry": (
        "The stars leave the position open",
        "More of the skyline must be in view, with stars on both sides of it: look up more steeply, use a wider lens, "
        "or expose longer.",
    ),
    "outside_search_area": (
        "The stars point to a place outside the search area",
        "Check time and terrain; enlarge [search] radius_m in the terrain file if the rover may be farther out.",
    ),
    "inconsistent_evidence": (
        "The horizon seen is not the one that the map predicts",
        "Check terrain, time and camera height; something that no map has (a boulder, the lander) may stand in view.",
    ),
    "ambiguous": (
        "More than one place fits",
        "Take another picture some way off, expose longer, or narrow [search] in the terrain file to where the rover "
        "can be.",
    ),
    "internal_error": (
        "The program met a fault of its own",
        "Please report it with the image; startrack locate IMAGE -v shows where it happened.",
    ),
}  # fmt: skip


def words_of(reason: str | None) -> tuple[str, str]:
    """A reason as a heading, and what to try; reasons that are not known are shown as they are."""
    if not reason:
        return "", ""
    return WORDS.get(reason, (reason.replace("_", " ").capitalize(), ""))
