"""COLMAP cameras.txt: PINHOLE, OPENCV_FISHEYE, and THIN_PRISM_FISHEYE where the lens is decentred.

COLMAP's origin is the CORNER of the first pixel, whose centre is at (0.5, 0.5).
"""

from __future__ import annotations

from startrack.camera import Camera, Decentring
from startrack.camera.convert.intrinsics import Intrinsics, camera_from_intrinsics, intrinsics_of
from startrack.core.types import BadInput

CORNER_PX = 0.5
HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
COUNTS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "OPENCV_FISHEYE": 8,
    "THIN_PRISM_FISHEYE": 12,
}


def to_text(camera: Camera) -> str:
    """The cameras.txt file, one camera: number 1."""
    lens, bent = intrinsics_of(camera), camera.decentring
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    values = [fx, fy, cx + CORNER_PX, cy + CORNER_PX]
    model = "PINHOLE"
    if bent:
        if lens.k is None:
            raise BadInput("bad_calibration", "COLMAP has no decentred pinhole on angles")
        model = "THIN_PRISM_FISHEYE"
        values += [*lens.k[:2], bent.p1, bent.p2, *lens.k[2:], 0.0, 0.0]
    elif lens.k is not None:
        model = "OPENCV_FISHEYE"
        values += lens.k
    numbers = " ".join(repr(float(v)) for v in values)
    return f"{HEAD}# Number of cameras: 1\n1 {model} {lens.size_px[0]} {lens.size_px[1]} {numbers}\n"


def from_text(text: str, name: str) -> Camera:
    """The first camera of a cameras.txt file. Raises ValueError."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or len(lines[0]) < 4:
        raise ValueError("no line CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]")
    _number, model, width, height, *words = lines[0]
    values = [float(word) for word in words]
    if len(values) != COUNTS.get(model, -1):
        raise ValueError(f"camera model {model} with {len(values)} parameters has no counterpart")
    if model.startswith("SIMPLE") or model == "RADIAL_FISHEYE":
        values = [values[0], *values]
    fx, fy, cx, cy, *rest = values
    decentring = Decentring()
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, sx, sy = rest
        if sx or sy:
            raise ValueError("thin-prism coefficients other than 0 have no counterpart")
        rest, decentring = [k1, k2, k3, k4], Decentring(p1, p2)
    k = None if model.endswith("PINHOLE") else (*rest, *(4 * (0.0,)))[:4]
    lens = Intrinsics((int(width), int(height)), (fx, fy), (cx - CORNER_PX, cy - CORNER_PX), k)
    return camera_from_intrinsics(lens, name, decentring)
