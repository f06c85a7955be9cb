"""The commands from images to results: locate, identify, detect, batch, track, report and demo."""

from __future__ import annotations

import argparse

from startrack.cli import flags
from startrack.cli.flags import (
    Command,
    Either,
    cluster_address,
    count,
    field_or_range_rad,
    flag,
    function_at,
    geo_formats,
    half_turn,
    seconds,
)
from startrack.core import NARROWEST_DEG, REPORTED_IMAGES, WIDEST_DEG

INPUT = (flags.IMAGES, flags.TOPIC, *flags.FACTS)
SKYLINE = (
    flag(
        "--skyline FILE",
        "in place of images: columns azimuth_deg, elevation_deg, sigma_deg (as NAME.skyline.ecsv has them), or a "
        "polyline x_px, y_px[, sigma_px] with -c and --attitude",
    ),
    flag(
        "--attitude FILE|AZ,PITCH,ROLL",
        "attitude of the camera of a polyline: a result of startrack, or degrees: azimuth and elevation of the optical "
        "axis, and a clockwise turn about it (--attitude=-10,...)",
    ),
    flag("--heading-sigma DEG", "error of the attitude about the vertical; 180: not known", half_turn),
    flag("--tilt-sigma DEG", "error of the vertical, about each of two level axes", half_turn),
    flag("--correlation DEG", "azimuth over which errors of heights are alike (1)", half_turn),
)
SHARED = {"output": flags.OUTPUT, "more": (flags.NO_SEED, *flags.MORE)}
COMMANDS = (
    Command(
        "locate", function_at("pictures.locate.locate"), "picture to position and attitude",
        "Locate the camera in each image: detect, identify, attitude, evidence, position. Camera, terrain and time "
        "come from flags, else from NAME.json beside the image, else from its header. Writes NAME.fix.json, "
        "NAME.stars.ecsv, NAME.skyline.ecsv, NAME.wcs, NAME.corr, NAME.annotated.png and NAME.skyline.png. With "
        "--skyline the position is by a skyline that was measured elsewhere, without stars and time.",
        {
            "input": (flags.SOME_IMAGES, *flags.MAIN_FACTS),
            "more about the input": (
                flags.TOPIC, *flags.OTHER_FACTS,
                flag("--fov DEG", argparse.SUPPRESS),  # a flag of identify and calibrate
            ),
            "a measured skyline": SKYLINE,
            "method": (*flags.METHOD, flags.TIME_LIMIT),
            "output": (
                *flags.OUTPUT,
                flag(
                    "--format geojson[,kml]", "write NAME.geojson, NAME.kml or both: position, 95 %% circle, attitude",
                    geo_formats, action="extend", default=[],
                ),
                flag(
                    "--explain",
                    "what the image of a refused or wide answer would need (exposure, facts, skyline in view, time, "
                    "camera file, terrain), on stderr or in JSON as explain",
                ),
                flag("--report", "add a page for a browser, as startrack report makes it"),
            ),
            "more": SHARED["more"],
        },
        example="startrack locate sample_images/near-centre.png", memory_later=True,
    ),
    Command(
        "identify", function_at("pictures.locate.identify"), "stars and attitude only",
        "Name the stars of each image and give the attitude. Needs a camera file, or with --fov only the approximate "
        "field of view: the lens is then found with the stars. No terrain is needed; without a time the catalogue is "
        "taken at J2000.0 and 60 arcsec are added to the stated errors. Writes NAME.identification.json, "
        "NAME.stars.ecsv, NAME.wcs, NAME.corr and NAME.annotated.png.",
        {
            "input": (
                *INPUT,
                flag(
                    "--fov DEG|MIN..MAX",
                    "no camera file: field of view in degrees, good to 10 %%, or the least and the largest; "
                    "below 100 across the image's width, from there up of the whole image circle, even where the "
                    "frame clips it. Takes 12 stars, 7 below 100 degrees",
                    lambda text: field_or_range_rad(text, NARROWEST_DEG, WIDEST_DEG),
                ),
            ),
            "method": (flags.POINTING, flags.SITE, flags.TIME_LIMIT),
            "output": (
                *flags.OUTPUT,
                flag("--catalog-table", "list in NAME.stars.ecsv the stars in the frame that were not identified too"),
            ),
            "more": SHARED["more"],
        },
        example="startrack identify sky.png --fov 60", memory_later=True,
    ),
    Command(
        "detect", function_at("pictures.locate.detect"), "centroids only",
        "Find the point sources of each image. With a camera file fluxes are in electrons, without one in ADU and the "
        "PSF is measured from the image. Writes NAME.detections.json and NAME.annotated.png.",
        {"input": INPUT, **SHARED},
        example="startrack detect sky.png -c camera.toml", memory_later=True,
    ),
    Command(
        "batch", function_at("pictures.batch.run"), "every picture of a folder",
        "Locate the camera in every image of a tree, which OUT mirrors. A stopped run is resumed; images are repeated "
        "if they, their sidecar, camera or terrain file have changed. Adds results.ecsv, trajectory.tum, timings.ecsv, "
        "manifest.json and, with the extra parquet, results.parquet. Exit codes: 0 every image solved; 5 some not "
        "solved, or stopped early (Ctrl-C, SIGTERM, a full disk, a closed pipe); 1 an internal error; 2 usage; 4 bad "
        "input.",
        {
            "input": (
                flag("folder FOLDER", "folder of the images, with all below it; or a ROS bag"), *flags.MAIN_FACTS,
            ),
            "more about the input": (
                flags.TOPIC, *flags.OTHER_FACTS,
                flag("--files-on-stdin", "only the images listed on stdin, one a line, or ended by NUL"),
            ),
            "method": flags.METHOD,
            "output": (
                flags.DIR, flags.AGAIN, flags.JSON, flags.NO_PLOTS,
                flag("--report", "add OUT/report.html, a page for a browser"),
            ),
            "more": (Either((flags.JOBS, flag(*flags.CLUSTER_TEXTS, cluster_address))), flags.NO_SEED, *flags.MORE),
        },
        example="startrack batch NIGHT/ -c camera.toml -t shackleton -D results",
    ),
    Command(
        "track", function_at("pictures.track.run"), "pictures of a drive or of a rover at rest to a trajectory",
        "Locate the images of one camera and estimate its trajectory from all of them, with the errors that they "
        "share. Writes track.tum (by all images), track.filtered.tum (by the images up to each), track.ecsv, "
        "track.geojson, track.json, track.png and track.html.",
        {
            "input": (
                flag("frames FRAMES", "images, one folder, or one ROS bag", nargs="+"), *flags.MAIN_FACTS,
            ),
            "more about the input": (flags.TOPIC, *flags.OTHER_FACTS),
            "method": (flags.EVIDENCE, flags.NEAR_ATTITUDE),
            "motion between the images (without: each is alone but for shared errors)": (
                flag("--odometry FILE", "TUM text, or a ROS bag"),
                flag("--odometry-topic TOPIC", "topic of the odometry in a bag that has several"),
                *flags.ODOMETRY, flags.ODOMETRY_TIME, flags.MAX_SPEED,
                flag("--at-rest", "the camera did not move"),
            ),
            "live": (
                flag("--follow", "take images as they are written into the folder FRAMES"),
                flag("--until-idle S", "end after S seconds without an image", seconds),
            ),
            "output": (*flags.OUTPUT, flag("--report", "as of locate and batch; the page is written without it too")),
            "more": (flags.NO_SEED, *flags.MORE),
        },
        "startrack track DRIVE/ --odometry odometry.tum -c camera.toml -t shackleton",
    ),
    Command(
        "report", function_at("pictures.report.run"), "results as one page for a browser",
        "Write OUT/report.html: every result of the folder OUT, in one file that needs no server and no network. Of a "
        "single NAME.fix.json it writes NAME.report.html beside it.",
        {
            "input": (
                flag("out OUT", "folder of results, or one NAME.fix.json"),
                flag("--truth FOLDER", "folder with NAME.truth.json of the images, to show the errors"),
            ),
            "output": (
                flag("-o --output FILE", "file of the page"),
                flag("--images N", "number of images with picture and stars; the table contains all", count,
                     default=REPORTED_IMAGES),
            ),
            "more": flags.MORE,
        },
        "startrack report startrack-out", memory_later=True,
    ),
    Command(
        "demo", function_at("pictures.report.run_demo"), "make a picture, locate it and open the report",
        "Render a fisheye picture from a crater floor, locate it, and open the report in a browser. Writes demo.png "
        "with the truth beside it, and the results of startrack locate.",
        {
            "output": (flags.DIR, flag("--no-open", "do not open the report in a browser")),
            "more": (flag("--seed N", "of attitude, time and noise", int, default=1), *flags.MORE),
        },
        "startrack demo",
    ),
)  # fmt: skip
