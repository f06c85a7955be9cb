"""A measured skyline in the formats of other programs: CSV, ECSV, N.I.N.A., landscapes for Stellarium, a picture.

The texture of a spherical landscape begins at the east and runs through south, west and north: its column of an azimuth
A [deg] is (A - 90) / 360 of its width with `angle_rotatez = 0` (`LandscapeSpherical::getOpacity` of Stellarium).
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import cv2
import numpy as np
from numpy.typing import NDArray

from startrack.applications.horizon.columns import image_points
from startrack.applications.horizon.frames import SkyFrame
from startrack.applications.horizon.measure import skyline_at
from startrack.core.errors import BadOutput
from startrack.core.files import check_output as check_file
from startrack.core.files import printable, write_atomically
from startrack.core.types import Array, BadInput, MeasuredSkyline
from startrack.frames import Site
from startrack.output import (
    cloud_texts,
    encoded_bytes,
    png_bytes,
    skyline_picture,
    skyline_table_text,
    skyline_texts_deg,
)

LANDSCAPE, HORIZON_LIST, TEXTURE = "landscape.ini", "horizon.txt", "panorama.png"
GAP_DEG = -10.0  # altitude of a Stellarium landscape where the skyline is unknown: the gap is seen
TINY_DEG = 1e-5  # Stellarium draws a polygon with a corner at exactly 0 or 180 degrees badly
TEXTURE_PX = (4096, 2048)  # width and height; all graphics cards take it, and a pixel has 0.09 degrees
FIRST_AZIMUTH_RAD = np.radians(90.0)  # of the left edge
PLAIN_RGB, UNMEASURED_RGB = (38, 51, 38), (110, 45, 30)  # of ground that no photograph shows; at unknown azimuths
UNMEASURED_ALPHA = 0.5  # of what the photographs show there: it is seen, and the stars behind it are
LEVELS_PERCENT = (1.0, 99.5)  # of the light of the ground, from black to white: lamps are few
GREY, GREY_GAMMA = (15.0, 215.0), 0.5  # of these levels, and the power between them: night is dark
OVERLAP_PX = 3.0  # of the texture, by which the photograph is drawn beyond the skyline, where it is transparent
BAND_ROWS = 128  # of the texture at once
FILE_MODE = 0o100644  # of the files in an archive: a regular file that all may read
ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the first one that the format has: the same results give the same bytes
SKYLINE_SUFFIXES = (".csv", ".ecsv", ".hrz", ".png", ".zip")  # and none: the folder of a Stellarium landscape


def landscape_text(name: str, site: Site, *, has_texture: bool) -> str:
    """The landscape.ini of a polygonal landscape, or of a spherical one that has a texture."""
    what = ["description = Skyline measured in photographs of the night sky", "type = polygonal"]
    look = ["ground_color = 0.15,0.2,0.15", "horizon_line_color = 0.4,0.6,0.8"]
    if has_texture:
        what = ["description = Photographs of the night sky below the skyline measured in them", "type = spherical"]
        look = [f"maptex = {TEXTURE}", "maptex_top = 90", "maptex_bottom = -90", "angle_rotatez = 0"]
    polygon = [
        f"polygonal_horizon_list = {HORIZON_LIST}", "polygonal_horizon_list_mode = azDeg_altDeg",
        f"polygonal_angle_rotatez = {TINY_DEG:.5f}",
    ]  # fmt: skip
    place = [
        "planet = Earth", f"latitude = {np.degrees(site.latitude_rad):.6f}",
        f"longitude = {np.degrees(site.longitude_rad):.6f}", f"altitude = {site.height_m:.0f}",
    ]  # fmt: skip
    head = ["[landscape]", f"name = {name}", "author = startrack"]
    return "\n".join([*head, *what, *polygon, *look, "", "[location]", *place]) + "\n"


def zip_bytes(folder: str, files: Mapping[str, bytes]) -> bytes:
    """A ZIP archive of a `folder` with `files` by their names, as Stellarium installs landscapes."""
    archive = io.BytesIO()
    with ZipFile(archive, "w", ZIP_DEFLATED) as target:
        for name, content in files.items():
            entry = ZipInfo(f"{folder}/{name}", ZIP_TIME)
            entry.compress_type, entry.external_attr = ZIP_DEFLATED, FILE_MODE << 16
            target.writestr(entry, content)
    return archive.getvalue()


def landscape_picture(frames: Sequence[SkyFrame], skyline: MeasuredSkyline) -> NDArray[np.uint8]:
    """The texture (H, W, 4) of a spherical landscape: red, green, blue, and alpha, which is 0 above the `skyline`.

    Below it is the mean of the photographs of `frames` in grey, a plain colour where none shows the ground. Where the
    skyline is unknown it is interpolated; down to GAP_DEG the texture is half transparent there, in another colour.
    Raises BadInput as `interpolate_unknown`.
    """
    px_rad = np.pi / TEXTURE_PX[1]
    across, down = (px_rad * (np.arange(count, dtype=np.float64) + 0.5) for count in TEXTURE_PX)
    azimuth, elevation = (FIRST_AZIMUTH_RAD + across) % (2 * np.pi), np.pi / 2 - down
    measured = np.isfinite(skyline_at(skyline, azimuth))
    edge = skyline_at(replace(skyline, elevation_rad=interpolate_unknown(skyline)), azimuth)
    depth_px = (edge - elevation[:, None]) / px_rad  # (H, W) below the skyline
    solid = np.where(measured | (elevation[:, None] < np.radians(GAP_DEG)), 1.0, UNMEASURED_ALPHA)
    lights = [_ground_light(frame, azimuth, elevation, depth_px > -OVERLAP_PX) for frame in frames]
    grey = _mean_grey(lights, depth_px > 0.5)[:, :, None]
    plain = np.where(measured[:, None], PLAIN_RGB, UNMEASURED_RGB)
    picture = np.empty((*depth_px.shape, 4), dtype=np.uint8)
    drawn = np.where(measured[:, None], grey, 0.5 * (grey + UNMEASURED_RGB))
    picture[:, :, :3] = np.rint(np.where(np.isfinite(grey), drawn, plain))
    picture[:, :, 3] = np.rint(255.0 * solid * np.clip(depth_px + 0.5, 0.0, 1.0))
    return picture


def unrolled_photographs(frames: Sequence[SkyFrame], azimuth_rad: Array, elevation_rad: Array) -> Array:
    """The mean of the photographs of `frames` as levels of grey (H, W), nan where none shows the direction.

    Rows have the elevations (H,), columns the azimuths (W,).
    """
    everywhere = np.ones((len(elevation_rad), len(azimuth_rad)), dtype=np.bool_)
    return _mean_grey([_ground_light(frame, azimuth_rad, elevation_rad, everywhere) for frame in frames], everywhere)


def interpolate_unknown(skyline: MeasuredSkyline) -> Array:
    """Elevations (n,) with the unknown ones interpolated between their neighbours around the compass.

    Raises BadInput (bad_image, for lack of a better code) if none is known.
    """
    known = skyline.known
    if not known.any():
        raise BadInput("bad_image", "the skyline is unknown at all azimuths")
    at, elevation = skyline.azimuth_rad[known], skyline.elevation_rad[known]
    return np.asarray(np.interp(skyline.azimuth_rad, at, elevation, period=2 * np.pi))


def _ground_light(frame: SkyFrame, azimuth: Array, elevation: Array, drawn: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The light (H, W) of a photograph at azimuths (W,) and elevations (H,), where `drawn` (H, W); nan out of view.

    Masked pixels do not count; single hot pixels are taken out.
    """
    detections, light = frame.detections, np.full(drawn.shape, np.nan, dtype=np.float32)
    smooth = cv2.medianBlur(detections.image_e.astype(np.float32), 3)
    hidden = np.zeros(smooth.shape, np.uint8) if detections.mask is None else detections.mask.masked.astype(np.uint8)
    for first in range(0, len(elevation), BAND_ROWS):
        band = slice(first, first + BAND_ROWS)
        if not drawn[band].any():
            continue
        x, y, inside = image_points(frame.camera, frame.R_cam_enu, azimuth, elevation[band, None])
        inside &= drawn[band] & (cv2.remap(hidden, x, y, cv2.INTER_NEAREST) == 0)
        light[band] = np.where(inside, cv2.remap(smooth, x, y, cv2.INTER_LINEAR), np.nan)
    return light


