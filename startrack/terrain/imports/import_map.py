"""Import of elevation data: crops as GeoTIFF beside a terrain file that states the errors of the maps."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from startrack.core.errors import BadOutput, length_text
from startrack.core.files import check_output, data_dir, printable, write_atomically
from startrack.core.types import BadInput
from startrack.frames import Site
from startrack.terrain.ground import fill_cut_out
from startrack.terrain.height_map import HeightMap
from startrack.terrain.horizon_table import AZIMUTH_BINS
from startrack.terrain.imports.comparison import (
    Correlation,
    compare_with_finest,
    map_of_rim,
    measure_waves,
    offsets_of_maps_m,
)
from startrack.terrain.imports.roughness import carried_spacing, error_between_posts_m, find_product
from startrack.terrain.io import site_of_keys, terrain_from_dict
from startrack.terrain.maps.ellipsoid import ELLIPSOID, Geoid, geoid_at, maps_above_ellipsoid
from startrack.terrain.maps.raster import Raster
from startrack.terrain.maps.reading import SUFFIX, Grid, map_of_array, read_array, read_map, require_origin
from startrack.terrain.maps.writing import write_map
from startrack.terrain.shape import CAMERA_ERROR, OFFSETS, REFRACTION, REFRACTION_1, STRETCH, WAVES, vertical_fact

MAX_POST_RADII = 0.2  # of the search area: with posts further apart its shape is not resolved
MEASURED_PER_ESTIMATE = 1.6  # of the 240 m map on the ground of site01-10m.tif: 5.4 m measured, 3.3 m by its roughness
COMMENT_CHARS = 118
IN_ITS_PLACE = {
    "moon": "in its place to 15 m (vertical_sigma_deg)",
    "earth": "with heights above the geoid, whose slope is a tilt (vertical_sigma_deg; state it as geoid_slope_arcsec)",
}
OTHER_FACTS = (
    "The map is taken to be to scale (stretch_sigma_1) and {place}, the camera at its height to 2 cm "
    "(camera_height_sigma_m): change what you know better."
)


@dataclass(frozen=True, kw_only=True)
class StatedErrors:
    """Errors of a map, and their origin: "flag", "comparison" (with a finer map), "product" (published) or "map"
    (its own roughness).
    """

    height_sigma_m: float
    common_crest_sigma_m: float | None = None  # of heights, shared by the crests about a position; None: not measured
    correlation: Correlation | None = None  # of the heights of crests against a finer map
    origin: str
    comment: str
    warnings: tuple[str, ...] = ()

    def comment_lines(self, body: str, waves: str) -> str:
        """The comment of a terrain file on its errors; `body` is that of the map, `waves` the source of the waves."""
        text = f"{self.comment}."
        if self.common_crest_sigma_m is not None:
            text += (
                f" horizon_sigma_deg: crests wrong by {length_text(self.common_crest_sigma_m)} all around, at their "
                "median distance; at least three times the error of heights, as at the sharp rim of Shackleton."
            )
        if waves:
            text += f" {WAVES.key}: {waves}."
        text += f" {OTHER_FACTS.format(place=IN_ITS_PLACE[body])}"
        return textwrap.fill(text, COMMENT_CHARS, initial_indent="# ", subsequent_indent="# ") + "\n"


@dataclass(frozen=True, kw_only=True)
class ImportedTerrain:
    """The terrain file that was written, the errors that it states, and warnings about its maps."""

    path: Path
    errors: StatedErrors
    warnings: list[str]


def import_maps(
    maps: Sequence[str | Path], output: str | Path, *, latitude_rad: float, longitude_rad: float,
    half_m: Sequence[float], radius_m: float, scale: Sequence[float] = (), offset_m: Sequence[float] = (),
    height_sigma_m: float | None = None, compare: Sequence[str | Path] = (), camera_height_m: float = 1.5,
    highest_beyond_m: float | None = None, geoid_grid: str | Sequence[str] | None = None, grid: Grid | None = None,
    cut_out_m: float | None = None, unusual_heights: bool = False, overwrite: bool = False,
) -> ImportedTerrain:  # fmt: skip
    """Write the terrain file `output` and, beside it, a crop of each map: NAME-1.tif, the finest, and so on.

    latitude_rad, longitude_rad: the origin. half_m: half the side of each crop about it [m]. radius_m: of the search
    area. scale, offset_m: of each map, the finest first, in the place of what the files state. height_sigma_m: error
    of single posts [m]; None measures it where a finer map covers a part of the map that makes the horizon: one of the
    `maps`, of the files `compare`, or a shipped one; else it is estimated from the map's roughness, with the published
    error of products that are known. camera_height_m: above the ground [m]. highest_beyond_m: ground off the maps is no
    higher; None: as `io.KEYS` says. geoid_grid: of PROJ, from which heights of the maps count (None: their geoid is not
    known), or one for each map, ELLIPSOID where they are above the ellipsoid. grid: where the posts of arrays (`.npy`)
    stand. cut_out_m: voids up to so wide are what was cut out of the maps, see `io.KEYS`. unusual_heights: see
    `read_map`. overwrite: replace existing files.

    Raises BadInput bad_terrain, BadOutput of `output`; nothing is then written.
    """
    output = Path(output)
    if output.suffix != ".toml":
        raise BadOutput("bad_terrain", f"{output}: a terrain file's name ends in .toml")
    origin = latitude_rad, longitude_rad
    latitude_deg, longitude_deg = (round(float(np.degrees(angle)), 9) for angle in origin)
    if not abs(latitude_deg) <= 90:
        raise BadInput("bad_terrain", f"latitude {latitude_deg:g} is not within -90..90")
    files = [output.with_name(f"{output.stem}-{k + 1}.tif") for k in range(len(maps))]
    for path in (output, *files):
        check_output(path, overwrite=overwrite, reason="bad_terrain")
    wholes: list[Raster] = []
    for k, source in enumerate(maps):
        own: dict[str, Any] = {
            "scale": scale[k] if k < len(scale) else None, "offset_m": offset_m[k] if k < len(offset_m) else None,
            "unusual_heights": unusual_heights,
        }  # fmt: skip
        body = wholes[0].projection.body if wholes else None
        if grid is not None and Path(source).suffix.lower() == SUFFIX:
            own |= {"latitude_rad": latitude_rad, "longitude_rad": longitude_rad, "source": str(source)}
            wholes.append(map_of_array(read_array(source), grid, **own))
        else:
            wholes.append(read_map(source, near=origin, body=body, **own))
    require_origin(wholes, *origin)
    crops: list[Raster] = []
    for source, whole, half in zip(maps, wholes, half_m, strict=True):
        crop = whole.crop_around(*origin, half)
        if min(crop.heights_m.shape) < 2:
            raise BadInput("bad_terrain", f"{source}: it does not reach {latitude_deg:g}, {longitude_deg:g}")
        crops.append(replace(crop, source=Path(source).name))
    rim = map_of_rim(crops, radius_m)
    if height_sigma_m is None:
        errors = measure_errors(rim, [*crops, *(read_map(one, unusual_heights=unusual_heights) for one in compare)])
    else:
        errors = StatedErrors(height_sigma_m=float(height_sigma_m), origin="flag", comment="height_sigma_m: as given")
    body = crops[0].projection.body
    values: dict[str, Any] = {
        "format": 1, "name": printable(output.stem), "body": body,
        "origin": {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg},
        "dem": {
            "file": [path.name for path in files], "height_sigma_m": errors.height_sigma_m,
            "stretch_sigma_1": STRETCH.sigma,
            "vertical_sigma_deg": round(float(np.degrees(vertical_fact(body).sigma)), 9),
        },
        "rover": {"camera_height_m": float(camera_height_m), "camera_height_sigma_m": CAMERA_ERROR.sigma},
        "search": {"radius_m": float(radius_m)},
    }  # fmt: skip
    if highest_beyond_m is not None:
        values["dem"]["highest_beyond_m"] = float(highest_beyond_m)
    if body == "earth":
        at = crops[0].row_column(np.array(latitude_rad), np.array(longitude_rad))
        values["origin"]["height_m"] = float(
            np.nan_to_num(np.round(fill_cut_out(crops[0], cut_out_m or 0.0).sample(at)))
        )
        values["air"] = {"terrestrial_refraction": REFRACTION_1, REFRACTION.key: REFRACTION.sigma}
    if cut_out_m is not None:
        values["dem"]["cut_out_m"] = float(cut_out_m)
    if geoid_grid is not None:
        values["dem"] |= _geoid_values([geoid_grid] if isinstance(geoid_grid, str) else geoid_grid, values, len(crops))
    seams = _state_offsets(values, crops)
    terrain = _write_terrain(output, values, errors, dict(zip(files, crops, strict=True)))
    shifts = [(one.source, one.projection.transformation_warning) for one in crops]
    warnings = [f"{one.source}: {note}" for one in crops for note in one.notes]
    warnings += [*errors.warnings, *spacing_warnings(crops, radius_m), *(f"{a}: {b}" for a, b in shifts if b), *seams]
    warnings += end_warnings(terrain)
    warnings += smoothness_warnings(rim, errors.height_sigma_m)
    return ImportedTerrain(path=output, errors=errors, warnings=warnings)


def _geoid_values(grids: Sequence[str], values: dict[str, Any], maps: int) -> dict[str, Any]:
    """The keys of [dem] that state the geoid at the origin of a terrain file's `values`, by `grids` of PROJ."""
    if values["body"] != "earth":
        raise BadInput("bad_terrain", "heights above a geoid are those of maps of the Earth")
    if len(grids) not in (1, maps):
        raise BadInput("bad_terrain", f"{len(grids)} grids of the geoid for {maps} maps: give one, or one for each")
    at = values["origin"]
    latitude, longitude = (float(np.radians(at[name])) for name in ("latitude_deg", "longitude_deg"))
    site = Site("earth", latitude, longitude, at["height_m"])
    geoids = [Geoid(0.0, (0.0, 0.0)) if grid == ELLIPSOID else geoid_at(grid, site) for grid in grids]
    heights = [round(one.height_m, 3) for one in geoids]
    slopes = [[round(slope, 3) for slope in one.slope_arcsec] for one in geoids]
    one_for_all = len(grids) == 1
    return {
        "geoid_m": heights[0] if one_for_all else heights, "geoid_slope_arcsec": slopes[0] if one_for_all else slopes,
    }  # fmt: skip


