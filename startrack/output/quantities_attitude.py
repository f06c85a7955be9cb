"""Output quantities of the attitude: of the camera among the stars, and of the body on the ground."""

from __future__ import annotations

import numpy as np

from startrack.chain import Measured, Oriented
from startrack.frames import quat_xyzw_from_R
from startrack.output.quantity import Column, Quantity, Show
from startrack.output.schema_parts import FLAG, LATITUDE, LONGITUDE, POSITIVE, QUATERNION, TURN, numbers
from startrack.output.values import (
    ARCSEC_PER_RAD,
    R_body_enu,
    arcsec_text,
    body_deg,
    body_sigmas_deg,
    boresight_deg,
    exact_lens_text,
)  # fmt: skip

Q = Quantity
_HEADING = "attitude.heading_deg"
ATTITUDE: tuple[Quantity, ...] = (
    Q("attitude.quat_xyzw_cam_icrs", "", Oriented, lambda v: quat_xyzw_from_R(v.attitude.R_cam_icrs).tolist(),
      "v_cam = R v_icrs, SciPy's order", QUATERNION,
      columns=tuple(Column(f"q{axis}_cam_icrs", "%.12f", (i,)) for i, axis in enumerate("xyzw"))),
    Q("attitude.ra_deg", "deg", Oriented, boresight_deg(0), "right ascension of the boresight", TURN,
      shown=(Show("summary", "ra", "RA {:.3f}°", _HEADING), Show("text", "boresight", "RA {:.4f}°"),
             Show("panel", "Boresight", "RA {:.3f}°", _HEADING), Show("notebook", "right ascension", "{:.4f}°"),
             Show("page", "Right ascension", "{:.4f}°"))),
    Q("attitude.dec_deg", "deg", Oriented, boresight_deg(1), "declination of the boresight", LATITUDE,
      shown=(Show("summary", "dec", "Dec {:+.3f}°", _HEADING), Show("text", "boresight", ", Dec {:+.4f}°"),
             Show("panel", "Boresight", "   Dec {:+.3f}°", _HEADING), Show("notebook", "declination", "{:.4f}°"),
             Show("page", "Declination", "{:.4f}°"))),
    Q("attitude.roll_deg", "deg", Oriented, boresight_deg(2),
      "position angle of the image's top, from north through east", TURN,
      shown=(Show("summary", "roll", "roll {:.3f}°", _HEADING), Show("text", "boresight", ", roll {:.4f}°"),
             Show("panel", "Boresight", "   roll {:.3f}°", _HEADING),
             Show("notebook", "roll", "{:.4f}° (image's top, from north through east)"),
             Show("page", "Image's top", "{:.4f}°"))),
    Q("attitude.sigma_arcsec", "arcsec", Oriented,
      lambda v: (np.sqrt(np.diag(v.attitude.covariance_rad2)) * ARCSEC_PER_RAD).tolist(),
      "of rotations about cam x, y, z: the errors of the stars, and of the lens where the camera has a `covariance`",
      numbers(3), columns=tuple(Column(f"sigma_{axis}_arcsec", "%.4f", (i,)) for i, axis in enumerate("xyz")),
      shown=(Show("text", "boresight", lambda s: f"; sigma {arcsec_text(s)} x, y, z"),
             Show("notebook", "sigma", lambda s: f"{arcsec_text(s)} cam x, y, z"),
             Show("page", "Sigma", lambda s: f"{arcsec_text(s)} x, y, z"))),
    Q("attitude.lens_error_included", "", Oriented, lambda v: v.camera.covariance is not None,
      "whether the camera has one; without it the lens is taken as exact, and the true error of the attitude is larger "
      "by the rotation that a wrong centre or focal length causes", FLAG, optional=True,
      shown=(Show("text", "boresight", exact_lens_text), Show("notebook", "sigma", exact_lens_text),
             Show("page", "Sigma", exact_lens_text))),
    Q("attitude.quat_xyzw_body_enu", "", Measured, lambda v: quat_xyzw_from_R(R_body_enu(v)).tolist(),
      "the rover's attitude, v_body = R v_enu; this and the following need terrain and time", QUATERNION,
      optional=True),
    Q(_HEADING, "deg", Measured, body_deg(0), "azimuth of body x", TURN, optional=True,
      columns=(Column("heading_deg", "%.6f"),),
      shown=(Show("summary", "heading", "heading {:.1f}°"), Show("text", "body", "heading {:.3f}°"),
             Show("panel", "Heading", "{:.2f}°"), Show("notebook", "heading", "{:.3f}°"),
             Show("page", "Heading", "{:.3f}°"))),
    Q("attitude.pitch_deg", "deg", Measured, body_deg(1), "nose up positive", LATITUDE, optional=True,
      columns=(Column("pitch_deg", "%.6f"),),
      shown=(Show("text", "body", ", pitch {:+.3f}°"), Show("panel", "Heading", "   pitch {:+.2f}°"),
             Show("notebook", "pitch", "{:.3f}°"), Show("page", "Pitch", "{:.3f}°"))),
    Q("attitude.roll_body_deg", "deg", Measured, body_deg(2), "right side down positive", LONGITUDE, optional=True,
      columns=(Column("roll_body_deg", "%.6f"),),
      shown=(Show("text", "body", ", roll {:+.3f}°"), Show("panel", "Heading", "   roll {:+.2f}°"),
             Show("notebook", "roll of the body", "{:.3f}°"), Show("page", "Roll", "{:.3f}°"))),
    Q("attitude.sigma_heading_deg", "deg", Measured, lambda v: float(body_sigmas_deg(v)[0]),
      "standard deviation of the heading, from the attitude's covariance", POSITIVE, optional=True,
      columns=(Column("sigma_heading_deg", "%.6f"),),
      shown=(Show("text", "body", "; sigma {:.5f}°"), Show("notebook", "heading", " ± {:.5f}°"),
             Show("page", "Heading", " ± {:.5f}°"))),
    Q("attitude.sigma_pitch_deg", "deg", Measured, lambda v: float(body_sigmas_deg(v)[1]),
      "standard deviation of the pitch", POSITIVE, optional=True, columns=(Column("sigma_pitch_deg", "%.6f"),),
      shown=(Show("text", "body", ", {:.5f}°"), Show("notebook", "pitch", " ± {:.5f}°"),
             Show("page", "Pitch", " ± {:.5f}°"))),
    Q("attitude.sigma_roll_body_deg", "deg", Measured, lambda v: float(body_sigmas_deg(v)[2]),
      "standard deviation of the roll", POSITIVE, optional=True, columns=(Column("sigma_roll_body_deg", "%.6f"),),
      shown=(Show("text", "body", ", {:.5f}°"), Show("notebook", "roll of the body", " ± {:.5f}°"),
             Show("page", "Roll", " ± {:.5f}°"))),
)  # fmt: skip
