"""The settings of the whole chain, and what becomes of one image on its way through it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from startrack.camera import Camera
from startrack.detection import Detector
from startrack.evidence import StarEvidence, StarLight
from startrack.identification import Identifier
from startrack.localization import ExactPosterior, Localizer
from startrack.orient import AttitudeFit
from startrack.terrain import Terrain
from startrack.terrain.masks import silent_sectors
from startrack.types import Array, Attitude, Body, Detections, Exposure, Fix, Identification, Stars

UNKNOWN_TIME_SIGMA_RAD = np.radians(60 / 3600)  # aberration and proper motion left out


@dataclass(frozen=True)
class Settings:
    """The stages and their settings; exchange any of them."""

    detector: Detector = field(default_factory=Detector)
    identifier: Identifier = field(default_factory=Identifier)
    evidence: StarEvidence = field(default_factory=StarEvidence)
    localizer: Localizer = field(default_factory=ExactPosterior)
    deep_stars: bool = True  # evidence of Gaia's stars too, where installed and the frame sees deeper than Hipparcos


@dataclass(eq=False)  # arrays have no single answer to ==
class Result:
    """What became of one image. Parts that were not reached are None. Two results are equal only if they are one."""

    exposure: Exposure
    camera: Camera | None = None
    terrain: Terrain | None = None
    catalog_name: str = ""
    status: str = "refused"  # ok, ambiguous or refused
    reason: str | None = None
    message: str = ""
    detections: Detections | None = None
    stars: Stars | None = None
    bodies: list[Body] = field(default_factory=list)
    identification: Identification | None = None
    attitude_fit: AttitudeFit | None = None
    R_enu_icrs: Array | None = None
    light: StarLight | None = None
    fix: Fix | None = None
    timing_ms: dict[str, float] = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        """What was found in the image's file and not used, and of which azimuths the terrain could not speak."""
        silent = [] if self.light is None or self.terrain is None else silent_sectors(self.terrain)
        return [*self.exposure.warnings, *silent]

    @property
    def attitude(self) -> Attitude | None:
        """Attitude with the error of an unknown time included."""
        if self.attitude_fit is None:
            return None
        attitude = self.attitude_fit.attitude
        if self.exposure.time_utc is not None:
            return attitude
        widened = attitude.covariance_rad2 + UNKNOWN_TIME_SIGMA_RAD**2 * np.eye(3)
        return Attitude(R_cam_icrs=attitude.R_cam_icrs, covariance_rad2=widened)