def _state_offsets(values: dict[str, Any], crops: Sequence[Raster]) -> list[str]:
    """State in a terrain file's `values` the offset of its maps where it is larger than usual; a warning of each map.

    The file's own statement of the geoid counts.
    """
    on_earth = values["body"] == "earth"
    offsets_m = offsets_of_maps_m(
        maps_above_ellipsoid(crops, values["dem"], site_of_keys(values)) if on_earth else crops
    )
    if not offsets_m or max(map(abs, offsets_m)) <= OFFSETS.sigma:
        return []
    values["dem"][OFFSETS.key] = float(f"{max(map(abs, offsets_m)):.2g}")
    return [
        f"{one.source} stands {length_text(abs(off_m))} {'above' if off_m > 0 else 'below'} {crops[0].source} where "
        f"both are (median): is one above the ellipsoid, the other above the geoid? State it (--geoid, --offset); now "
        f"{OFFSETS.key} = {values['dem'][OFFSETS.key]:g} covers it"
        for one, off_m in zip(crops[1:], offsets_m, strict=True)
        if abs(off_m) > OFFSETS.sigma
    ]


def _write_terrain(output: Path, values: dict[str, Any], errors: StatedErrors, crops: dict[Path, Raster]) -> HeightMap:
    """Write maps and file of a terrain, and return it; they replace former ones only once it is known to load.

    The horizon's sigma, where it was measured, follows from the distance of the crests on the terrain.
    """
    import tomli_w

    with TemporaryDirectory(prefix=".", suffix=".part", dir=output.parent) as name:
        folder = Path(name)
        for path, crop in crops.items():
            try:
                write_map(folder / path.name, crop)
            except BadInput as cause:  # the folder is hidden: a user knows the place of the terrain
                if cause.reason != "disk_full":
                    raise
                raise BadInput(cause.reason, str(cause).replace(str(folder), str(output.parent))) from cause
            if not _is_usual(folder / path.name, crop):
                values["dem"]["unusual_heights"] = True
        try:
            terrain = cast(HeightMap, terrain_from_dict(values, folder=folder))
        except BadInput as cause:
            notes = [f"{crop.source}: {note}" for crop in crops.values() for note in crop.notes]
            raise BadInput(cause.reason, "; ".join([str(cause), *notes])) from cause
        if errors.common_crest_sigma_m is not None:
            angle_rad = errors.common_crest_sigma_m * terrain.crest_rad_per_m
            values["dem"]["horizon_sigma_deg"] = float(f"{np.degrees(angle_rad):.2g}")
        waves_rad, source = measure_waves(terrain, errors.correlation)
        if source:
            values["dem"][WAVES.key] = [float(f"{sigma:.2g}") for sigma in np.degrees(waves_rad)]
        text = errors.comment_lines(values["body"], source) + tomli_w.dumps(values)
        write_atomically(folder / output.name, text.encode("utf-8"), overwrite=True, reason="bad_terrain")
        try:
            for path in (*crops, output):
                (folder / path.name).replace(path)
        except OSError as cause:
            raise BadOutput("bad_terrain", f"{printable(path)}: cannot be written ({cause.strerror})") from cause
    return terrain


