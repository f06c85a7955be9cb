"""A measured skyline in the formats of other programs: CSV, ECSV, N.I.N.A., Stellarium, a picture."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import permutations
from pathlib import Path

import numpy as np

from startrack.applications.horizon.frames import SkyFrame
from startrack.applications.horizon.landscape import (
    GAP_DEG,
    HORIZON_LIST,
    LANDSCAPE,
    TEXTURE,
    interpolate_unknown,
    landscape_picture,
    landscape_text,
    unrolled_photographs,
    zip_bytes,
)
from startrack.core.errors import BadOutput
from startrack.core.files import check_output as check_file
from startrack.core.files import printable, write_atomically
from startrack.core.types import Array, MeasuredSkyline
from startrack.frames import Site
from startrack.output import (
    cloud_texts,
    encoded_bytes,
    png_bytes,
    skyline_picture,
    skyline_table_text,
    skyline_texts_deg,
)

SKYLINE_SUFFIXES = (".csv", ".ecsv", ".hrz", ".png", ".zip")  # and none: the folder of a Stellarium landscape


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
