"""Properties of a terrain, as keys of one JSON object and as lines of text."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees
from typing import TYPE_CHECKING, Any

from startrack.core.errors import BadInput

if TYPE_CHECKING:
    from startrack.frames import Site
    from startrack.terrain import Terrain


def facts_of(terrain: Terrain) -> dict[str, Any]:
    """Origin, search area, and the properties of the ground. Raises BadInput (bad_terrain) without an origin."""
    site = site_of(terrain)
    facts: dict[str, Any] = {
        "name": terrain.name,
        "body": site.body,
        "latitude_deg": round(degrees(site.latitude_rad), 6),
        "longitude_deg": round(degrees(site.longitude_rad), 6),
        "search_radius_m": terrain.search_radius_m,
        "camera_height_m": terrain.camera_height_m,
    }
    return facts | terrain.facts()


def site_of(terrain: Terrain) -> Site:
    """The terrain's site. Raises BadInput (bad_terrain) if it has none."""
    if terrain.site is None:
        raise BadInput("bad_terrain", f"{terrain.name} has no origin on a body")
    return terrain.site


def view_facts(terrain: Terrain, position: tuple[float, float] | None) -> dict[str, Any]:
    """Ground and horizon at a position (east, north) [m]. Raises BadInput outside the terrain."""
    if position is None:
        return {}
    import numpy as np

    from startrack.frames import latlon_from_enu

    point = np.array([position])
    if not terrain.allowed(point)[0]:
        raise BadInput("bad_terrain", f"E {position[0]:g} m, N {position[1]:g} m is outside the terrain")
    ground = float(terrain.ground_m(point)[0])
    horizon = np.degrees(terrain.horizon_rad(point, np.radians(np.arange(720) / 2)))
    lat, lon = latlon_from_enu(site_of(terrain), *position, ground)
    return {
        "east_m": position[0], "north_m": position[1], "ground_m": round(ground, 2),
        "place_latitude_deg": round(float(np.degrees(lat)), 6), "place_longitude_deg": round(float(np.degrees(lon)), 6),
        "horizon_min_deg": round(float(horizon.min()), 3), "horizon_max_deg": round(float(horizon.max()), 3),
    }  # fmt: skip


def lines_of(facts: dict[str, Any]) -> Iterator[str]:
    """The properties that `facts` holds, as lines with units."""
    yield facts["name"]
    if "body" in facts:
        origin = _latlon_text(facts["latitude_deg"], facts["longitude_deg"])
        yield f"  origin    {origin}, on the {facts['body'].title()}"
        yield (
            f"  search    within {facts['search_radius_m']:g} m of the origin, the camera "
            f"{facts['camera_height_m']:g} m above the ground"
        )
    if "depth_m" in facts:
        yield f"  ground    a cylinder, {facts['diameter_m']:g} m across and {facts['depth_m']:g} m deep"
    for m in facts.get("maps", ()):
        rows, columns = m["posts"]
        yield (
            f"  map       {m['file']}: {columns} x {rows} posts, {m['post_m']:g} m apart, {m['projection']}, "
            f"heights {m['lowest_m']:g} to {m['highest_m']:g} m"
        )
    if "height_sigma_m" in facts:
        yield f"  errors    {_errors_text(facts)}"
    if facts.get("horizons") and "seconds" in facts:
        how = "were known" if facts["known_before"] else f"computed in {facts['seconds']:g} s"
        yield f"  horizons  {how}: {facts['horizons']}"
    elif facts.get("horizons"):
        ready = facts["horizons_ready"]
        yield f"  horizons  {facts['horizons'] if ready else 'not computed yet: startrack terrain build'}"
    elif "horizons" in facts:
        yield "  horizons  need no table: those of a cylinder are a formula"
    if "ground_m" in facts:
        yield (
            f"  position     E {facts['east_m']:g} m, N {facts['north_m']:g} m: "
            f"{_latlon_text(facts['place_latitude_deg'], facts['place_longitude_deg'])}, "
            f"ground at {facts['ground_m']:g} m, "
            f"horizon {facts['horizon_min_deg']:g} to {facts['horizon_max_deg']:g} degrees"
        )
    for file in facts.get("files", ()):
        yield f"  written   {file}"


def _errors_text(facts: dict[str, Any]) -> str:
    shared = facts["horizon_sigma_deg"]
    all_around = "three times what these make of it" if shared is None else f"{shared:g} degrees"
    sources = {"map": " (from the map's roughness)", "comparison": " (compared with a finer map)"}
    source = sources.get(facts.get("sigma_from", ""), "")
    return f"of single posts {facts['height_sigma_m']:g} m{source}; shared by the whole horizon {all_around}"


def _latlon_text(latitude_deg: float, longitude_deg: float) -> str:
    return (
        f"{abs(latitude_deg):.5f} {'N' if latitude_deg >= 0 else 'S'}, "
        f"{abs(longitude_deg):.5f} {'E' if longitude_deg >= 0 else 'W'}"
    )
