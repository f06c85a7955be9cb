"""The commands that need no image: render, predict, reproduce, doctor and schema."""

from __future__ import annotations

from startrack.cli import flags
from startrack.cli.flags import Command, Either, flag, function_at
from startrack.core import SKY_V_MAG_ARCSEC2

# The keys of startrack.applications.reproduction.ARTEFACTS, whose import would load numpy.
ARTEFACT_NAMES = (
    "table3.1", "fig3.3", "fig3.4", "fig3.5", "fig3.6", "fig3.7", "fig3.8", "fig3.9", "fig3.10", "figA.1", "figA.2",
    "figB", "magnitude", "aspect", "methods", "methods.shackleton", "methods.valley", "proposals",
)  # fmt: skip
DRIVE_FLAGS = (
    flag("--every SECONDS", "time between the exposures", flags.seconds),
    flag(
        "--path WAYPOINTS", "CSV file of waypoints, columns east_m,north_m: the rover drives along it, its nose forward"
    ),
    flag("--speed M_PER_S", "along the path", flags.positive_number),
    flag("--odometry-sigma F", "error of the odometry, as a part of each increment (as of `track`)", flags.amount),
    flag(
        "--odometry-floor M",
        "error of the odometry, added in quadrature to each increment (as of `track`)",
        flags.amount,
    ),
)
CACHE = """usage: startrack cache ACTION

look             startrack cache show     tables of horizons: folder, files, size
remove           startrack cache clear    the next commands compute them again"""
COMMANDS = (
    Command(
        "render", function_at("studies.render.run"), "synthetic pictures and files with their truth",
        "Render the image of a camera on the crater's floor. Position, heading, tilt and time are drawn from the seed "
        "unless they are given. With --every the exposures are at equal steps of time, at rest or, with --path, on a "
        "drive with odometry. Beside NAME.png: NAME.json (time, exposure, camera, terrain), NAME.truth.json (pose, "
        "settings) and NAME.truth.ecsv (stars).",
        {
            "input": (
                flag("-c --camera FILE", "camera file, or a shipped name", default="fisheye-2048"),
                flag("-t --terrain FILE", "terrain file, or a shipped name", default="shackleton-thesis"),
                flag("--seed N", "same seed, same bytes", flags.count, default=0),
                flag("-n --count N", "images (default 1; of a drive all along its path)", flags.positive_count),
            ),
            "pose and time (what is not given is drawn from the seed)": (
                flag("--time UTC", "middle of the exposure; else between 2024 and 2034"),
                flag(
                    "--time-sigma SECONDS",
                    "standard deviation of the clock's error (0; with --clock-offset not stated)", flags.time_sigma_s,
                ),
                flag(
                    "--clock-offset SECONDS",
                    "true minus stated time, for image and sidecar with the time of a wrong clock",
                    flags.clock_offset_s, default=0.0,
                ),
                flag("--east M", "from the terrain's origin", flags.number),
                flag("--north M", "from the terrain's origin", flags.number),
                flag("--heading DEG", "azimuth of the rover's nose", flags.number),
                flag("--pitch DEG", "nose up positive", flags.number),
                flag("--roll DEG", "right side down positive", flags.number),
                flag("--max-tilt DEG", "of random tilts", flags.amount, default=5.0),
            ),
            "series at rest (--every alone) or along a path": DRIVE_FLAGS,
            "light and defects": (
                flag(
                    "--exposure S",
                    "seconds; default: a V 6 star on the axis reaches 5 sigma, which takes fisheye-2048 0.40 s",
                    flags.seconds,
                ),
                flag("--sky-mag V", "diffuse sky per arcsec^2", flags.magnitude, default=SKY_V_MAG_ARCSEC2),
                flag("--sky-gradient F", "its slope to the horizon", flags.number, default=0.0),
                flag("--sky-gradient-azimuth DEG", "where it rises to", flags.number, default=0.0),
                flag(
                    "--wall-reflectance F", "of the sky's light, by the ground; default: the terrain file's, or 0.04",
                    flags.amount,
                ),
                flag(
                    "--stars", "whose stars the sky has (auto: Gaia's where the extra `deep` is installed)",
                    choices=("auto", "hipparcos", "gaia"), default="auto",
                ),
                flag(
                    "--faint-stars V",
                    "no stars fainter than this; down to it, stars that Hipparcos lacks are drawn at random (FIELD n)",
                    flags.magnitude, default=10.0,
                ),
                flag("--no-faint-stars", "the catalogue's stars alone"),
                flag(
                    "--flux-scatter MAG",
                    "of each star's flux, beyond the catalogue's own errors; 0 turns both off",
                    flags.amount, default=0.03,
                ),
                flag("--hot-pixels N", "of the sensor", flags.limited_count, default=200),
                flag("--cosmic-rays N", "tracks per exposure", flags.limited_count, default=5),
            ),
            "output": (
                Either((flag("-o --output FILE", "one image: .png, .tif or .fits"), flags.DIR)),
                flag("--format", "of images in the folder", choices=("png", "tiff", "fits"), default="png"),
                flag("--truth-mag V", "faintest star in the table", flags.magnitude, default=8.5),
                flags.OVERWRITE, flags.JSON, flags.NO_PLOTS,
            ),
            "more": flags.MORE,
        },
        "startrack render --seed 1",
    ),
    Command(
        "predict", function_at("studies.predict.predict"), "expected accuracy over a terrain, before a drive",
        "Predict how well images would be located: stars and the sky's light are drawn at every place and located as "
        "`locate` does. Writes predict.tif, predict.qml, predict.png, predict.ecsv and predict.json. Draws are kept in "
        "OUT/.predict: a stopped run is resumed.",
        {
            "input": (
                flag("-t --terrain FILE", "terrain file, or a shipped name", required=True),
                flag("-c --camera FILE", "camera file, or a shipped name", required=True),
                flag("--time UTC", "middle of the exposures; START/END: evenly spaced between", required=True),
                flag("--sky MAG", "diffuse sky per arcsec^2", flags.magnitude, default=SKY_V_MAG_ARCSEC2),
            ),
            "method": (
                flag("--spacing M", "between the places (a tenth of the area)", flags.positive_number),
                flag("--draws N", "at each place", flags.positive_count, default=10),
                flag("--seed N", "same seed, same files", flags.count, default=0),
                flags.LOCALIZER,
            ),
            "other questions": (
                Either((
                    flag("--exposure S", "seconds; default: V 6 on the axis at 5 sigma", flags.seconds),
                    flag("--exposures S,S,...", "compare; the map is of the first", flags.exposure_times),
                    flag("--depth", "find the exposure that reaches --target-radius95"),
                )),
                flag("--target-radius95 M", "wanted at nine of ten places", flags.positive_number),
                flag("--compare CAMERA2", "a second camera at the same places"),
                flag("--path WAYPOINTS", "CSV with east_m,north_m: places at these points and between"),
                flag("--odometry-sigma F", "with --path: odometry between the places, error of a move", flags.amount),
                flag("--odometry-floor M", "beside that, in quadrature (as of `track`)", flags.amount),
            ),
            "output": (flags.DIR, flags.AGAIN, flags.JSON, flags.NO_PLOTS),
            "more": (flags.JOBS, flags.CLUSTER, *flags.MORE),
        },
        "startrack predict -t shackleton -c fisheye-2048 --time 2030-01-01T00:00:00",
    ),
    Command(
        "reproduce", function_at("studies.predict.reproduce"), "the thesis's tables and figures, ours beside them",
        "Reproduce the tables and figures of Kua 2008 in its crater simulator, with its method and ours on the same "
        "draws. Each NAME gives NAME.md, NAME.png and, with numbers, NAME.ecsv. Computed chunks are kept in "
        "OUT/.chunks: a stopped run is resumed.",
        {
            "input": (
                flag("what NAME", f"all (default), or any of: {', '.join(ARTEFACT_NAMES)}", nargs="*", default=["all"]),
            ),
            "method": (
                Either((
                    flag("--quick", "fewer positions than the thesis, in a few minutes (default)"),
                    flag("--full", "as in the thesis: 10 x 10,000, and 100,000 positions"),
                )),
                flag("--ours N", "our method on at most N positions per starfield, 10 N in figure 3.10",
                     flags.positive_count),
                flag("--seed N", "same seed, same files", flags.count, default=0),
            ),
            "output": (flags.DIR, flags.JSON, flags.NO_PLOTS),
            "more": (flags.JOBS, flags.CLUSTER, *flags.MORE),
        },
        "startrack reproduce table3.1 --quick",
    ),
    Command(
        "doctor", function_at("studies.doctor.run"), "versions, data files, C library, self-test",
        "Check the installation: versions, extras, data files, the C library, and one rendered exposure located from "
        "its pixels. Exit code 0 if all is well, 1 otherwise.",
        {
            "input": (flag("-t --terrain FILE", "compute this terrain's horizons ahead of time"),),
            "more": (flags.JSON, *flags.MORE),
        },
        "startrack doctor",
    ),
    Command(
        "cache", None, "size and removal of tables of horizons", None,
        start=CACHE,
        actions=(
            Command(
                "show", function_at("studies.doctor.show_cache"), "folder, files and size",
                "Tables of horizons take at most 2 GB, or STARTRACK_CACHE_GB: above that those leave that were not "
                "used for longest.",
                {"more": (flags.JSON, *flags.MORE)}, "startrack cache show", memory_later=True,
            ),
            Command(
                "clear", function_at("studies.doctor.clear_cache"), "remove all of it",
                "The next commands compute them again.",
                {"more": (flags.JSON, *flags.MORE)}, "startrack cache clear", memory_later=True,
            ),
        ),
    ),
    Command(
        "schema", function_at("studies.doctor.run_schema"), "JSON schemas of the files",
        "Print the JSON schema of one kind of file, or without a name the list of kinds.",
        {"input": (flag("name KIND", "such as fix, identification, camera, terrain", nargs="?"),)},
        "startrack schema fix", memory_later=True,
    ),
)  # fmt: skip
