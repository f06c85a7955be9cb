"""Valid files beside pictures, small, as bytes: odometry, tables, attitudes, ROS bags, maps, and results."""

from __future__ import annotations

import io
import json
import lzma
import tempfile
import zlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

START_S = 1_932_324_600.0  # eight minutes before the picture of SIDECAR
ODOMETRY = "# time tx ty tz qx qy qz qw\n" + "".join(
    f"{START_S + 60 * k:.6f} {0.5 * k:g} {0.1 * k:g} 0 0 0 {np.sin(0.1 * k):.6f} {np.cos(0.1 * k):.6f}\n"
    for k in range(12)
)
OBSTACLES = "azimuth_deg,elevation_deg\n118.0,4.5\n120.0,31.0\n125.0,\n135.0,31.0\n137.0,4.0\n"
WAYPOINTS = "east_m,north_m,comment\n0,0,start\n150,-20.5,\n150,80,end\n"
ATTITUDE = {
    "format": "startrack.identification/1", "attitude": {"quat_xyzw_cam_icrs": [0.1, -0.2, 0.3, 0.9273618495495703]},
    "provenance": {"time_utc": "2031-03-26T20:58:11Z"},
}  # fmt: skip
BAG_FORMS = "ros1.bag", "ros2.db3", "ros2.mcap"
GRIDS = "st-helens.dem", "heights.npy"
RECORDS = "sky.fix.json", "sky.stars.ecsv", "sky.skyline.ecsv"
PICTURE = "sky.annotated.png"
RECORD = {
    "format": "startrack.fix/1", "image": "sky.png", "status": "ok", "reason": None, "message": "",
    "position": {
        "frame": "enu", "terrain": "shackleton-thesis", "east_m": 424.0, "north_m": -310.25, "up_m": 1.5,
        "covariance_m2": [[8.5, 0.1], [0.1, 11.75]], "radius95_m": 8.75, "radius999_m": 13.5,
        "carried_by": [[45.0, 90.0]], "unstated": [], "evidence": "both", "search": "proven",
    },
    "modes": [{"east_m": 424.0, "north_m": -310.25, "weight": 1.0, "radius95_m": 8.75, "radius999_m": 13.5}],
    "attitude": {"ra_deg": 93.75, "dec_deg": -68.25, "roll_deg": 294.5, "heading_deg": 32.0, "pitch_deg": 1.5},
    "stars": {"detected": 2421, "identified": 2248, "rms_px": 0.25, "false_alarm_probability": 1e-299},
    "evidence": {"blocked": [], "damage": None}, "sky": {"brightness_mag_arcsec2": 21.875, "unused": None},
    "clock": {"offset_s": 0.0, "sigma_s": 0.0}, "timing_ms": {"read": 322.5, "detect": 457.0},
    "provenance": {"version": "0.1.0", "camera": "fisheye-2048", "terrain": "shackleton-thesis",
                   "time_utc": "2031-03-26T20:58:11.000000Z", "time_sigma_s": 0.0},
    "warnings": [],
}  # fmt: skip
STARS = """# %ECSV 1.0
# - {name: 'expected_e', unit: electron, datatype: float64, description: 'flux if nothing hides it'}
catalog_id,hip,name,v_mag,azimuth_deg,elevation_deg,x_px,y_px,x_measured_px,y_measured_px,expected_e,flux_e,sigma_e,\
evidence,status,cause
HIP 32349,32349,Sirius,-1.440,107.64699,12.58342,45.278,8.620,45.277,8.612,66179.5,63808.7,12.3935,9.000,seen,
HIP 71683,71683,Rigil Kentaurus,-0.010,244.81569,10.45300,12.7,14.0,12.7,14.0,17730.6,21411.6,2568.36,-8.218,hidden,
HIP 24436,24436,Rigel,0.180,80.36546,31.61857,5.0,5.1,,,14884.1,,,,unusable,edge
"""
SKYLINE = """# %ECSV 1.0
azimuth_deg,elevation_deg,sigma_deg,source
0.75,11.0208,0.0418,sky light
90.25,11.0726,0.0537,both
183.75,10.9814,0.0801,stars
"""


def bags() -> list[bytes]:
    """Two images and some poses in each form of bag; none where rosbags is not installed."""
    if find_spec("rosbags") is None:
        return []
    from bag_helpers import STAMP_NS, write_bag

    from .seeds import FRAME

    def topics(messages: Any) -> list[Any]:
        poses = np.column_stack([np.arange(4.0), np.zeros((4, 5)), np.ones(4)])
        odometry = [("/odom", messages.odometry(STAMP_NS + k * 10**9, pose)) for k, pose in enumerate(poses)]
        return [("/cam", messages.image(STAMP_NS + k, FRAME[:8, :8], "mono16")) for k in range(2)] + odometry

    found = []
    for form in BAG_FORMS:
        with tempfile.TemporaryDirectory() as folder:
            found.append(write_bag(Path(folder), form, topics).read_bytes())
    return found


@cache
def results() -> dict[str, bytes]:
    """A small result, by the name of the file: RECORDS and PICTURE."""
    import cv2

    from startrack.exposure.png import insert_png_chunks
    from startrack.output.picture.annotate import BARE_CHUNK, MARKS_CHUNK

    from .seeds import FRAME, pillow

    marks = {"size": FRAME.shape[::-1], "others": [[12.5, 30.0]], "nose": [[1.0, 2.0], [3.0, 4.0]], "bodies": []}
    jpeg = cv2.imencode(".jpg", (FRAME // 8).astype(np.uint8))[1].tobytes()
    layers = [(BARE_CHUNK, jpeg), (MARKS_CHUNK, zlib.compress(json.dumps(marks).encode()))]
    texts = json.dumps(RECORD, indent=1), STARS, SKYLINE
    picture = insert_png_chunks(pillow(FRAME, "PNG", eight=True), layers)
    return {**{name: text.encode() for name, text in zip(RECORDS, texts, strict=True)}, PICTURE: picture}


def grids() -> list[bytes]:
    """Maps that are no GeoTIFF, and an array, in the order of `GRIDS`."""
    dem = lzma.decompress((Path(__file__).resolve().parents[1] / "data" / "st-helens.dem.xz").read_bytes())
    np.save(array := io.BytesIO(), 9.0 * (np.arange(31 * 41) % 97).reshape(31, 41))
    return [dem, array.getvalue()]


def seeds_beside() -> dict[str, tuple[bytes, ...]]:
    """Valid files (bytes) by kind of input."""
    from map_helpers import PDS3

    from .seeds import FRAME, pillow

    sky = np.full(FRAME.shape, 255)
    return {
        "correction": (pillow(sky, "PNG", eight=True), pillow(FRAME, "PNG"), pillow(FRAME, "PNG")),
        "odometry": (ODOMETRY.encode(),),
        "table": (OBSTACLES.encode(), WAYPOINTS.encode()),
        "attitude": (json.dumps(ATTITUDE, indent=1).encode(),),
        "bag": tuple(bags()),
        "grid": tuple(grids()),
        "label": (PDS3.format(body="MOON", radius="1737.4").encode(),),
        "record": tuple(results()[name] for name in RECORDS),
        "layers": (results()[PICTURE],),
    }
