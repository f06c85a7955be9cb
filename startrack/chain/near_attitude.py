"""A rough attitude of the camera, of an earlier result or frame, turned with the sky."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Self

from numpy.typing import ArrayLike

from startrack.core.errors import BadInput
from startrack.core.files import FilePath, printable, read_text
from startrack.core.types import Array
from startrack.frames import R_enu_icrs, R_from_quat_xyzw, Site, parse_utc, quat_xyzw_from_R

REASON = "bad_image"  # of a file that cannot be used
MAX_BYTES = 16 * 2**20  # of it: an identification lists its matches


@dataclass(frozen=True)
class NearAttitude:
    """A rough attitude: `startrack.identification.attitude_search` has the error that it may have.

    `quat_xyzw_cam_icrs`: v_cam = R v_icrs, as in result files. Without its time it is used as it is.
    """

    quat_xyzw_cam_icrs: tuple[float, ...]
    time_utc: datetime | None = None
    camera: str | None = None  # file by which it was measured, as the result names it

    @classmethod
    def of(cls, R_cam_icrs: ArrayLike, time_utc: datetime | None = None) -> Self:
        """The rough attitude `R_cam_icrs` (3, 3) at `time_utc`. Raises ValueError for a matrix that is no rotation."""
        return cls(tuple(quat_xyzw_from_R(R_cam_icrs).tolist()), time_utc)

    def R_cam_icrs_at(self, when: datetime | None, site: Site | None) -> Array:
        """The attitude (3, 3) at the time `when` of a camera that stands still on the ground of a `site`.

        With one of them not known (None) it is the attitude as it is. Raises ValueError for a quaternion that is none.
        """
        R = R_from_quat_xyzw(self.quat_xyzw_cam_icrs)
        if self.time_utc is None or when is None or site is None:
            return R
        return R @ R_enu_icrs(site, self.time_utc).T @ R_enu_icrs(site, when)


def read_near_attitude(path: FilePath) -> NearAttitude:
    """The attitude in the NAME.fix.json or NAME.identification.json at `path`. Raises BadInput (bad_image)."""
    try:
        found = json.loads(read_text(path, REASON, max_bytes=MAX_BYTES))
    except (ValueError, RecursionError) as cause:
        raise BadInput(REASON, f"{printable(path)}: is no JSON file ({cause})") from cause
    try:
        return _attitude_in(found)
    except (AttributeError, BadInput, KeyError, OverflowError, TypeError, ValueError) as cause:
        raise BadInput(
            REASON,
            f"{printable(path)}: holds no attitude (attitude.quat_xyzw_cam_icrs): give the NAME.fix.json or "
            "NAME.identification.json of an image whose stars were identified",
        ) from cause


def _attitude_in(record: Any) -> NearAttitude:
    """Attitude of a result. Raises an exception that `read_near_attitude` turns into BadInput for anything else."""
    time_text = record.get("provenance", {}).get("time_utc")
    quat = tuple(float(one) for one in record["attitude"]["quat_xyzw_cam_icrs"])
    camera = record.get("provenance", {}).get("camera")
    near = NearAttitude(quat, None if time_text is None else parse_utc(time_text), camera and str(camera))
    near.R_cam_icrs_at(None, None)
    return near
