"""Poses as text in the format of TUM's RGB-D benchmark, which evo reads: time tx ty tz qx qy qz qw.

Source: Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems, IROS.
"""

from __future__ import annotations

from startrack.core.types import Array
from startrack.frames.rotations import quat_xyzw_from_R


def tum_line(time_s: float, position_m: Array, R_frame_body: Array) -> str:
    """The line of one pose at `time_s` (Unix seconds, UTC) in any frame.

    `position_m` (3,) is the body's position in the frame, `R_frame_body` (3, 3) the rotation from body to frame.
    Lines of increasing times sort as text.
    """
    numbers = [*position_m, *quat_xyzw_from_R(R_frame_body)]
    return f"{time_s:017.6f} " + " ".join(f"{number:.9f}" for number in numbers) + "\n"
