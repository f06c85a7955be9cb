"""JSON schemas of the files that users write: camera and terrain (TOML), and the sidecar of an image (JSON)."""

from __future__ import annotations

from startrack.output.schema_parts import ABOVE_0, NUMBER, QUATERNION, TEXT, Schema, numbers, record, schema

FORMAT_1: Schema = {"const": 1, "default": 1}
ANGLE: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": 180}

MOUNT = record({}, optional={"quat_xyzw_body_cam": {**QUATERNION, "description": "default: a camera that looks up"}})
SENSOR = record(
    {"zero_point_e_per_s": {**ABOVE_0, "description": "electrons per second of a V = 0 star on the axis, whole PSF"}},
    optional={
        "gain_e_per_adu": {**ABOVE_0, "default": 1.0},
        "bias_adu": {**NUMBER, "default": 0.0},
        "read_noise_e": {**NUMBER, "default": 0.0},
        "dark_e_per_s": {**NUMBER, "default": 0.0, "description": "per pixel"},
        "saturation_adu": {**ABOVE_0, "default": 65535.0},
        "psf_sigma_px": {**ABOVE_0, "default": 1.0, "description": "before integration over the pixel"},
        "vignetting": {**numbers(2), "description": "relative throughput 1 + v1 a^2 + v2 a^4"},
    },
) | {"additionalProperties": False}
CAMERA = schema(
    "Camera file",
    record(
        {
            "size_px": numbers(2, {"type": "integer", "minimum": 1}),
            "focal_px": {**numbers(2, ABOVE_0), "description": "pixels per radian on the axis"},
            "centre_px": {**numbers(2), "description": "(0, 0) is the centre of the top-left pixel"},
            "max_angle_deg": {**ANGLE, "description": "edge of the image circle, off the axis"},
        },
        "x_px = cx + fx rho cos b, y_px = cy + fy rho sin b; rho = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9, or tan a",
        optional={
            "format": FORMAT_1,
            "name": TEXT,
            "model": {"enum": ["kannala_brandt", "pinhole"], "default": "kannala_brandt"},
            "k": {"type": "array", "items": NUMBER, "maxItems": 4},
            "calibrated_angle_deg": {**NUMBER, "description": "beyond this the lens is not known"},
            "mirrored": {"type": "boolean", "default": False},
            "decentring": {**numbers(2), "description": "p1, p2 of a decentred lens"},
            "mount": MOUNT,
            "sensor": SENSOR,
            "covariance": record({
                "order": {"type": "array", "items": TEXT},
                "matrix": {"type": "array", "items": {"type": "array", "items": NUMBER}},
            }),
        },
    ),
)  # fmt: skip

ORIGIN = record(
    {"latitude_deg": {"type": "number", "minimum": -90, "maximum": 90}, "longitude_deg": NUMBER},
    "Where the frame enu stands: moon, on the 1737.4 km sphere; earth, geodetic WGS 84.",
    optional={"height_m": {**NUMBER, "default": 0.0}},
)
FROM_0: Schema = {"type": "number", "minimum": 0, "default": 0.0}
CYLINDER = record(
    {"diameter_m": ABOVE_0, "depth_m": ABOVE_0},
    "Axis through the origin; floor at z = 0.",
    optional={"depth_sigma_m": FROM_0, "diameter_sigma_m": FROM_0},
)
DEM = record(
    {"file": {"anyOf": [TEXT, {"type": "array", "items": TEXT, "minItems": 1}], "description": "finest first"}},
    "Height maps on the Moon's sphere; heights above it, posts at pixel centres, bilinear between.",
    optional={
        "height_sigma_m": {**FROM_0, "description": "of single posts, independent of each other"},
        "horizon_sigma_deg": {**NUMBER, "minimum": 0, "description": "of an error that all azimuths share"},
        "scale": {**NUMBER, "description": "metres per unit, where the files do not say"},
        "offset_m": {**NUMBER, "description": "height of value 0, where the files do not say"},
    },
)
SEARCH = record(
    {},
    optional={
        "radius_m": ABOVE_0,
        "max_slope_deg": {"type": "number", "exclusiveMinimum": 0, "maximum": 90, "default": 90},
        "glare_deg": {"type": "array", "items": numbers(2), "description": "azimuth ranges that the Sun lights"},
    },
)
TERRAIN = schema(
    "Terrain file",
    record(
        {"body": {"enum": ["moon", "earth"]}, "origin": ORIGIN},
        optional={
            "format": FORMAT_1,
            "name": TEXT,
            "cylinder": CYLINDER,
            "dem": DEM,
            "rover": record({}, optional={"camera_height_m": {**NUMBER, "minimum": 0, "default": 1.5}}),
            "search": SEARCH,
        },
    )
    | {"oneOf": [{"required": ["cylinder"]}, {"required": ["dem"]}]},
)

SIDECAR = schema(
    "Facts beside an image",
    record(
        {},
        "NAME.json beside NAME.png. Paths are relative to the sidecar.",
        optional={
            "time_utc": {**TEXT, "description": "middle of the exposure, ISO 8601, UTC"},
            "exposure_s": ABOVE_0,
            "camera": {**TEXT, "description": "a camera file, or the name of a shipped one"},
            "terrain": {**TEXT, "description": "a terrain file, or the name of a shipped one"},
        },
    ),
)
