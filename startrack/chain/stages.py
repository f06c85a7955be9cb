"""The complete values that the stages of the pipeline return, and the settings of the stages.

    Inputs -> Detected -> Identified -> Oriented -> Measured -> FirstLook -> SecondLook -> Located, or Refused

Each value has the fields of the one before it and the results of one more stage; the two looks hold a `Measured`. All
are frozen. Which value a function returns states which stages have run; no field is filled in later. A stage that knows
better returns other values of earlier fields: `Oriented` a corrected `camera` and `names` with the brightest sources;
`Measured` masked `detections`, and `stars`, `catalog_name`, `identification` and `names` by the deeper list; each look
the `terrain` of the steepness, and `R_enu_icrs`, `clock` and `photometry` of the time that it shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple, Self, TypeAlias

import numpy as np

from startrack.camera import Camera
from startrack.catalog import daylight_warnings
from startrack.chain.near_attitude import NearAttitude
from startrack.core.errors import Reason
from startrack.core.types import (
    Array,
    Attitude,
    Body,
    Bools,
    Clock,
    Detections,
    Evidence,
    Exposure,
    Fix,
    Identification,
    ImageErrors,
    Ints,
    MeasuredSkyline,
    PositionPrior,
    Rows,
    Stars,
    array,
)  # fmt: skip
from startrack.detection import Damage, Detector
from startrack.estimation.attitude import AttitudeFit
from startrack.evidence import DamagedResponse, FluxScale, SkyLight, StarPhotometer, StarPhotometry
from startrack.frames import R_from_rotvec, Site
from startrack.identification import Identifier
from startrack.localization import DEFAULT_LOCALIZER, Localizer, has_posterior, require_localizer
from startrack.terrain import Terrain

EVIDENCE_SOURCES = ("both", "stars", "sky")  # of a position; "sky" begins with a fix by the stars
SHOWN_CHANGE_PX = 0.1  # of the lens, from which a warning states it
STAGES = ("read", "detect", "identify", "attitude", "evidence", "locate")  # keys of `timing_ms`


@dataclass(frozen=True, kw_only=True)
class NamedStars(Rows):
    """Sources with the names of stars; one-to-one."""

    star: Ints = array("n", dtype=np.int64)  # index into Stars
    xy_px: Array = array("n", 2)  # as measured
    saturated: Bools = array("n", dtype=np.bool_)


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceNames:
    """Names of the sources of an image."""

    stars: NamedStars
    bodies: tuple[Body, ...]  # planets, Sun, Moon, Earth; without a site those that have a source
    is_nameless: Bools  # (n,) which detections are neither a star nor a body
    unexplained: int  # significant detections that neither a catalogue star nor a body explains


def identified_names(sources: Detections, known: Identification, bodies: tuple[Body, ...]) -> SourceNames:
    """Names that the identification `known` gives to `sources`; `bodies` are those over the site."""
    is_nameless = np.ones(len(sources), dtype=bool)
    is_nameless[known.detection] = False
    return SourceNames(
        stars=NamedStars(
            star=known.star, xy_px=sources.xy_px[known.detection], saturated=sources.saturated[known.detection]
        ),
        bodies=bodies, is_nameless=is_nameless, unexplained=known.unexplained,
    )  # fmt: skip


class Positioned:
    """The position of a camera above a terrain: a base of the values that have one."""

    exposure: Exposure
    fix: Fix
    site: Site
    terrain: Terrain
    skyline: MeasuredSkyline | None
    near: PositionPrior | None

    @property
    def status(self) -> str:
        """Status: ok, or ambiguous where several positions fit."""
        return "ambiguous" if self.fix.ambiguous else "ok"

    @property
    def reason(self) -> Reason | None:
        """Reason `ambiguous` where several positions fit, else None."""
        return Reason.AMBIGUOUS if self.fix.ambiguous else None

    @property
    def message(self) -> str:
        """Number of positions that fit, if there are several."""
        return f"{len(self.fix.modes)} positions fit" if self.fix.ambiguous else ""

    @property
    def position_warnings(self) -> list[str]:
        """Warnings of what blocks the view, and of errors beyond the defaults of facts that no file states."""
        blocked = [f"not the map's skyline, and left out: {self.fix.blocked.text}"] if self.fix.blocked else []
        shown = [f"the image shows {one.text}, which no file states: it is estimated" for one in self.fix.shown]
        return [*blocked, *shown, *self.fix.cautions]


@dataclass(frozen=True)
class Settings:
    """The stages and their settings; each can be replaced by another one with the same call.

    `localizer` may be a name in `startrack.localization.LOCALIZERS`. Raises TypeError, ValueError for values of no use.
    """

    detector: Detector = field(default_factory=Detector)
    identifier: Identifier = field(default_factory=Identifier)
    photometer: StarPhotometer = field(default_factory=StarPhotometer)
    localizer: Localizer = field(default_factory=lambda: require_localizer(DEFAULT_LOCALIZER))
    evidence_sources: str = "both"  # "stars", "sky" (the light of the sky at the skyline) or "both"
    near: PositionPrior | None = None  # of the position; None: anywhere in the search area of the terrain
    near_attitude: NearAttitude | None = None  # tried first: it saves time
    time_limit_s: float | None = None  # of the processor time of an image (all threads); None: no limit
    deep_stars: bool = True  # use Gaia's stars too, where they are installed and the frame is deeper than Hipparcos

    def __post_init__(self) -> None:
        object.__setattr__(self, "localizer", require_localizer(self.localizer))
        if self.evidence_sources not in EVIDENCE_SOURCES:
            raise ValueError(f"evidence_sources {self.evidence_sources!r}: known are {', '.join(EVIDENCE_SOURCES)}")
        if self.near is not None and not has_posterior(self.localizer):
            raise ValueError(f"near={self.near}: only the localizer posterior takes a prior of the position")


@dataclass(frozen=True, kw_only=True, eq=False)  # eq: arrays have no single answer to ==
class Inputs:
    """Exposure and the inputs of its solution. Two values are equal only if they are one object."""

    exposure: Exposure
    camera: Camera | None = None  # None: not known; `detect` works without, `identify_blind` finds it
    terrain: Terrain | None = None  # None: identification or detection only
    catalog_name: str = ""
    damage: Damage | None = None  # what processing did to the pixels; None: nothing shows
    localizer_name: str = ""  # in LOCALIZERS, or of its class or function; empty: identification or detection only
    timing_ms: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))  # stage to wall time [ms]

    @property
    def status(self) -> str:
        """Status of the result format: ok, ambiguous or refused."""
        return "ok"

    @property
    def reason(self) -> Reason | None:
        """Code of the reason where the status is not ok, else None."""
        return None

    @property
    def message(self) -> str:
        """Text of one line about the status; empty where it is ok."""
        return ""

    @property
    def warnings(self) -> list[str]:
        """Facts in the files of image and camera that were not used, or derived; and damage of the image."""
        notes = () if self.camera is None else self.camera.notes
        return [*self.exposure.warnings, *notes, *([self.damage.message] if self.damage is not None else [])]


@dataclass(frozen=True, kw_only=True, eq=False)
class Detected(Inputs):
    """An exposure and its point sources."""

    detections: Detections

    @property
    def warnings(self) -> list[str]:
        """Warnings of exposure and camera, and of a part of the image that holds one value."""
        mask = self.detections.mask
        if mask is None or not mask.dead_part:
            return super().warnings
        return [*super().warnings, f"{100 * mask.dead_part:.0f} % of the image holds one value: left out as if masked"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified(Detected):
    """Detections with the catalogue stars that they are."""

    camera: Camera  # the given one, or the one found
    stars: Stars  # the catalogue at the time of the exposure
    site: Site | None = None  # that the stars are seen from; None: not known
    identification: Identification
    names: SourceNames  # what the sources are; with an attitude the brightest too

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Planets, Sun, Moon and Earth; without a site those that have a source, without a time none."""
        return self.names.bodies