def _is_usual(path: Path, crop: Raster) -> bool:
    """Whether a `crop` is read from `path` without `unusual_heights` with no more voids: a small one may be flat."""
    try:
        return np.array_equal(np.isnan(read_map(path).heights_m), np.isnan(crop.heights_m))
    except BadInput:
        return False


def measure_errors(rim: Raster, others: Sequence[Raster]) -> StatedErrors:
    """Errors of the map that makes the horizon, from the finest other or shipped map that covers a part of it.

    Without one they are estimated from the roughness of the map itself.
    """
    shipped = map(read_map, sorted(data_dir("terrain").glob("*.tif")) if rim.projection.body == "moon" else ())
    comparison = compare_with_finest(rim, [*others, *shipped])
    if comparison is not None and comparison.same_ground:
        return StatedErrors(
            height_sigma_m=float(f"{comparison.height_sigma_m:.2g}"), origin="comparison",
            common_crest_sigma_m=comparison.common_crest_sigma_m, correlation=comparison.correlation,
            comment=f"{rim.source} {comparison.line()}",
        )  # fmt: skip
    warnings: tuple[str, ...] = ()
    if comparison is not None:
        warnings = (
            f"{rim.source} differs from {comparison.finer} by {length_text(comparison.height_sigma_m, 3)} (s.d.) where "
            f"both are, and heights vary there by {length_text(comparison.heights_sigma_m, 3)}: is its projection or "
            "its scale wrong?",
        )
    product = find_product(rim.source) if rim.projection.body == "earth" else None
    between_m = MEASURED_PER_ESTIMATE * error_between_posts_m(rim)
    if product is not None:
        return StatedErrors(
            height_sigma_m=float(f"{np.hypot(product.height_sigma_m, between_m):.2g}"), origin="product",
            warnings=warnings,
            comment=f"height_sigma_m: {product.name}, {product.height_sigma_m:g} m ({product.source}), and "
            f"{length_text(between_m)} between posts by the map's roughness",
        )  # fmt: skip
    return StatedErrors(
        height_sigma_m=float(f"{between_m:.2g}"), origin="map",
        warnings=warnings,
        comment=f"{rim.source or 'the map'} could not be compared with a finer map: height_sigma_m is "
        f"{MEASURED_PER_ESTIMATE:g} times the error that its own roughness shows, the ratio that was measured on the "
        "240 m map of the south pole. A finer map of a part of the ground (--compare) or a known error (--sigma) is "
        "better",
    )  # fmt: skip


