"""The errors that a terrain file states of its map, and the comment on where they come from."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from startrack.core.errors import length_text
from startrack.core.files import data_dir
from startrack.terrain.map_comparison import MapComparison, compare_with_finest
from startrack.terrain.map_error import error_between_posts_m
from startrack.terrain.raster import Raster
from startrack.terrain.raster_io import read_map

MEASURED_PER_ESTIMATE = 1.6  # of the 240 m map on the ground of site01-10m.tif: 5.4 m measured, 3.3 m by its roughness
COMMENT_CHARS = 118
OTHER_FACTS = (
    "The map is taken to be to scale (stretch_sigma_1) and in its place to 15 m (vertical_sigma_deg), the camera at "
    "its height to 2 cm (camera_height_sigma_m): change what you know better."
)


@dataclass(frozen=True, kw_only=True)
class StatedErrors:
    """Errors of a map, and their origin: "flag", "comparison" (with a finer map) or "map" (its own roughness)."""

    height_sigma_m: float
    common_crest_sigma_m: float | None = None  # of heights, shared by the crests about a position; None: not measured
    origin: str
    comment: str
    warnings: tuple[str, ...] = ()

    def comment_lines(self) -> str:
        """The comment of a terrain file on its errors."""
        text = f"{self.comment}."
        if self.common_crest_sigma_m is not None:
            text += (
                f" horizon_sigma_deg: crests wrong by {length_text(self.common_crest_sigma_m)} all around, at their "
                "median distance; at least three times the error of heights, as at the sharp rim of Shackleton."
            )
        text += f" {OTHER_FACTS}"
        return textwrap.fill(text, COMMENT_CHARS, initial_indent="# ", subsequent_indent="# ") + "\n"


def measure_errors(rim: Raster, others: Sequence[Raster]) -> StatedErrors:
    """Errors of the map that makes the horizon, from the finest other or shipped map that covers a part of it.

    Without one they are estimated from the roughness of the map itself.
    """
    comparison = compare_with_finest(rim, [*others, *_shipped_maps()])
    if comparison is not None and comparison.same_ground:
        return StatedErrors(
            height_sigma_m=_rounded(comparison.height_sigma_m), common_crest_sigma_m=comparison.common_crest_sigma_m,
            origin="comparison", comment=f"{rim.source} {comparison.line()}",
        )  # fmt: skip
    return StatedErrors(
        height_sigma_m=_rounded(MEASURED_PER_ESTIMATE * error_between_posts_m(rim)), origin="map",
        warnings=_other_ground_warnings(rim, comparison),
        comment=f"{rim.source or 'the map'} could not be compared with a finer map: height_sigma_m is "
        f"{MEASURED_PER_ESTIMATE:g} times the error that its own roughness shows, the ratio that was measured on the "
        "240 m map of the south pole. A finer map of a part of the ground (--compare) or a known error (--sigma) is "
        "better",
    )  # fmt: skip


def _rounded(sigma_m: float) -> float:
    return float(f"{sigma_m:.2g}")


def _shipped_maps() -> list[Raster]:
    return [read_map(path) for path in sorted(data_dir("terrain").glob("*.tif"))]


def _other_ground_warnings(rim: Raster, comparison: MapComparison | None) -> tuple[str, ...]:
    """A warning where a map was compared and shows other ground."""
    if comparison is None:
        return ()
    return (
        f"{rim.source} differs from {comparison.finer} by {length_text(comparison.height_sigma_m, 3)} (s.d.) "
        f"where both are, and heights vary there by {length_text(comparison.heights_sigma_m, 3)}: is its projection or "
        "its scale wrong?",
    )
