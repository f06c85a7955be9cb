"""The Hipparcos catalogue against published positions, astropy and other catalogues' counts."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from startrack.catalog import StarCatalog, load_catalog, star_names
from startrack.core.errors import BadInput
from startrack.core.files import data_dir
from startrack.frames import angle_between_rad

MAS = np.pi / 648_000_000
DATE = datetime(2026, 11, 20, 6, 0, tzinfo=UTC)

# HIP, ICRS J2000.0 position (SIMBAD, after van Leeuwen 2007), V and B-V (ESA 1997)
FAMOUS = {
    "Sirius": (32349, "06 45 08.91728", "-16 42 58.0171", -1.44, 0.009),
    "Canopus": (30438, "06 23 57.10988", "-52 41 44.3810", -0.62, 0.164),
    "Vega": (91262, "18 36 56.33635", "+38 47 01.2802", 0.03, -0.001),
    "Polaris": (11767, "02 31 49.09456", "+89 15 50.7923", 1.97, 0.636),
    "Acrux": (60718, "12 26 35.89522", "-63 05 56.7343", 0.77, -0.243),
    "Arcturus": (69673, "14 15 39.67207", "+19 10 56.6730", -0.05, 1.239),
    "Rigel": (24436, "05 14 32.27210", "-08 12 05.8981", 0.18, -0.030),
    "Betelgeuse": (27989, "05 55 10.30536", "+07 24 25.4304", 0.45, 1.500),
    "Achernar": (7588, "01 37 42.84548", "-57 14 12.3101", 0.45, -0.158),
    "Fomalhaut": (113368, "22 57 39.04625", "-29 37 20.0533", 1.17, 0.145),
    "Antares": (80763, "16 29 24.45970", "-26 25 55.2094", 1.06, 1.865),
    "Rigil Kentaurus": (71683, "14 39 36.49400", "-60 50 02.3737", -0.01, 0.710),
    "Hadar": (68702, "14 03 49.40535", "-60 22 22.9266", 0.61, -0.231),
    "Barnard's star": (87937, "17 57 48.49803", "+04 41 36.2072", 9.54, 1.570),
}


@pytest.fixture(scope="module")
def catalog() -> StarCatalog:
    return load_catalog()


def row(catalog: StarCatalog, hip: int) -> int:
    (found,) = np.flatnonzero(catalog.hip == hip)
    return int(found)


def ray(ra_deg: float, dec_deg: float) -> np.ndarray:
    a, d = np.radians(ra_deg), np.radians(dec_deg)
    return np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])


def sexagesimal(text: str) -> float:
    a, b, c = text.lstrip("+-").split()
    return (-1 if text[0] == "-" else 1) * (int(a) + int(b) / 60 + float(c) / 3600)


@pytest.mark.parametrize("name", FAMOUS)
def test_published_places_and_magnitudes(catalog: StarCatalog, name: str) -> None:
    hip, ra, dec, v, b_v = FAMOUS[name]
    stars = catalog.at(None, None)
    i = row(catalog, hip)
    off = angle_between_rad(stars.rays_icrs[i], ray(15 * sexagesimal(ra), sexagesimal(dec))) / MAS
    assert off < 2.0  # mas; without proper motion Sirius would be 11,700 off, with the wrong sign 23,000
    assert stars.v_mag[i] == pytest.approx(v, abs=0.006)
    assert catalog.b_v[i] == pytest.approx(b_v, abs=0.006)
    assert stars.catalog_id[i] == f"HIP {hip}"


def test_every_row_is_there(catalog: StarCatalog) -> None:
    assert np.sum(catalog.hip > 0) == 117_955 + 4
    assert len(catalog) == 117_955 + 4 + 18
    assert len(np.unique(catalog.catalog_id)) == len(catalog)
    assert not np.any(catalog.hip == 120412)  # no position is known


def test_counts_agree_with_an_independent_list(catalog: StarCatalog) -> None:
    # RMS's list of V <= 7.5 from other photometry: stars by V. Beyond 7.0 Hipparcos is known to lack 8 and 11 %.
    for lower, upper, listed, missing in (
        (-2, 5, 1599, 0.0), (5, 6, 3378, 0.0), (6, 6.5, 3750, 0.0), (6.5, 7, 6590, 0.011),
        (7, 7.3, 6005, 0.077), (7.3, 7.5, 5374, 0.111),
    ):  # fmt: skip
        ours = np.sum((catalog.v_mag >= lower) & (catalog.v_mag < upper))
        assert ours == pytest.approx(listed * (1 - missing), rel=0.035), (lower, upper)


def test_holes_of_hipparcos_are_filled(catalog: StarCatalog) -> None:
    stars = catalog.at(None, None)
    for hip, v, ra, dec in (
        (31067, 6.18, "06 31 10.0", "+16 56 19"),
        (55203, 3.79, "11 18 10.95", "+31 31 45.7"),  # xi UMa: SIMBAD
        (78727, 4.16, "16 04 22.13", "-11 22 22.6"),  # xi Sco: SIMBAD
    ):
        i = row(catalog, hip)
        assert stars.v_mag[i] == pytest.approx(v, abs=0.03)
        assert angle_between_rad(stars.rays_icrs[i], ray(15 * sexagesimal(ra), sexagesimal(dec))) / MAS < 2500
    # 94 Aqr B is 13 arcsec from 94 Aqr A and two magnitudes fainter, not its equal.
    a, b = row(catalog, 115126), row(catalog, 115125)
    assert angle_between_rad(stars.rays_icrs[a], stars.rays_icrs[b]) / MAS == pytest.approx(13_300, abs=1000)
    assert stars.v_mag[b] - stars.v_mag[a] == pytest.approx(2.35, abs=0.3)


def test_stars_without_a_hipparcos_number(catalog: StarCatalog) -> None:
    stars = catalog.at(None, None)
    (i,) = np.flatnonzero(stars.catalog_id == "HR 4210")  # eta Car, SIMBAD
    assert stars.hip[i] == 0
    position = ray(15 * sexagesimal("10 45 03.546"), sexagesimal("-59 41 03.95"))
    assert angle_between_rad(stars.rays_icrs[i], position) / MAS < 1500
    assert 3.8 < stars.v_mag[i] < 4.6


def test_no_false_bright_stars_from_blended_hipparcos_magnitudes(catalog: StarCatalog) -> None:
    # Published V of sigma Ori D, theta1 Ori D and epsilon Equ C, and Gaia DR3's G of HIP 106890; Hp says 3.7 to 5.7.
    for hip, v in ((26551, 6.6), (26224, 6.7), (103571, 7.4), (106890, 8.0)):
        assert catalog.v_mag[row(catalog, hip)] == pytest.approx(v, abs=0.35)
    assert catalog.v_mag[row(catalog, 65378)] == pytest.approx(2.04, abs=0.05)  # Mizar A and B together


def test_sigma_is_small_for_steady_stars_and_large_for_variables(catalog: StarCatalog) -> None:
    sigma = catalog.v_sigma_mag
    assert np.median(sigma[catalog.v_mag < 6.5]) == pytest.approx(0.02, abs=0.005)
    assert np.mean(sigma[catalog.v_mag < 7.0] > 0.1) < 0.03
    assert sigma.min() >= 0.02
    for hip, least in ((10826, 1.0), (97629, 1.0), (46806, 1.0), (27989, 0.25), (110991, 0.2), (77442, 1.0)):
        assert sigma[row(catalog, hip)] > least  # Mira, chi Cyg, R Car, Betelgeuse, delta Cep, R CrB
    for hip in (65474, 97649, 49669):  # Spica, Altair, Regulus
        assert sigma[row(catalog, hip)] < 0.06


def test_proper_motion_agrees_with_astropy(catalog: StarCatalog) -> None:
    coordinates = pytest.importorskip("astropy.coordinates")
    units = pytest.importorskip("astropy.units")
    time = pytest.importorskip("astropy.time")
    t = np.load(data_dir("catalogs") / "hipparcos.npy")
    speed = np.hypot(t["pm_ra"], t["pm_dec"])
    near_pole = np.argsort(-np.abs(t["dec"].astype(float)))[:50]
    some = np.unique(np.r_[np.argsort(-speed)[:200], near_pole, np.arange(0, len(t), 997)])
    mas_yr, epoch = units.mas / units.yr, time.Time(1991.25, format="jyear", scale="tt")
    start = coordinates.SkyCoord(
        ra=t["ra"][some] * (360 / 2**32) * units.deg, dec=t["dec"][some] * (360 / 2**32) * units.deg,
        pm_ra_cosdec=t["pm_ra"][some] * 0.01 * mas_yr, pm_dec=t["pm_dec"][some] * 0.01 * mas_yr,
        distance=1 * units.pc, radial_velocity=0 * units.km / units.s, obstime=epoch,
    )  # fmt: skip
    for date in (DATE, datetime(1970, 1, 1, tzinfo=UTC)):
        then = start.apply_space_motion(new_obstime=time.Time(date))
        theirs = then.cartesian.xyz.value.T
        off = angle_between_rad(catalog.at(date, None).rays_icrs[some], theirs) / MAS
        assert off.max() < 1.0  # mas; the fastest star moved 367,000 to DATE


def test_aberration_agrees_with_astropy(catalog: StarCatalog) -> None:
    coordinates = pytest.importorskip("astropy.coordinates")
    iers = pytest.importorskip("astropy.utils.iers")
    from astropy.time import Time

    bright = catalog.brighter_than(4.5)
    with iers.conf.set_temp("auto_download", False):
        when = Time(DATE)
        _, velocity = coordinates.get_body_barycentric_posvel("earth", when)
        at_rest = bright.at(DATE, None)
        rest = coordinates.SkyCoord(coordinates.UnitSphericalRepresentation.from_cartesian(
            coordinates.CartesianRepresentation(at_rest.rays_icrs.T)), frame="icrs")  # fmt: skip
        theirs = rest.transform_to(coordinates.GCRS(obstime=when)).cartesian.xyz.value.T
        sun = coordinates.get_sun(when).cartesian.xyz.value
    ours = bright.at(DATE, velocity.xyz.to_value("m/s"))
    off = angle_between_rad(ours.rays_icrs, theirs) / MAS
    far = angle_between_rad(at_rest.rays_icrs, sun) > np.radians(60)
    assert off[far].max() < 8.0  # mas: what remains is the Sun's bending of light, 4.07 cot(half the angle)
    moved = angle_between_rad(ours.rays_icrs, at_rest.rays_icrs) / MAS
    assert 20_000 < moved.max() < 20_800


def test_no_time_is_j2000(catalog: StarCatalog) -> None:
    bright = catalog.brighter_than(3.0)
    j2000 = bright.at(datetime(2000, 1, 1, 11, 58, 56, tzinfo=UTC), None)
    assert np.array_equal(bright.at(None, None).catalog_id, j2000.catalog_id)
    assert angle_between_rad(bright.at(None, None).rays_icrs, j2000.rays_icrs).max() < 0.1 * MAS
    with pytest.raises(ValueError, match="time zone"):
        bright.at(datetime(2026, 1, 1), None)


def test_brighter_than_is_a_cut(catalog: StarCatalog) -> None:
    kept = catalog.brighter_than(6.0)
    assert len(kept) == np.sum(catalog.v_mag < 6.0)
    assert kept.v_mag.max() < 6.0
    assert np.all(np.diff(kept.at(DATE, None).v_mag) >= 0)
    assert np.array_equal(kept.catalog_id, catalog.catalog_id[: len(kept)])
    assert kept.name == "hipparcos"
    assert len(catalog.brighter_than(-5.0).at(DATE, np.zeros(3))) == 0
    with pytest.raises(ValueError, match="read-only"):
        kept.v_mag[0] = 0.0


def test_ids_are_source_and_number(catalog: StarCatalog) -> None:
    plain = [f"{catalog.sources[s]} {n}" for s, n in zip(catalog.source, catalog.number, strict=True)]
    assert catalog.catalog_id.tolist() == plain


def test_ids_of_other_catalogues(catalog: StarCatalog) -> None:
    few = catalog.brighter_than(0.1)
    numbers = np.arange(len(few)) + 4_111_834_567_779_557_376
    source = np.arange(len(few)) % 2
    numbers[source == 0] = 10 ** np.flatnonzero(source == 0)
    deep = replace(few, name="deep", sources=("HIP", "Gaia DR3"), source=source, number=numbers)
    stars = deep.at(None, None)
    assert stars.catalog_id[:4].tolist() == ["HIP 1", f"Gaia DR3 {numbers[1]}", "HIP 100", f"Gaia DR3 {numbers[3]}"]
    assert stars.hip[:4].tolist() == [1, 0, 100, 0]


def test_unsorted_catalogues_are_refused(catalog: StarCatalog) -> None:
    with pytest.raises(ValueError, match="ascend"):
        StarCatalog(name="x", epoch_yr=2000.0, source=[0, 0], number=[1, 2], rays_icrs=np.eye(3)[:2],
                    motion_rad_yr=np.zeros((2, 3)), v_mag=[2.0, 1.0], v_sigma_mag=[0, 0], b_v=[0, 0])  # fmt: skip


def test_unknown_catalogue_names_the_known() -> None:
    for name in ("tycho", None):
        with pytest.raises(BadInput, match=rf"is called {name!r} .*hipparcos") as caught:
            load_catalog(name)
        assert caught.value.reason == "bad_calibration"


def test_names(catalog: StarCatalog) -> None:
    names = star_names()
    assert [names[h] for h in (32349, 71681, 55203)] == ["Sirius", "Toliman", "Alula Australis"]
    assert [names[h] for h in (39953, 104214, 21479)] == ["gamma2 Vel", "61 Cyg", "R Dor"]
    assert 27989 in names
    assert 1 not in names
    assert set(names) <= set(catalog.hip.tolist())


def test_names_agree_with_skyfield() -> None:
    theirs = pytest.importorskip("skyfield.named_stars").named_star_dict
    # Skyfield's list gives these names to other stars than the IAU (2016) does.
    differ = {"Algenib", "Gienah", "Markab", "Toliman"}
    ours = {name: hip for hip, name in star_names().items()}
    shared = set(ours) & set(theirs) - differ
    assert len(shared) > 80
    assert {n: ours[n] for n in shared} == {n: theirs[n] for n in shared}
