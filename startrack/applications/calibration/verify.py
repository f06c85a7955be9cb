"""Verification of a camera file: one new picture of the stars, its own lens compared with the file's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from startrack.applications.calibration.acceptance import horizon_checks
from startrack.applications.calibration.run import identify_with_camera, load_frame
from startrack.applications.calibration.shared_errors import widen_covariance
from startrack.camera import Camera, cap_grid, difference_px, projection_covariance_px2
from startrack.catalog import StarCatalog
from startrack.chain import stating_sky
from startrack.core.files import printable
from startrack.core.types import Exposure, NotIdentified
from startrack.estimation.frame_matching import fit_frames, grow_from_matches
from startrack.frames import Site

VERIFICATION_FORMAT = "startrack.verification/1"
ALLOWED_PX = 0.3  # acceptable RMS change of the projection: a tenth of it propagates to the position
CHANGED_SIGMAS = 3.0


@dataclass(frozen=True, kw_only=True)
class Verification:
    """The lens of the picture compared with that of the file."""

    image: str
    camera: Camera
    fresh: Camera  # fitted to this picture
    stars: int
    rms_px: float  # of the fresh fit
    change_px: float  # RMS change of the map, the best rotation removed
    change_sigma_px: float  # expected from the covariances of both
    largest_px: float
    has_site: bool  # on the Earth: refraction was removed from the picture's stars
    file_has_site: bool | None = None  # the same of the file's calibration; None: not known

    @property
    def is_valid(self) -> bool:
        """Whether the file can still be used."""
        return self.change_px <= max(ALLOWED_PX, CHANGED_SIGMAS * self.change_sigma_px)

    @property
    def message(self) -> str:
        """Reason why the file cannot be used, and what to do; empty where it can."""
        if self.is_valid:
            return ""
        if self.has_site and self.file_has_site is False:
            return "the camera file was made without a site and contains the refraction: verify it without --site"
        if not self.has_site and self.file_has_site:
            return "the camera file was made with a site and is free of refraction: give --site LAT,LON[,M] here"
        if self.camera.covariance is None:
            return "the lens differs from the camera file, which states no error of its own: calibrate again"
        if not self.has_site and self.file_has_site is None:
            return "the lens has changed: calibrate again; or, if the file was made with --site, give --site here too"
        return "the lens has changed: calibrate again"

    @property
    def warnings(self) -> list[str]:
        """Warning of an accepted comparison where one of both lenses may contain the refraction of the air."""
        if not self.is_valid or self.file_has_site == self.has_site or (self.has_site and self.file_has_site is None):
            return []
        made = {True: "with", False: "without", None: "perhaps with"}[self.file_has_site]
        return [f"the camera file was made {made} a site, this comparison {'with' if self.has_site else 'without'} one"]


def verify(
    exposure: Exposure, camera: Camera, catalog: StarCatalog, site: Site | None = None,
    *, file_has_site: bool | None = None,
) -> Verification:  # fmt: skip
    """Fit the lens to the stars of the `catalog` in the `exposure` and compare it with the `camera`.

    The projections are compared where both are calibrated.

    The picture needs a `site` if the camera file was calibrated with one (`file_has_site`, if known): both lenses must
    be without refraction, or both with it. Raises BadInput no_time, NotIdentified where the stars cannot be identified
    with the file, also with the reasons mirrored and, for a wrong site or time, inconsistent_evidence.
    """
    frame = load_frame(exposure, catalog, site, camera=camera)
    found_camera, found = identify_with_camera(camera, frame)
    if found_camera.mirrored != camera.mirrored:
        with stating_sky(exposure):
            raise NotIdentified("the picture is a mirror image, compared with the camera file", reason="mirrored")
    start, R = grow_from_matches(frame, found_camera, found.R_cam_icrs, found.star, found.detection)
    joint = widen_covariance(fit_frames((frame,), start, R[None]))
    for check in horizon_checks(joint, catalog, site):
        if not check.passed:
            raise NotIdentified(check.advice, reason=check.reason)
    fit = joint.fit
    grid = cap_grid(min(camera.calibrated_angle_rad, fit.camera.calibrated_angle_rad))
    change = difference_px(camera, fit.camera, grid)
    variance = projection_covariance_px2(fit.camera, grid) + projection_covariance_px2(camera, grid)
    return Verification(
        image=printable(Path(exposure.path).name) or exposure.name,
        camera=camera,
        fresh=fit.camera,
        stars=int(fit.used.sum()),
        rms_px=fit.rms_px,
        change_px=float(np.sqrt(np.mean(np.sum(change**2, axis=1)))),
        change_sigma_px=float(np.sqrt(np.mean(np.trace(variance, axis1=1, axis2=2)))),
        largest_px=float(np.max(np.linalg.norm(change, axis=1))),
        has_site=frame.sky.includes_refraction,
        file_has_site=file_has_site,
    )


def verify_dict(found: Verification) -> dict[str, Any]:
    """The JSON object of `found`, a verification."""
    old, new = found.camera, found.fresh
    return {
        "format": VERIFICATION_FORMAT,
        "image": found.image,
        "status": "ok" if found.is_valid else "refused",
        "reason": None if found.is_valid else "inconsistent_evidence",
        "message": found.message,
        "warnings": found.warnings,
        "camera": old.name,
        "stars": found.stars,
        "rms_px": found.rms_px,
        "map_change_px": found.change_px,
        "map_change_sigma_px": found.change_sigma_px,
        "map_change_largest_px": found.largest_px,
        "focal_change": float(new.focal_px[0] / old.focal_px[0] - 1.0),
        "centre_change_px": [float(b - a) for a, b in zip(old.centre_px, new.centre_px, strict=True)],
    }


def verify_line(found: Verification) -> str:
    """Summary of `found`, a verification, in one line."""
    verdict = "ok" if found.is_valid else f"refused inconsistent_evidence: {found.message}:"
    return (
        f"{found.image}  {verdict}  {found.stars} stars  map changed by {found.change_px:.2f} px RMS "
        f"(± {found.change_sigma_px:.2f}), {found.largest_px:.2f} px at most"
        + "".join(f"; {text} (--site)" for text in found.warnings)
    )
