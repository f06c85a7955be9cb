"""JSON schemas of the records of `startrack calibrate` and `startrack calibrate verify`."""

from __future__ import annotations

from startrack.applications.calibration.record import CALIBRATION_FORMAT
from startrack.applications.calibration.verify import VERIFICATION_FORMAT
from startrack.camera import camera_keys
from startrack.core.errors import Reason
from startrack.output import Kind, file_schema, list_schema, object_schema, or_null

ABOUT: dict[str, Kind] = {
    "status": {"enum": ["ok", "refused"]}, "reason": {"enum": [None, *(one.value for one in Reason)]}, "message": "text"
}  # fmt: skip
NOT_MEASURED = "null: not measured"
MODEL = object_schema(
    {"name": "text", "parameters": "count", "held_out_chi2": "positive", "held_out_rms_px": "positive"}
)
LENS = object_schema(
    {
        "clipped": "count", "rms_px": "positive", "held_out_rms_px": "positive",
        "models": list_schema(MODEL, "every lens model tried"),
    },
    "how well the stars of the sky, or the corners of boards, fit",
    optional={
        "stars": "count", "corners": "count", "held_out_rms_arcmin": "positive", "extra_sigma_px": "positive",
        "chi2_per_dof": "positive", "birge_ratio": "positive", "map_sigma_px": "positive", "refraction": "text",
    },
)  # fmt: skip
LIGHT = object_schema({
    "zero_point_adu_per_s": "positive", "zero_point_sigma_mag": "positive",
    "vignetting": list_schema("number", "v1, v2", 2), "colour_mag": or_null("number", NOT_MEASURED),
    "extinction_mag": or_null("number", NOT_MEASURED), "scatter_mag": "positive", "stars": "count",
})  # fmt: skip
PHOTOMETRY = object_schema({
    "light": or_null(LIGHT, NOT_MEASURED),
    **{
        key: or_null("number", NOT_MEASURED)
        for key in ("gain_e_per_adu", "gain_sigma_e_per_adu", "bias_adu", "saturation_adu", "psf_sigma_px")
    },
    "psf_by_ring_px": list_schema(or_null("positive", NOT_MEASURED)),
    "hot_pixels": or_null("count", NOT_MEASURED),
    "notes": list_schema("text", "what is missing"),
})  # fmt: skip
IMAGE = object_schema(
    {"image": "text"},
    optional={
        "sha256": or_null("text", "of the file"), "time_utc": "time", "stars": "count", "matched_fraction": "chance",
        "held_out_rms_px": or_null("positive", "null: no star of it is used"), "quat_xyzw_cam_icrs": "quaternion",
        "sigma_arcsec": list_schema("positive", count=3), "quat_xyzw_cam_enu": "quaternion",
    },
)  # fmt: skip
GATE = object_schema({"name": "text", "value": "number", "limit": "text", "passed": "flag"})
REFUSED_IMAGE = object_schema({"name": "text", "reason": "text", "message": "text"})
CALIBRATION = file_schema(
    "Calibration of a lens",
    object_schema(
        {
            "format": {"const": CALIBRATION_FORMAT},
            **ABOUT,
            "camera": or_null(camera_keys().schema(), "the camera file; null when refused"),
            "refused": list_schema(REFUSED_IMAGE, "pictures that were not used"),
        },
        optional={
            "advice": "text",
            "lens": LENS,
            "gates": list_schema(GATE, "the conditions of acceptance"),
            "coverage": object_schema(
                {"ring_edges_deg": list_schema("positive"), "stars": list_schema(list_schema("count"))},
                "rings off the axis; stars by ring and sector",
            ),
            "photometry": PHOTOMETRY,
            "images": list_schema(IMAGE),
            "obstructed_fraction": "chance",
            "provenance": object_schema({"version": "text"}, optional={"false_alarm_probability": "chance"}),
        },
    ),
)
VERIFICATION = file_schema(
    "Comparison of a camera file with a picture",
    object_schema(
        {"format": {"const": VERIFICATION_FORMAT}, "image": "text", **ABOUT},
        optional={
            "advice": "text",
            "warnings": list_schema("text"),
            "camera": "text",
            "stars": "count",
            **dict.fromkeys(("rms_px", "map_change_px", "map_change_sigma_px", "map_change_largest_px"), "positive"),
            "focal_change": "number",
            "centre_change_px": list_schema("number", count=2),
        },
    )
    | {"if": {"properties": {"status": {"const": "ok"}}}, "then": {"required": ["stars", "map_change_px"]}},
)
