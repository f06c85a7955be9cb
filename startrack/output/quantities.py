"""The table of output quantities: what each is, how it is computed, and where it is shown.

Result record, JSON schema, batch columns, summary line, detailed text, panel of the picture, notebook tables, HTML page
and a table of docs/formats.md are made from `QUANTITIES`. A new quantity is one entry.
"""

from __future__ import annotations

from startrack import __version__
from startrack.chain import Detected, Inputs, Located, Measured
from startrack.frames import format_utc
from startrack.output.quantities_attitude import ATTITUDE
from startrack.output.quantities_light import LIGHT
from startrack.output.quantities_position import POSITION
from startrack.output.quantity import Column, Quantity, Show
from startrack.output.schema_parts import NUMBER, POSITIVE, TEXT

Q = Quantity
RUN: tuple[Quantity, ...] = (
    Q("clock.offset_s", "s", Located, lambda v: None if v.fix.clock is None else v.fix.clock.offset_s,
      "true minus stated time: mean of the posterior; 0 in a round crater, where the image does not show it; null: a "
      "method without a posterior", NUMBER, nullable=True,
      columns=(Column("clock_offset_s", "%.6g"),),
      shown=(Show("text", "clock", "offset {:+.3f} s"), Show("notebook", "clock", "{:+.3f} s"),
             Show("page", "Clock", "{:+.3f} s"))),
    Q("clock.sigma_s", "s", Located, lambda v: None if v.fix.clock is None else v.fix.clock.sigma_s,
      "standard deviation of the offset; as stated (`provenance.time_sigma_s`) where the image does not show it; null: "
      "as above", POSITIVE, nullable=True,
      columns=(Column("clock_sigma_s", "%.6g"),),
      shown=(Show("text", "clock", "; sigma {:.3f} s"), Show("notebook", "clock", " ± {:.3f} s"),
             Show("page", "Clock", " ± {:.3f} s"))),
    Q("provenance.version", "", Inputs, lambda v: __version__, "of startrack", TEXT),
    Q("provenance.image_sha256", "", Inputs, lambda v: v.exposure.sha256,
      "of the file; of an array: of its type, shape and values", TEXT, columns=(Column("image_sha256", "%s"),)),
    Q("provenance.camera", "", Inputs, lambda v: v.exposure.camera or (v.camera.name if v.camera is not None else None),
      "camera file or name", TEXT, before=None, columns=(Column("camera", "%s"),)),
    Q("provenance.terrain", "", Inputs,
      lambda v: v.exposure.terrain or (v.terrain.name if v.terrain is not None else None), "terrain file or name", TEXT,
      before=None, columns=(Column("terrain", "%s"),)),
    Q("provenance.catalog", "", Inputs, lambda v: v.catalog_name or None, "star catalogue", TEXT, before=None),
    Q("provenance.localizer", "", Inputs, lambda v: v.localizer_name or None,
      "method of localization, by its name for `--localizer`; of one of your own the name of its class or function; "
      "null: of `identify` and `detect`", TEXT, before=None, optional=True),
    Q("provenance.near", "m", Measured, lambda v: None if v.near is None else str(v.near),
      "`EAST,NORTH,SIGMA` of the prior of the position that the posterior contains; null: none was given", TEXT,
      nullable=True, optional=True),
    Q("provenance.time_utc", "", Inputs,
      lambda v: None if v.exposure.time_utc is None else format_utc(v.exposure.time_utc),
      "middle of the exposure; null: not known", {"type": "string", "format": "date-time"}, before=None,
      columns=(Column("time_utc", "%s"),)),
    Q("provenance.time_sigma_s", "s", Inputs,
      lambda v: None if v.exposure.time_utc is None else v.exposure.time_sigma_s,
      "standard deviation of the clock's error, as stated, or 1; null: no time is known", POSITIVE, before=None,
      optional=True, columns=(Column("time_sigma_s", "%.9g"),)),
    Q("provenance.exposure_s", "s", Inputs, lambda v: v.exposure.exposure_s, "null: not known", NUMBER, before=None,
      columns=(Column("exposure_s", "%.9g"),)),
    Q("provenance.mask_sha256", "", Detected,
      lambda v: None if v.detections.mask is None else v.detections.mask.sha256 or None,
      "of the file of the mask, or of the array that is masked; with the camera's and the image's mask both, joined by "
      "`+`; null: every pixel counts", TEXT, before=None, nullable=True, optional=True),
    Q("provenance.dark_sha256", "", Inputs,
      lambda v: None if v.exposure.correction is None else v.exposure.correction.dark_sha256,
      "of the file of the dark frame; null: none was subtracted", TEXT, before=None, nullable=True, optional=True),
    Q("provenance.flat_sha256", "", Inputs,
      lambda v: None if v.exposure.correction is None else v.exposure.correction.flat_sha256,
      "of the file of the flat field; null: none was used", TEXT, before=None, nullable=True, optional=True),
)  # fmt: skip
QUANTITIES: tuple[Quantity, ...] = POSITION + ATTITUDE + LIGHT + RUN
BY_PATH = {one.path: one for one in QUANTITIES}
# The batch's columns came in this order before the table did; a column that is not named here is appended.
FIRST_COLUMNS = (
    "time_utc", "exposure_s", "east_m", "north_m", "up_m", "cov_east_east_m2", "cov_east_north_m2",
    "cov_north_north_m2", "radius95_m", "radius999_m", "latitude_deg", "longitude_deg", "heading_deg", "pitch_deg",
    "roll_body_deg", "qx_cam_icrs", "qy_cam_icrs", "qz_cam_icrs", "qw_cam_icrs", "sigma_x_arcsec", "sigma_y_arcsec",
    "sigma_z_arcsec", "detected", "identified", "rms_px", "image_sha256",
)  # fmt: skip
