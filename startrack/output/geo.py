"""Files for maps: a fix as GeoJSON and as KML, and the style of a raster for QGIS.

The position or the modes are points, the 95 % circle a polygon.

Coordinates are longitude and latitude in degrees: WGS 84 on the Earth, planetocentric on the sphere of 1737.4 km
(IAU_2015:30100) on the Moon.
"""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from math import isfinite
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from startrack.core.errors import one_line
from startrack.frames import Site, latlon_from_enu
from startrack.output.picture.canvas import Colour
from startrack.output.record import result_dict

if TYPE_CHECKING:
    from startrack.chain import Located, PlacedBySkyline
    from startrack.core.types import Array


GEO_FORMATS = ("geojson", "kml")
CIRCLE_POINTS = 72
MOON_CRS = {"type": "name", "properties": {"name": "urn:ogc:def:crs:IAU_2015::30100"}}  # RFC 7946 has WGS 84 alone
ATTITUDE_KEYS = ("ra_deg", "dec_deg", "roll_deg", "heading_deg", "pitch_deg", "roll_body_deg", "sigma_arcsec")
POSITION_KEYS = ("east_m", "north_m", "up_m", "radius95_m", "radius999_m", "protection_level_m", "covariance_m2")
DOCTYPE = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
QGIS_VERSION = "3.22.0"  # whose elements these are; later ones read them
KML_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"{hint}>\n<Document>\n'


def geo_text(value: Located | PlacedBySkyline, kind: str) -> str:
    """The text of a file of the `kind` geojson or kml with the fix of a located `value`."""
    found = features(value)
    return _kml(value, found) if kind == "kml" else geojson_text(found, value.site.body)


def features(value: Located | PlacedBySkyline) -> list[dict[str, Any]]:
    """GeoJSON features: one point for the position and one polygon for its circle, or these of each mode.

    A circle is left out where it holds a pole, where longitudes make no polygon, and where none is stated.
    """
    record, site = result_dict(value), value.site
    common = {key: record[key] for key in ("image", "status")} | {"time_utc": record["provenance"]["time_utc"]}
    common |= {key: (record["attitude"] or {}).get(key) for key in ATTITUDE_KEYS}
    position, up_m, found = record.get("position"), float(value.fix.position_enu_m[2]), list[dict[str, Any]]()
    for at in record["modes"] if position is None else [{key: position.get(key) for key in POSITION_KEYS}]:
        middle_m, radius_m = np.array([at["east_m"], at["north_m"], up_m]), at["radius95_m"]
        found.append(feature("Point", _lonlat(site, middle_m[None])[0], common | at))
        ring = None if radius_m is None else _circle(site, middle_m, radius_m)
        if ring is not None:
            circle = {"image": common["image"], "circle": "95 %", "radius_m": radius_m}
            found.append(feature("Polygon", [ring], circle))
    return found


def _circle(site: Site, middle_m: Array, radius_m: float) -> list[list[float]] | None:
    """Longitude and latitude of a closed ring, anticlockwise; None where it goes round a pole."""
    angle = np.linspace(0.0, 2 * np.pi, CIRCLE_POINTS + 1)
    ring_m = middle_m + radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    ring = np.array(_lonlat(site, ring_m))
    ring[:, 0] = np.degrees(np.unwrap(np.radians(ring[:, 0])))  # across 180 degrees it goes on to 181
    if abs(ring[-1, 0] - ring[0, 0]) > 1.0:
        return None
    ring[-1] = ring[0]
    return [[float(lon), float(lat)] for lon, lat in ring]


def _lonlat(site: Site, points_m: Array) -> list[list[float]]:
    latitude, longitude = latlon_from_enu(site, *points_m.T)
    return [[float(lon), float(lat)] for lon, lat in np.degrees(np.stack([longitude, latitude], axis=1))]


def feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    """A feature of GeoJSON with a geometry of this `kind`, its `coordinates` in degrees, and its `properties`."""
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def geojson_text(features: list[dict[str, Any]], body: str) -> str:
    """The `features` as GeoJSON; on the Moon with its frame, since GeoJSON alone is on the Earth. `body` is a site's.

    Raises ValueError for NaN or an infinity, which JSON has not.
    """
    whole: dict[str, Any] = {"type": "FeatureCollection"}
    if body == "moon":
        whole |= {"crs": MOON_CRS, "body": "moon"}
    return json.dumps({**whole, "features": features}, ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def escape(text: str) -> str:
    """A `text` for XML, which has no control characters."""
    return html.escape(one_line(text), quote=False)


def _kml(value: Located | PlacedBySkyline, found: list[dict[str, Any]]) -> str:
    """KML has no frame for other bodies: Google Earth reads the hint, other programs draw the fix on the Earth."""
    on_moon = value.site.body == "moon"
    note = "On the Moon: planetocentric, sphere of 1737.4 km, east positive. " if on_moon else ""
    hint = ' hint="target=moon"' if on_moon else ""
    marks = "".join(_placemark(one) for one in found)
    description = f"<description>{note}startrack {escape(value.exposure.name)}</description>\n"
    return f"{KML_HEAD.format(hint=hint)}{description}{marks}</Document>\n</kml>\n"


def _placemark(feature: dict[str, Any]) -> str:
    geometry, properties = feature["geometry"], feature["properties"]
    data = "".join(
        f'<Data name="{key}"><value>{escape(text if isinstance(text, str) else json.dumps(text))}</value></Data>'
        for key, text in properties.items()
        if text is not None
    )
    name = f"{properties['image']} {properties.get('circle', '')}".strip()
    is_point, rings = geometry["type"] == "Point", geometry["coordinates"]
    places = " ".join(f"{lon!r},{lat!r}" for lon, lat in ([rings] if is_point else rings[0]))
    shape = f"<coordinates>{places}</coordinates>"
    if is_point:
        shape = f"<Point>{shape}</Point>"
    else:
        shape = f"<Polygon><outerBoundaryIs><LinearRing>{shape}</LinearRing></outerBoundaryIs></Polygon>"
    return f"<Placemark><name>{escape(name)}</name><ExtendedData>{data}</ExtendedData>{shape}</Placemark>\n"


def qgis_style_text(band: int, classes: Sequence[tuple[float, str, Colour]]) -> str:
    """The style (QML) of a raster that shows one `band` (from 1) in colours of `classes`: QGIS loads NAME.qml with it.

    A class has an upper bound, words for the legend and a colour; bounds ascend, and the last may be infinite, but not
    the only one. Where the raster has no value nothing is drawn.
    """
    root = Element("qgis", version=QGIS_VERSION, styleCategories="Symbology")
    pipe = SubElement(root, "pipe")
    lowest, highest = "0", f"{max(bound for bound, *_ in classes if isfinite(bound)):g}"
    renderer = SubElement(
        pipe, "rasterrenderer", type="singlebandpseudocolor", band=str(band), alphaBand="-1", opacity="1",
        nodataColor="", classificationMin=lowest, classificationMax=highest,
    )  # fmt: skip
    SubElement(renderer, "rasterTransparency")
    SubElement(SubElement(renderer, "minMaxOrigin"), "limits").text = "None"  # the bounds are not those of the view
    shader = SubElement(
        SubElement(renderer, "rastershader"), "colorrampshader", colorRampType="DISCRETE", classificationMode="1",
        clip="0", minimumValue=lowest, maximumValue=highest,
    )  # fmt: skip
    for bound, words, colour in classes:
        code = "#" + bytes(colour).hex()
        SubElement(shader, "item", value=f"{bound:g}", label=words, color=code, alpha="255")
    SubElement(root, "blendMode").text = "0"
    indent(root)
    return f"{DOCTYPE}\n{tostring(root, encoding='unicode')}\n"