def smoothness_warnings(rim: Raster, height_sigma_m: float) -> list[str]:
    """A warning if the map that makes the horizon is smoother than ground is at the spacing of its posts."""
    spacing = carried_spacing(rim.heights_m.astype(np.float64))
    if spacing <= 1:
        return []
    error_m = error_between_posts_m(rim, spacing)
    return [
        f"{rim.source or 'the map'} looks interpolated or smoothed: posts are {length_text(rim.post_m, 3)} apart, but "
        f"its ground is that of posts {length_text(spacing * rim.post_m)} apart, with errors of about "
        f"{length_text(error_m)} (height_sigma_m is {length_text(height_sigma_m)}); give the map it was made "
        "from, or a known error"
    ]


def end_warnings(terrain: HeightMap) -> list[str]:
    """A warning if ground off the maps of a `terrain` may hide stars that they show."""
    missing = int(np.count_nonzero(terrain.unknown_rad > -np.pi / 2)) * 360 // AZIMUTH_BINS
    if not missing:
        return []
    highest_deg = float(np.degrees(terrain.unknown_rad.max()))
    return [
        f"the maps end in {missing} of 360 degrees of azimuth, and ground beyond could stand up to {highest_deg:.1f} "
        "degrees high: no evidence is taken below that; add a wider map, or state how high ground beyond is "
        "(--highest-beyond M)"
    ]


def spacing_warnings(maps: Sequence[Raster], radius_m: float) -> list[str]:
    """A warning if the posts are so far apart that the shape of the search area is not resolved."""
    post_m = min(one.post_m for one in maps)
    if post_m <= MAX_POST_RADII * radius_m:
        return []
    return [
        f"posts are {post_m:.0f} m apart in a search area of {radius_m:.0f} m: such a map hardly distinguishes "
        "positions; give a finer one"
    ]
