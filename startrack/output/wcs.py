"""FITS world coordinates of an identified image, and the table of its matches, as other programs read them.

Calabretta & Greisen 2002, A&A 395, 1077 (ARC, ZPN, TAN); Shupe et al. 2005, ASP Conf. 347, 491 (SIP). The lens
has a FITS projection or a polynomial with its error; a decentred one needs the SIP polynomials.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.camera import Camera, Decentring
from startrack.catalog import catalog_rays
from startrack.chain import Oriented
from startrack.core import __version__
from startrack.core.types import Array
from startrack.exposure import BLOCK_BYTES
from startrack.frames import format_utc, wahba

Card = bool | int | float | str
SIP_ORDER = 4
EMPTY_UNIT: dict[str, Card] = {"SIMPLE": True, "BITPIX": 8, "NAXIS": 0, "EXTEND": True}
COMMENTS = {  # of the cards of a table
    "SIMPLE": "conforms to FITS standard", "XTENSION": "binary table extension", "BITPIX": "array data type",
    "NAXIS": "number of array dimensions", "NAXIS1": "length of dimension 1", "NAXIS2": "length of dimension 2",
    "PCOUNT": "number of group parameters", "GCOUNT": "number of groups", "TFIELDS": "number of table fields",
    "EXTNAME": "extension name",
}  # fmt: skip
FIELD_POINTS = 40  # points across the frame at which the field is sampled


def wcs_bytes(value: Oriented) -> bytes | None:
    """The header NAME.wcs of a result with an attitude: no pixels, IMAGEW and IMAGEH give their number.

    None if no FITS projection describes the lens.

    World coordinates are ICRS directions without aberration, so that catalogue positions at the image's epoch fall on
    their stars. Aberration bends a whole sky by up to 20 arcsec (0.06 px of a fisheye), and the Earth's air by more
    near the horizon: the mean over the frame is taken out. FITS pixel (1, 1) is our (0, 0), the first pixel stored.
    """
    cards = wcs_cards(value.camera, _R_cam_catalog(value), value)
    return None if cards is None else header_block(cards)


def wcs_cards(camera: Camera, R_cam_icrs: Array, value: Oriented | None = None) -> dict[str, Card] | None:
    """The header's cards for a camera and its attitude; None if no FITS projection describes the lens."""
    projection = camera.lens.wcs_projection(camera.max_angle_rad)
    if projection is None:
        return None
    axis = R_cam_icrs[2]
    ra, dec = np.arctan2(axis[1], axis[0]), np.arctan2(axis[2], np.hypot(axis[0], axis[1]))
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    focal = np.array(camera.handed_focal_px)
    cd = np.degrees(np.stack([east, north]) @ R_cam_icrs[:2].T / focal)  # from px to degrees east and north
    sip = "-SIP" if camera.decentring else ""
    cards = EMPTY_UNIT | {
        "WCSAXES": 2,
        "CTYPE1": f"RA---{projection.code}{sip}",
        "CTYPE2": f"DEC--{projection.code}{sip}",
    }
    cards |= {"CUNIT1": "deg", "CUNIT2": "deg", "RADESYS": "ICRS", "LONPOLE": 180.0}
    cards |= {"CRVAL1": float(np.degrees(ra) % 360.0), "CRVAL2": float(np.degrees(dec))}
    cards |= {f"CRPIX{i + 1}": float(_axis_px(camera)[i]) + 1.0 for i in range(2)}
    cards |= {f"CD{i + 1}_{j + 1}": float(cd[i, j]) for i in range(2) for j in range(2)}
    cards |= projection.cards
    cards |= {"IMAGEW": camera.size_px[0], "IMAGEH": camera.size_px[1]}
    if sip:
        cards |= _sip_cards(camera)
    if value is not None and value.exposure.time_utc is not None:
        cards["DATE-AVG"] = format_utc(value.exposure.time_utc).removesuffix("Z")
    if projection.error_1:
        error_px = projection.error_1 * max(camera.focal_px)
        cards["COMMENT2"] = f"projection fitted to the lens: largest error {error_px:.2g} px"
    return cards | {"CREATOR": f"startrack {__version__}", "COMMENT1": "image rows in the order of the file"}


def matches_bytes(value: Oriented) -> bytes:
    """The table NAME.corr of the matches: measured position (field) and predicted one (index), in FITS pixels, degrees.

    Columns as astrometry.net's: field_x, field_y, field_ra, field_dec, index_x, index_y, index_ra, index_dec, and
    index_id, FLUX, MAG.
    """
    camera, R = value.camera, _R_cam_catalog(value)
    found, stars = value.identification, value.stars.take(value.identification.star)
    still = catalog_rays(stars.rays_icrs, value.exposure.time_utc, value.site)
    measured = value.detections.xy_px[found.detection]
    predicted, _ = camera.project(stars.rays_icrs @ value.attitude.R_cam_icrs.T)
    field_deg, index_deg = _radec_deg(camera.unproject(measured) @ R), _radec_deg(still)
    columns: list[tuple[str, str, NDArray[Any]]] = [
        ("field_x", "pix", measured[:, 0] + 1), ("field_y", "pix", measured[:, 1] + 1),
        ("field_ra", "deg", field_deg[:, 0]), ("field_dec", "deg", field_deg[:, 1]),
        ("index_x", "pix", predicted[:, 0] + 1), ("index_y", "pix", predicted[:, 1] + 1),
        ("index_ra", "deg", index_deg[:, 0]), ("index_dec", "deg", index_deg[:, 1]),
        ("index_id", "", np.asarray(stars.catalog_id)), ("FLUX", "", value.detections.flux_e[found.detection]),
        ("MAG", "mag", stars.v_mag),
    ]  # fmt: skip
    return header_block(EMPTY_UNIT, COMMENTS) + _table_unit("CORR", columns)


