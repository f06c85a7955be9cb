"""JSON schemas of the files that users write: camera and terrain (TOML), and the sidecar of an image (JSON)."""

from __future__ import annotations

from startrack.camera.io import camera_keys
from startrack.exposure.metadata import SIDECAR as SIDECAR_KEYS
from startrack.output.schema_parts import ABOVE_0, NUMBER, TEXT, Schema, numbers, record, schema

FORMAT_1: Schema = {"const": 1, "default": 1}
CAMERA = schema("Camera file", camera_keys().schema())

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

SIDECAR = schema("Facts beside an image", SIDECAR_KEYS.schema())
