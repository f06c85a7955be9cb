"""The commands that make what images are located with: calibrate, terrain, and horizon of a fixed camera."""

from __future__ import annotations

from startrack.cli import flags
from startrack.cli.flags import (
    Command,
    Either,
    amount,
    field_of_view_rad,
    flag,
    function_at,
    limit_type,
    number,
    positive_number,
)
from startrack.core.file_kinds import PROGRAMS

CALIBRATE = f"""usage: startrack calibrate [ACTION] ... (startrack calibrate --help lists the flags of each action)

from stars       startrack calibrate NIGHT.jpg... --fov 180 -o CAMERA.toml   the lens, from pictures of the night sky
from a board     startrack calibrate board BOARD.png... --pattern 9x6        the lens, from pictures of a chessboard
check            startrack calibrate verify LATER.jpg -c CAMERA.toml         does the camera file still fit?
look             startrack calibrate show CAMERA.toml                        the content of a camera file
other programs   startrack calibrate convert CAMERA.toml --to ros            {", ".join(PROGRAMS)}"""
TERRAIN = """usage: startrack terrain ACTION ... (startrack terrain ACTION --help)

look             startrack terrain show shackleton --at 0 0                  properties, relief, a horizon
your own map     startrack terrain import MAP.tif -o NAME.toml --latitude DEG --longitude DEG
state errors     startrack terrain state NAME.toml                           what its file leaves out widens circles
prepare          startrack terrain build NAME.toml                           its horizons, before the first fix"""
NAME = flag("--name NAME", "name of the camera (default: that of its file)")
CAMERA_OUTPUT = (flags.FILE, NAME, flags.DIR, flags.OVERWRITE, flags.NO_PLOTS, flags.JSON)
STATED_ERRORS = {  # keys of the file, and the unit of each
    "depth_sigma_m": "M", "diameter_sigma_m": "M", "ellipse_sigma_1": "X", "rim_tilt_sigma_deg": "DEG",
    "height_sigma_m": "M", "horizon_sigma_deg": "DEG", "stretch_sigma_1": "X", "vertical_sigma_deg": "DEG",
    "horizon_waves_sigma_deg": "DEG", "map_offset_sigma_m": "M",
    "camera_height_sigma_m": "M", "terrestrial_refraction_sigma": "X",
}  # fmt: skip


def state_flag(key: str) -> str:
    """The flag of `startrack terrain state` for a `key` of STATED_ERRORS."""
    return "--" + key.rpartition("_")[0].replace("_", "-")