@dataclass(frozen=True, kw_only=True, eq=False)
class Oriented(Identified):
    """Identified stars with the attitude of the camera among the stars.

    `camera` is corrected where the stars show another lens; `names` has the brightest sources too.
    """

    attitude_fit: AttitudeFit
    lens_change_px: float = 0.0  # by which `camera` differs from the camera file, as the stars show it; RMS

    @property
    def warnings(self) -> list[str]:
        """Warnings before the attitude was known, and the difference of the lens from its file."""
        px = f"{self.lens_change_px:.2f} px (RMS; without a site by refraction too)"
        text = f"the lens differs from the camera file by {px}: corrected by the stars"
        return [*super().warnings, *([text] if self.lens_change_px > SHOWN_CHANGE_PX else [])]

    @property
    def attitude(self) -> Attitude:
        """Attitude with the error of an unknown time included."""
        return self.attitude_fit.attitude_of(has_time=self.exposure.time_utc is not None)


@dataclass(frozen=True, kw_only=True, eq=False)
class StarRays:
    """Photometry of the catalogue's stars above a terrain: all that a position by the stars needs."""

    terrain: Terrain
    R_enu_icrs: Array  # (3, 3) at the likeliest time; in a round crater at the stated one
    clock: Clock
    photometry: StarPhotometry
    near: PositionPrior | None = None  # of the position

    def evidence(self) -> Evidence:
        """Rays of the stars as evidence for the localizer."""
        return replace(self.photometry.evidence(), clock=self.clock, near=self.near)

    def later(self, later_s: float, reach_s: float) -> Self:
        """Copy under the sky of a time later by `later_s`, which is right to `reach_s` [s]."""
        R = R_from_rotvec(later_s * self.clock.turn_rad_s)
        clock = replace(self.clock, offset_s=self.clock.offset_s + later_s, reach_s=reach_s)
        photometry = self.photometry.turn_frame(R, self.terrain.air)
        return replace(self, R_enu_icrs=R @ self.R_enu_icrs, photometry=photometry, clock=clock)


