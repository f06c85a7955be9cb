"""JSON schema of track.json."""

from __future__ import annotations

from startrack.applications.tracking.quantities import FRAME_QUANTITIES, STATUSES
from startrack.applications.tracking.write import FORMAT
from startrack.core.errors import Reason
from startrack.output.schema_parts import COUNT, FLAG, NUMBER, POSITIVE, TEXT, Schema, or_null, record, schema

KINDS: dict[str, Schema] = {"string": TEXT, "int64": COUNT, "float64": NUMBER}
OWN: dict[str, Schema] = {
    "image": TEXT,
    "time_utc": TEXT,
    "status": {"enum": list(STATUSES)},
    "reason": {"enum": [None, *(one.value for one in Reason)]},
    "slipped": {"enum": [0, 1]},
}
FRAME = record({
    one.key: {**OWN[one.key], "description": one.description}
    if one.key in OWN
    else or_null(KINDS[one.datatype], f"{one.description} [{one.unit}]" if one.unit else one.description)
    for one in FRAME_QUANTITIES
})  # fmt: skip
ODOMETRY = record({"file": TEXT, "sigma": POSITIVE, "floor_m": POSITIVE})
TRACK = schema(
    "Trajectory of a camera",
    record({
        "format": {"const": FORMAT},
        "terrain": TEXT,
        "at_rest": FLAG,
        "odometry": or_null(ODOMETRY, "its file and stated errors"),
        "counts": record(dict.fromkeys(("frames", *STATUSES, "slips"), COUNT)),
        "horizon": record({"error_deg": NUMBER, "sigma_deg": POSITIVE}, "true horizon less the map's"),
        "clock": or_null(record({"offset_s": NUMBER, "sigma_s": POSITIVE}), "true time less the stated one"),
        "depth": or_null(
            record({"error_percent": NUMBER, "sigma_percent": POSITIVE}),
            "true depth of a crater less that of its file; null where that is taken as exact",
        ),
        "frames": {"type": "array", "items": FRAME},
        "provenance": record({"version": TEXT}),
    }),
)  # fmt: skip