COMMANDS = (
    Command(
        "calibrate", function_at("inputs.calibrate.run"), "a camera file from pictures of the stars",
        "Fit the lens of a camera to the stars of one or more exposures of the open night sky, check the fit, and "
        "write the camera file with its covariance, a report and a JSON record. A fit that fails a check is refused, "
        "with the exposures that would help.",
        {
            "input": (
                *flags.SKY,
                flag(
                    "--fov DEG", "below 100: angle across the width; from 100 up: of the image circle",
                    field_of_view_rad,
                ),
            ),
            "sensor, if the exposures do not show it": (
                flag("--gain E", "electrons per ADU", positive_number),
                flag("--read-noise E", "read noise, electrons", amount),
                flag("--bias ADU", "level without light", number),
            ),
            "output": CAMERA_OUTPUT,
            "more": (flags.TIME_LIMIT, *flags.MORE),
        },
        start=CALIBRATE,
    ),
    Command(
        "calibrate verify", function_at("inputs.calibrate.verify"), None,
        "Check whether a camera file still fits exposures of the stars. If the file was calibrated with --site, verify "
        "needs --site too.",
        {"input": flags.SKY, "more": (flags.JSON, *flags.MORE)},
        "startrack calibrate verify LATER.jpg -c camera.toml",
    ),
    Command(
        "calibrate show", function_at("inputs.camera_files.show"), None, "Print the content of camera files.",
        {
            "input": (flag("cameras CAMERA", "camera file, or the name of a shipped one", nargs="+"),),
            "more": (flags.JSON, *flags.MORE),
        },
        "startrack calibrate show fisheye-2048", memory_later=True,
    ),
    Command(
        "calibrate convert", function_at("inputs.camera_files.convert"), None,
        "Convert a camera file to another program's format with --to, or from it.",
        {
            "input": (
                flag(
                    "file FILE",
                    "camera file with --to; else the other program's file, FILE#NAME for one camera of several",
                ),
                Either((
                    flag("--to", "write this format", choices=(*PROGRAMS, "indi-allsky")),
                    flag("--from", "read this format (default: by the content)", choices=tuple(PROGRAMS),
                         dest="source"),
                )),
                flag(
                    "--calibrated-angle DEG",
                    "without --to: angle off the axis up to which the lens was calibrated, which no such file states "
                    "(default: that of the frame's nearest edge)",
                    limit_type(number, lambda deg: 0 < deg <= 180, "{} is not above 0 and up to 180 degrees"),
                ),
                flag(
                    "--attitude FILE",
                    "with --to platepar and indi-allsky: a NAME.identification.json or NAME.fix.json of this camera, "
                    "where it pointed and when",
                ),
                flags.SITE,
            ),
            "output": (flags.FILE, NAME, flags.DIR, flags.OVERWRITE),
            "more": (flags.JSON, *flags.MORE),
        },
        "startrack calibrate convert camera.toml --to ros", memory_later=True,
    ),
    Command(
        "calibrate board", function_at("inputs.calibrate.run_board"), None,
        "Fit the lens of a camera to pictures of a chessboard or a ChArUco board.",
        {
            "input": (
                flag("images IMAGE", "pictures of the board", nargs="+"),
                flag("--pattern CxR", "inner corners of a chessboard; squares of a ChArUco board"),
                flag("--charuco DICT", "ChArUco with this dictionary, such as DICT_5X5_100"),
                flag("--marker PART", "marker's side over square's",
                     limit_type(number, lambda part: 0 < part < 1, "{} is not between 0 and 1"), default=0.75),
            ),
            "output": CAMERA_OUTPUT,
            "more": flags.MORE,
        },
        "startrack calibrate board BOARD.png... --pattern 9x6 -o camera.toml",
    ),
    Command(
        "horizon", function_at("inputs.horizon.run"), "the horizon of a fixed camera from photographs of the night sky",
        "Measure the skyline (obstruction profile) of a fixed camera on the Earth from one or several photographs of "
        "the night sky: from stars seen, stars missing, and the place where the sky's light stops. The suffix of -o "
        "chooses the format: .csv, .ecsv, .hrz (N.I.N.A.), .png (panorama), none (folder of a Stellarium landscape), "
        ".zip (one with the photographs below the skyline).",
        {
            "input": (
                flags.PHOTOGRAPHS, *flags.FACTS, flags.SITE, flags.TERRAIN,
                flag(
                    "--fov DEG",
                    "no camera file: field of view, good to 10 %%; below 100 across the width, from 100 up of the "
                    "image circle",
                    field_of_view_rad,
                ),
            ),
            "output": (
                flag(
                    "-o --output FILE",
                    "the skyline, and beside it its picture, FILE.png; several -o: in several formats",
                    action="append", required=True,
                ),
                flag("-D --dir OUT", "folder of FILE, where that is relative (default: the current one)"),
                flags.OVERWRITE, flags.JSON, flag("--no-plots", "no picture beside FILE"),
            ),
            "more": (flags.TIME_LIMIT, flags.NO_SEED, *flags.MORE),
        },
        "startrack horizon NIGHT.jpg... --fov 180 --site 34.74,-111.42 -o horizon.csv",
    ),
    Command(
        "terrain", None, "show a terrain, compute its horizons, make one from elevation data, state its errors",
        "TERRAIN is a terrain file (a path if it ends in .toml or contains a separator) or a shipped name.",
        start=TERRAIN,
        actions=(
            Command(
                "show", function_at("inputs.terrain.show"),
                "properties, relief and, with --at, the horizon from a position", None,
                {
                    "input": (
                        flag("terrain TERRAIN", "terrain file, or the name of a shipped one"),
                        flag("--at EAST NORTH", "a position [m]", number, nargs=2),
                    ),
                    "output": (flags.DIR, flags.JSON, flags.NO_PLOTS),
                    "more": flags.MORE,
                },
                "startrack terrain show shackleton --at 0 0", memory_later=True,
            ),
            Command(
                "build", function_at("inputs.terrain.build"),
                "compute the horizons now; otherwise the first fix does", None,
                {
                    "input": (
                        flag("terrain TERRAIN", "terrain file, or the name of a shipped one", nargs="+"),
                        flag("--force", "even if they are known"),
                    ),
                    "more": (flags.JSON, *flags.MORE),
                },
                "startrack terrain build shackleton",
            ),
            Command(
                "import", function_at("inputs.terrain.import_map"),
                "a terrain file and GeoTIFF crops from elevation data", None,
                {
                    "input": (
                        flag(
                            "maps MAP", "GeoTIFF, COG, PDS label, .hgt, USGS .dem ..., or an array .npy; the finest "
                            "first", nargs="+",
                        ),
                        flag("--latitude DEG", "of the origin, north positive", number, required=True),
                        flag("--longitude DEG", "east positive", number, required=True),
                        flag("--radius M", "of the search area", positive_number, default=10_000.0),
                        flag("--half M", "half side of each map's crop (30000 for the first, then 300000; on the Earth "
                             "150000 at most)", positive_number,
                             nargs="+"),
                        flag("--scale M", "metres per unit of each map, in the place of what the files state; needed "
                             "for integers without it", number, nargs="+"),
                        flag("--offset M", "height of value 0 of each map, in the place of what the files state",
                             number, nargs="+"),
                        flag("--cut-out M", "voids up to so wide are roofs and trees that were cut out of the maps: "
                             "the ground there is interpolated", amount),
                        flag("--unusual-heights", "the heights are right, though flatter, higher or lower than the "
                             "body's ground"),
                        flag("--post M", "of an array: between posts; rows from the north, columns to the east, its "
                             "middle at the origin", positive_number),
                        flag("--crs TEXT", "of an array: its reference system, as PROJ reads it (default: the "
                             "stereographic plane of the Moon about the origin)", default=""),
                        flag("--corner X Y", "of an array: the first post, in the units of --crs", number, nargs=2),
                        flag("--sigma M", "error of single posts (default: measured or estimated)", amount),
                        flag(
                            "--compare MAP",
                            "finer maps of a part of the ground, to measure the errors (the shipped maps are tried "
                            "anyway)", nargs="+", default=(),
                        ),
                        flag("--camera-height M", "above the ground", amount, default=1.5),
                        flag(
                            "--highest-beyond M", "ground off the maps is no higher (default: 8850 on the Earth; on "
                            "the Moon the highest of the maps)", number,
                        ),
                        flag("--geoid GRID", "of PROJ, above which the maps count heights: a name that it finds, as "
                             "us_nga_egm96_15.tif, or a file; or one for each map, `ellipsoid` where heights are above "
                             "it", nargs="+"),
                    ),
                    "output": (
                        flag("-o --output NAME.toml", "the terrain file", required=True), flags.OVERWRITE, flags.JSON,
                    ),
                    "more": flags.MORE,
                },
                "startrack terrain import MAP.tif -o own.toml --latitude -89.5 --longitude 130",
            ),
            Command(
                "state", function_at("inputs.terrain.state"), "write into a terrain file the errors that it leaves out",
                "An error that the file states is trusted; for one that it leaves out a default counts, and that it "
                "may be grossly wrong. Without flags the missing ones are asked for, or listed where there is no "
                "terminal.",
                {
                    "input": (
                        flag("file FILE", "the terrain file; its comments stay"),
                        *(
                            flag(f"{state_flag(key)} {unit}", "one standard deviation", amount, dest=key)
                            for key, unit in STATED_ERRORS.items()
                        ),
                        flag("--exact", "the terrain is a model: errors that it leaves out are 0"),
                    ),
                    "more": (flags.JSON, *flags.MORE),
                },
                "startrack terrain state own.toml --depth-sigma 30",
            ),
        ),
    ),
)  # fmt: skip