@dataclass(frozen=True, kw_only=True, eq=False)
class StarFix(StarRays):
    """The position that explains the stars, and its integrity."""

    fix: Fix


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured(StarRays, Oriented):
    """An attitude above a terrain, with photometry at every catalogue star in view.

    The pixels of stated obstacles are masked in `detections`. `stars`, `catalog_name`, `identification` and `names` are
    those of the deeper list of stars where the image shows these.
    """

    site: Site  # of the terrain
    scale: FluxScale  # of the stars' light
    response: DamagedResponse | None = None  # of a damaged image to stars
    catalog_note: str = ""  # why the stars of the deeper list are not used; "": they are, or are not asked for

    @property
    def R_cam_enu(self) -> Array:
        """Rotation (3, 3) from enu to the camera."""
        return np.asarray(self.attitude_fit.attitude.R_cam_icrs @ self.R_enu_icrs.T)

    @property
    def warnings(self) -> list[str]:
        """Warnings before the terrain was used; what the terrain does not cover or state; a Sun that is up."""
        day = [] if self.exposure.time_utc is None else daylight_warnings(self.site, self.exposure.time_utc)
        note = [self.catalog_note] if self.catalog_note else []
        return [*super().warnings, *note, *self.terrain.warnings(), *day]


class SkyEvidence(NamedTuple):
    """The light of the sky as evidence of a position."""

    light: SkyLight  # of the image at the skyline, under the sky of the first look: the second moves it by less than
    # the error of the clock that is left then
    used: Bools  # (SECTORS,) where it is used
    errors: ImageErrors  # of it

    def evidence(self, stars: Evidence, by_stars: bool) -> Evidence:
        """Rows of this light, `by_stars` after those of the `stars`; with their clock and prior in either case."""
        light = replace(self.light.evidence(self.used), clock=stars.clock, near=stars.near)
        return replace(Evidence.concatenate(stars, light) if by_stars else light, image_errors=self.errors)

    def at_skyline(self, fix: Fix) -> Self | None:
        """Copy that is used where this light ends at the skyline of a `fix`; None: nowhere."""
        used = self.used if fix.lit is None else self.used & ~fix.lit.likely
        return self._replace(used=used) if used.any() else None


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstLook:
    """A rough position by the stars alone: it tells where the skyline stands."""

    measured: Measured  # on ground of the likeliest steepness, under the sky of the likeliest time
    fix: Fix