def _mean_grey(lights: Sequence[NDArray[np.float32]], ground: NDArray[np.bool_]) -> Array:
    """The mean (H, W) of `lights` as a level of grey, each stretched by its own light on the `ground`; else nan."""
    total, count = np.zeros(ground.shape), np.zeros(ground.shape)
    for light in lights:
        seen = np.isfinite(light)
        if not (seen & ground).any():
            continue
        low, high = np.percentile(light[seen & ground], LEVELS_PERCENT)
        part = np.clip((light[seen] - low) / max(high - low, np.finfo(np.float32).tiny), 0.0, 1.0)
        total[seen] += GREY[0] + (GREY[1] - GREY[0]) * part**GREY_GAMMA
        count[seen] += 1
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(count > 0, count, np.nan))


def kind_of(output: str) -> str:
    """The suffix of an output path, "" for a folder. Raises BadOutput (bad_image, for lack of a better code)."""
    suffix = "" if output.endswith(("/", "\\")) else Path(output).suffix.lower()
    if suffix not in (*SKYLINE_SUFFIXES, ""):
        known = ", ".join(SKYLINE_SUFFIXES)
        raise BadOutput("bad_image", f"{output}: the suffix is none of {known}; a name without one is a folder")
    return suffix


def output_files(output: str) -> tuple[Path, ...]:
    """The files that `write_skyline` writes for one of its outputs."""
    path = Path(output)
    return (path,) if kind_of(output) else (path / LANDSCAPE, path / HORIZON_LIST)


