"""`startrack locate`, `identify` and `detect`: one image to its position, to its attitude, or to its centroids."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from startrack.cli import flags
from startrack.cli.flag_types import fields_of_view_rad, geo_formats
from startrack.cli.flags import Command, check_localizer, flag
from startrack.cli.images import Outcome, camera_of, check_fov, read, result_path, run_images
from startrack.cli.progress import prepare_reference

if TYPE_CHECKING:
    from startrack.camera import Camera
    from startrack.chain import Settings
    from startrack.core.types import Exposure

NARROWEST_DEG, WIDEST_DEG = 3.0, 280.0  # fields of view of `identify`
WIDE_RAD = math.radians(100.0)  # from here up the field of view is that of the image circle


def locate(args: argparse.Namespace) -> int:
    """Locate every image; the exit code of the worst."""
    if args.fov is not None:
        args.usage_error(
            "a position needs the lens better than --fov finds it: make a camera file with startrack calibrate "
            f"--fov {args.fov} IMAGE... -o CAMERA.toml, then startrack locate -c CAMERA.toml"
        )
    from startrack.chain import Settings
    from startrack.core.types import PositionPrior

    check_localizer(args)
    near = None if args.near is None else PositionPrior(*args.near)
    settings = Settings(localizer=args.localizer, evidence_sources=args.evidence, near=near)
    code = run_images(args, "startrack.fix/1", partial(_locate_image, args, settings))
    if args.report:
        from startrack.cli.report import write_page_of_images

        write_page_of_images(args.dir, args.images)
    return code


def _locate_image(args: argparse.Namespace, settings: Settings, path: str, stem: str) -> Outcome:
    from startrack.chain import locate_exposure, with_timing
    from startrack.output import explain, summary_line, verbose_text, write_geo, write_results

    exposure, _, out, read_ms = _read_timed(args, path, stem, ".fix.json", lambda exposure: None)
    if exposure.time_utc is not None and exposure.camera is not None:
        prepare_reference(exposure.terrain, args)
    start = time.perf_counter()
    result = with_timing(locate_exposure(exposure, settings), read=read_ms)
    more = {"explain": explain(result)} if args.explain else {}
    record = write_results(result, out, plots=not args.no_plots, more=more)
    write_geo(out, result, args.format)
    line = summary_line(result, seconds=read_ms / 1e3 + time.perf_counter() - start)
    if args.verbose:
        line += "\n" + verbose_text(result) + f"\n  written to {Path(args.dir)}/{stem}.*"
    return record, line


def _read_timed(
    args: argparse.Namespace, path: str, stem: str, suffix: str, find_camera: Callable[[Exposure], Camera | None]
) -> tuple[Exposure, Camera | None, Path, float]:
    """The image, its camera, the path of its result, and the milliseconds that these took."""
    start = time.perf_counter()
    exposure = read(path, args)
    camera = find_camera(exposure)
    out = result_path(args, stem, suffix, exposure)
    return exposure, camera, out, 1e3 * (time.perf_counter() - start)


def identify(args: argparse.Namespace) -> int:
    """Identify every image; the exit code of the worst."""
    check_fov(args)
    return run_images(args, "startrack.identification/1", partial(_identify_image, args))


def _identify_image(args: argparse.Namespace, path: str, stem: str) -> Outcome:
    from startrack import chain
    from startrack.catalog import load_catalog
    from startrack.output import lens_text, summary_line, verbose_text, write_results

    exposure, camera, out, read_ms = _read_timed(
        args, path, stem, ".identification.json", lambda one: camera_of(one) if args.fov is None else None
    )
    start = time.perf_counter()
    if camera is not None:
        result: chain.Oriented | chain.Refused = chain.identify(exposure, camera, load_catalog())
    else:
        result = chain.identify_blind(exposure, args.fov, load_catalog())
    result = chain.with_timing(result, read=read_ms)
    record = write_results(result, out, plots=not args.no_plots)
    line = summary_line(result, seconds=read_ms / 1e3 + time.perf_counter() - start)
    if camera is None and isinstance(result, chain.Oriented):
        fov = _found_fov_text(result.camera, args.fov)
        line += f"\n  {lens_text(result.camera)}; a camera file: startrack calibrate --fov {fov} IMAGE"
    return record, line + ("\n" + verbose_text(result) if args.verbose else "")


def _found_fov_text(camera: Camera, fovs_rad: tuple[float, ...]) -> str:
    """The field of view in degrees, of those tried [rad], that is closest to that of the `camera` found."""
    import numpy as np

    middle, right = camera.centre_px[1], camera.size_px[0] - 0.5
    width_rad = float(camera.angle_rad(np.array([[-0.5, middle], [right, middle]])).sum())
    closest = min(
        fovs_rad, key=lambda fov: abs(math.log(fov / (width_rad if fov < WIDE_RAD else 2 * camera.max_angle_rad)))
    )
    return f"{math.degrees(closest):.4g}"


def detect(args: argparse.Namespace) -> int:
    """Detect in every image; the exit code of the worst."""
    return run_images(args, "startrack.detection/1", partial(_detect_image, args))


def _detect_image(args: argparse.Namespace, path: str, stem: str) -> Outcome:
    from startrack import chain
    from startrack.output import summary_line, write_results

    exposure, camera, out, read_ms = _read_timed(
        args, path, stem, ".detections.json", lambda one: None if one.camera is None else camera_of(one)
    )
    start = time.perf_counter()
    result = chain.with_timing(chain.detect(exposure, camera), read=read_ms)
    record = write_results(result, out, plots=not args.no_plots)
    return record, summary_line(result, seconds=read_ms / 1e3 + time.perf_counter() - start)


INPUT = (flags.IMAGES, flags.TOPIC, *flags.FACTS)
SHARED = {"output": flags.OUTPUT, "more": (flags.NO_SEED, *flags.MORE)}
COMMANDS = (
    Command(
        "locate", locate, "image to position and attitude",
        "Locate the camera in each image: detect, identify, attitude, evidence, position. Camera, terrain and time "
        "come from flags, else from NAME.json beside the image, else from its header. Writes NAME.fix.json, "
        "NAME.stars.ecsv, NAME.skyline.ecsv, NAME.wcs, NAME.corr, NAME.annotated.png and NAME.skyline.png.",
        {
            "input": (*INPUT, flags.TERRAIN, flag("--fov DEG", argparse.SUPPRESS)),  # a flag of identify and calibrate
            "method": flags.METHOD,
            "output": (
                *flags.OUTPUT,
                flag(
                    "--format geojson[,kml]", "write NAME.geojson, NAME.kml or both: position, 95 %% circle, attitude",
                    geo_formats, action="extend", default=[],
                ),
                flag(
                    "--explain",
                    "of a refused or wide answer: what the image would need (exposure, facts, skyline in view, time, "
                    "camera file, terrain), on stderr or in JSON as explain",
                ),
                flag("--report", "add a page for a browser, as startrack report makes it"),
            ),
            "more": SHARED["more"],
        },
        example="startrack locate sample_images/near-centre.png",
    ),
    Command(
        "identify", identify, "stars and attitude only",
        "Name the stars of each image and give the attitude. Needs a camera file, or with --fov only the approximate "
        "field of view: the lens is then found with the stars. No terrain is needed; without a time the catalogue is "
        "taken at J2000.0 and 60 arcsec are added to the stated errors. Writes NAME.identification.json, "
        "NAME.stars.ecsv, NAME.wcs, NAME.corr and NAME.annotated.png.",
        {
            "input": (
                *INPUT,
                flag(
                    "--fov DEG|MIN..MAX",
                    "no camera file: field of view in degrees, good to 10 %%, or a range that is tried in steps; below "
                    "100 across the image's width, from there up of the whole image circle, even where the frame clips "
                    "it. Takes 12 stars, 7 below 100 degrees",
                    lambda text: fields_of_view_rad(text, NARROWEST_DEG, WIDEST_DEG),
                ),
            ),
            **SHARED,
        },
        example="startrack identify sky.png --fov 60",
    ),
    Command(
        "detect", detect, "centroids only",
        "Find the point sources of each image. With a camera file fluxes are in electrons, without one in ADU and the "
        "PSF is measured from the image. Writes NAME.detections.json and NAME.annotated.png.",
        {"input": INPUT, **SHARED},
        example="startrack detect sky.png -c camera.toml",
    ),
)  # fmt: skip