@dataclass(frozen=True, kw_only=True, eq=False)
class SecondLook:
    """What the image shows at the skyline of a first look: all that the position is from."""

    first: FirstLook
    measured: Measured  # of the first look; stars beside the skyline without the step of the sky's light, all of them
    # with their way across the skyline while the shutter is open
    sky: SkyEvidence | None = None  # None: not used for the fix
    why_no_sky: str = ""  # why not; "": it is used, or the settings leave it out
    by_stars: bool = True  # whether the stars' rows are in the posterior too
    sky_brightness_mag_arcsec2: float | None = None  # beyond that of the ground; None: no step, no zero point

    def evidence(self) -> Evidence:
        """Rows of the stars, of the sky's light, or of both as evidence for the localizer."""
        stars = self.measured.evidence()
        return stars if self.sky is None else self.sky.evidence(stars, self.by_stars)


@dataclass(frozen=True, kw_only=True, eq=False)
class Located(Positioned, StarFix, Measured):
    """The whole solution: evidence and the position that explains it."""

    sky: SkyEvidence | None = None  # these four as in the second look
    why_no_sky: str = ""
    by_stars: bool = True
    sky_brightness_mag_arcsec2: float | None = None
    skyline: MeasuredSkyline | None = None  # that the image shows; None: not one position, or not right to its error

    @property
    def warnings(self) -> list[str]:
        """Warnings before the position; what blocks the view; errors beyond the defaults of facts no file states."""
        return [*super().warnings, *self.position_warnings]

    @property
    def sky_at_skyline(self) -> SkyEvidence | None:
        """The sky's light where it ends at the skyline of the fix; None: nowhere, or not used."""
        return None if self.sky is None else self.sky.at_skyline(self.fix)

    @property
    def sky_unused(self) -> str:
        """Reason why the sky's light does not show the skyline in all directions; "": it does, or is not asked for."""
        if self.sky is None or self.fix.lit is None:
            return self.why_no_sky
        return f"at azimuths {self.fix.lit.text}, where its edge is not the skyline that the stars show: lit ground?"

    @property
    def evidence_source(self) -> str:
        """Source of the position: stars, sky (the light of the sky), or both."""
        if self.sky_at_skyline is None:
            return "stars"
        return "both" if self.by_stars else "sky"


@dataclass(frozen=True, kw_only=True, eq=False)
class Refused:
    """An exposure without a solution, why, and the last complete value that was reached."""

    reason: Reason
    message: str
    reached: Inputs
    timing_ms: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))  # the failed stage included

    @property
    def status(self) -> str:
        """Status of the result format: always refused."""
        return "refused"

    @property
    def exposure(self) -> Exposure:
        """The exposure that was refused."""
        return self.reached.exposure

    @property
    def warnings(self) -> list[str]:
        """Warnings of the last complete value that was reached."""
        return self.reached.warnings


Outcome: TypeAlias = Inputs | Refused  # of a command: Detected, Oriented or Located, or a refusal


def last_value(outcome: Outcome) -> Inputs:
    """The last complete value of an outcome: itself, or the value reached before a refusal."""
    return outcome.reached if isinstance(outcome, Refused) else outcome