def check_outputs(*outputs: str, overwrite: bool) -> None:
    """Raise BadOutput for one of the `outputs` of an unknown suffix, that takes no files, or has the path of another.

    It is raised for a file that exists, too, if `overwrite` is False.
    """
    files = [path for output in outputs for path in output_files(output)]
    for path in files:
        check_file(path, overwrite=overwrite)
    for one, other in permutations([Path(os.path.realpath(path)) for path in files], 2):
        if one == other or one in other.parents:
            raise BadOutput("bad_image", f"{printable(one)}: two outputs have this path")


def needs_all_azimuths(output: str) -> bool:
    """Whether the format of the file `output` cannot leave azimuths empty."""
    return kind_of(output) == ".hrz"


def write_skyline(
    skyline: MeasuredSkyline, site: Site, frames: Sequence[SkyFrame], *outputs: str, overwrite: bool
) -> tuple[Path, ...]:
    """Write the `skyline` of a `site` to each of the `outputs` in the format of its suffix; the files.

    `frames` are the photographs, from which the landscape of a `.zip` is drawn. Existing files are replaced with
    `overwrite` only. Raises BadInput, and writes nothing, if one of the formats cannot hold the skyline.
    """
    made = {path: data for output in outputs for path, data in _encoded(output, skyline, site, frames)}
    for path, data in made.items():
        write_atomically(path, data, overwrite=overwrite)
    return tuple(made)


def _encoded(
    output: str, skyline: MeasuredSkyline, site: Site, frames: Sequence[SkyFrame]
) -> Iterator[tuple[Path, bytes]]:  # fmt: skip
    """The files of one output with their content."""
    kind, name = kind_of(output), Path(output).stem
    if kind == ".png":
        data = [png_bytes(skyline_picture(skyline, partial(unrolled_photographs, frames) if frames else None))]
    elif kind == ".zip":
        data = [zip_bytes(name, _landscape_files(name, skyline, site, frames))]
    elif kind:
        text_of = {".csv": csv_text, ".ecsv": skyline_table_text, ".hrz": nina_text}[kind]
        data = [text_of(skyline).encode("utf-8")]
    else:
        data = list(_landscape_files(Path(output).name, skyline, site).values())
    return zip(output_files(output), data, strict=True)


def _landscape_files(
    name: str, skyline: MeasuredSkyline, site: Site, frames: Sequence[SkyFrame] = ()
) -> dict[str, bytes]:
    """The files of a Stellarium landscape by their names, with a texture where `frames` are given."""
    made = {
        LANDSCAPE: landscape_text(name, site, has_texture=bool(frames)).encode("utf-8"),
        HORIZON_LIST: horizon_list_text(skyline).encode("utf-8"),
    }
    if frames:
        made[TEXTURE] = encoded_bytes(".png", landscape_picture(frames, skyline)[:, :, [2, 1, 0, 3]])
    return made


def csv_text(skyline: MeasuredSkyline) -> str:
    """CSV text, a row for each degree; where the skyline is unknown its numbers are empty, and `is_measured` is 0."""
    is_measured = [str(int(known)) for known in skyline.known]
    columns = *skyline_texts_deg(skyline), is_measured, skyline.source.tolist(), cloud_texts(skyline)
    head = "azimuth_deg,elevation_deg,sigma_deg,is_measured,source,cloud_probability"
    rows = [head, *map(",".join, zip(*columns, strict=True))]
    return "\n".join(rows) + "\n"


def nina_text(skyline: MeasuredSkyline) -> str:
    """Text of lines "azimuth altitude" in degrees from 0 to 360, as N.I.N.A. reads them (# begins a comment)."""
    rows = _rows(skyline, interpolate_unknown(skyline), "{:g} {:.3f}")
    return "\n".join([*rows, f"360 {rows[-len(skyline)].split()[1]}"]) + "\n"


def horizon_list_text(skyline: MeasuredSkyline) -> str:
    """The list of azimuth and altitude of a polygonal landscape, with gaps where the skyline is unknown."""
    elevation_rad = np.where(skyline.known, skyline.elevation_rad, np.radians(GAP_DEG))
    return "\n".join(_rows(skyline, elevation_rad, "{:.1f} {:.3f}")) + "\n"


def _rows(skyline: MeasuredSkyline, elevation_rad: Array, form: str) -> list[str]:
    """Comments with the azimuths that are not measured or differ, then azimuths and elevations (n,) in a `form`."""
    azimuth_deg = np.round(np.degrees(skyline.azimuth_rad), 6)
    kinds = (~skyline.known, "not measured"), (skyline.source == "varies", "differs between pictures: the highest edge")
    comments = []
    for kind, words in kinds:
        at = np.flatnonzero(kind)
        runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else []
        comments += [f"# {azimuth_deg[run[0]]:g} to {azimuth_deg[run[-1]]:g}: {words}" for run in runs]
    rows = [form.format(*place) for place in zip(azimuth_deg, np.degrees(elevation_rad), strict=True)]
    return ["# azimuth altitude", *comments, *rows]
