"""A measured skyline in the formats of other programs: CSV, ECSV, N.I.N.A., Stellarium, a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from startrack.core.errors import BadOutput
from startrack.core.files import check_output as check_file
from startrack.core.files import write_atomically
from startrack.core.types import Array, BadInput, MeasuredSkyline
from startrack.frames import Site
from startrack.output import png_bytes, skyline_picture, skyline_table_text, skyline_texts_deg

SKYLINE_SUFFIXES = (".csv", ".ecsv", ".hrz", ".png")  # and none: the folder of a Stellarium landscape
LANDSCAPE, HORIZON_LIST = "landscape.ini", "horizon.txt"
GAP_DEG = -10.0  # altitude of a Stellarium landscape where the skyline is unknown: the gap is seen
TINY_DEG = 1e-5  # Stellarium draws a polygon with a corner at exactly 0 or 180 degrees badly


def kind_of(output: str) -> str:
    """The suffix of an output path, "" for a folder. Raises BadOutput (bad_image, for lack of a better code)."""
    suffix = "" if output.endswith(("/", "\\")) else Path(output).suffix.lower()
    if suffix not in (*SKYLINE_SUFFIXES, ""):
        known = ", ".join(SKYLINE_SUFFIXES)
        raise BadOutput("bad_image", f"{output}: the suffix is none of {known}; a name without one is a folder")
    return suffix


def output_files(output: str) -> tuple[Path, ...]:
    """The files that `write_skyline` writes for an output path."""
    path = Path(output)
    return (path,) if kind_of(output) else (path / LANDSCAPE, path / HORIZON_LIST)


def check_output(output: str, *, overwrite: bool) -> None:
    """Raise BadOutput if `output` has an unknown suffix, takes no files, or exists and `overwrite` is False."""
    for path in output_files(output):
        check_file(path, overwrite=overwrite)


def needs_all_azimuths(output: str) -> bool:
    """Whether the format of the file `output` cannot leave azimuths empty."""
    return kind_of(output) == ".hrz"


def write_skyline(output: str, skyline: MeasuredSkyline, site: Site, *, overwrite: bool) -> tuple[Path, ...]:
    """Write the `skyline` of a `site` in the format of the suffix of `output`; the files.

    Existing files are replaced with `overwrite` only. Raises BadInput if the format cannot hold the skyline.
    """
    files, kind = output_files(output), kind_of(output)
    if kind == ".png":
        data = [png_bytes(skyline_picture(skyline))]
    elif kind:
        text_of = {".csv": csv_text, ".ecsv": skyline_table_text, ".hrz": nina_text}[kind]
        data = [text_of(skyline).encode("utf-8")]
    else:
        data = [landscape_text(Path(output).name, site).encode("utf-8"), horizon_list_text(skyline).encode("utf-8")]
    for path, content in zip(files, data, strict=True):
        write_atomically(path, content, overwrite=overwrite)
    return files


def csv_text(skyline: MeasuredSkyline) -> str:
    """One row a degree; elevation and sigma are empty where the skyline is unknown, and `is_measured` is 0."""
    columns = *skyline_texts_deg(skyline), [str(int(known)) for known in skyline.known], skyline.source.tolist()
    rows = ["azimuth_deg,elevation_deg,sigma_deg,is_measured,source", *map(",".join, zip(*columns, strict=True))]
    return "\n".join(rows) + "\n"


def nina_text(skyline: MeasuredSkyline) -> str:
    """Lines "azimuth altitude" in degrees from 0 to 360, as N.I.N.A. reads them (# begins a comment)."""
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


def landscape_text(name: str, site: Site) -> str:
    """The landscape.ini of a polygonal landscape, as the Stellarium User Guide describes it."""
    return (
        "[landscape]\n"
        f"name = {name}\n"
        "author = startrack\n"
        "description = Skyline measured in photographs of the night sky\n"
        "type = polygonal\n"
        f"polygonal_horizon_list = {HORIZON_LIST}\n"
        "polygonal_horizon_list_mode = azDeg_altDeg\n"
        f"polygonal_angle_rotatez = {TINY_DEG:.5f}\n"
        "ground_color = 0.15,0.2,0.15\n"
        "horizon_line_color = 0.4,0.6,0.8\n"
        "\n"
        "[location]\n"
        "planet = Earth\n"
        f"latitude = {np.degrees(site.latitude_rad):.6f}\n"
        f"longitude = {np.degrees(site.longitude_rad):.6f}\n"
        f"altitude = {site.height_m:.0f}\n"
    )


def interpolate_unknown(skyline: MeasuredSkyline) -> Array:
    """Elevations (n,) with the unknown ones interpolated between their neighbours around the compass.

    Raises BadInput (bad_image, for lack of a better code) if none is known.
    """
    known = skyline.known
    if not known.any():
        raise BadInput("bad_image", "the skyline is unknown at all azimuths")
    at, elevation = skyline.azimuth_rad[known], skyline.elevation_rad[known]
    return np.asarray(np.interp(skyline.azimuth_rad, at, elevation, period=2 * np.pi))