def _table_unit(name: str, columns: list[tuple[str, str, NDArray[Any]]]) -> bytes:
    """A binary table of FITS with the `columns`: key, unit, and values (n,), which are numbers or texts."""
    stored = [np.asarray(values, dtype="S" if values.dtype.kind == "U" else ">f8") for *_, values in columns]
    rows = np.rec.fromarrays(stored)
    cards: dict[str, Card] = {"XTENSION": "BINTABLE", "BITPIX": 8, "NAXIS": 2}
    cards |= {"NAXIS1": rows.itemsize, "NAXIS2": len(rows), "PCOUNT": 0, "GCOUNT": 1, "TFIELDS": len(columns)}
    for k, ((key, unit, _), values) in enumerate(zip(columns, stored, strict=True), start=1):
        cards |= {f"TTYPE{k}": key, f"TFORM{k}": "D" if values.dtype.kind == "f" else f"{values.itemsize}A"}
        cards |= {f"TUNIT{k}": unit} if unit else {}
    return header_block(cards | {"EXTNAME": name}, COMMENTS) + _whole_blocks(rows.tobytes(), b"\0")


def header_block(cards: Mapping[str, Card], comments: Mapping[str, str] | None = None) -> bytes:
    """A FITS header with the `cards` and the `comments` on them; cards whose keys begin with COMMENT are comments.

    FITS Standard 4.0, section 4. astropy writes the same, but takes 0.3 s to load.
    """
    lines = []
    for key, value in cards.items():
        if key.startswith("COMMENT"):  # COMMENT1, COMMENT2, ...: keys of a mapping are unique
            lines.append(f"COMMENT {value}")
        else:
            comment = f" / {comments[key]}" if comments and key in comments else ""
            lines.append(f"{key:8}= {_card_value(value)}{comment}")
    return _whole_blocks("".join(f"{line:80}" for line in [*lines, "END"]).encode("ascii"), b" ")


def _card_value(value: Card) -> str:
    """The text of a card's `value` in its first 20 columns, or more where it is a longer text."""
    if isinstance(value, str):
        return f"'{value:8}'".ljust(20)
    if isinstance(value, bool):
        return f"{'T' if value else 'F':>20}"
    digits, *exponent = str(value).split("e")
    end = "E" + exponent[0] if exponent else ""
    return f"{digits[: 20 - len(end)] + end:>20}"


def _whole_blocks(content: bytes, filler: bytes) -> bytes:
    """The `content` continued by the `filler` to a whole number of FITS blocks."""
    return content + filler * (-len(content) % BLOCK_BYTES)


def _R_cam_catalog(value: Oriented) -> Array:
    """R_cam_icrs (3, 3) that takes catalogue directions, without aberration, nearest to where they appear."""
    camera = value.camera
    if value.exposure.time_utc is None:
        return value.attitude.R_cam_icrs
    rays_cam = camera.unproject(_grid(camera))
    return wahba(rays_cam, catalog_rays(rays_cam @ value.attitude.R_cam_icrs, value.exposure.time_utc, value.site))


def _grid(camera: Camera) -> Array:
    """Pixels (n, 2) over the frame, inside the image circle."""
    x, y = np.meshgrid(*(np.linspace(0.0, side - 1.0, FIELD_POINTS) for side in camera.size_px))
    px = np.stack([x.ravel(), y.ravel()], axis=-1)
    return px[camera.angle_rad(px) <= camera.max_angle_rad]


def _axis_px(camera: Camera) -> Array:
    return camera.project(np.array([0.0, 0.0, 1.0]))[0]


def _radec_deg(rays_icrs: Array) -> Array:
    ra = np.degrees(np.arctan2(rays_icrs[:, 1], rays_icrs[:, 0])) % 360.0
    return np.stack([ra, np.degrees(np.arctan2(rays_icrs[:, 2], np.hypot(rays_icrs[:, 0], rays_icrs[:, 1])))], axis=1)


def _sip_cards(camera: Camera) -> dict[str, Card]:
    """Polynomials from pixels of the decentred lens to those of one that is not (A, B), and back (AP, BP)."""
    decentred = _grid(camera)
    plain, _ = replace(camera, decentring=Decentring()).project(camera.unproject(decentred))
    u, v = decentred - _axis_px(camera), plain - np.array(camera.centre_px)
    scale = float(np.abs(u).max())
    cards: dict[str, Card] = {}
    for names, start, end in ((("A", "B"), u, v), (("AP", "BP"), v, u)):
        powers = [(p, q) for p in range(SIP_ORDER + 1) for q in range(SIP_ORDER + 1 - p) if p + q > 0]
        terms = np.stack([(start[:, 0] / scale) ** p * (start[:, 1] / scale) ** q for p, q in powers], axis=1)
        found = np.linalg.lstsq(terms, end - start, rcond=None)[0]
        for axis, name in enumerate(names):
            cards[f"{name}_ORDER"] = SIP_ORDER
            for (p, q), value in zip(powers, found[:, axis], strict=True):
                cards[f"{name}_{p}_{q}"] = float(value / scale ** (p + q))
    return cards
