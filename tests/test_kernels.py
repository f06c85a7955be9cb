"""The compiled kernels: their border, their header, the same bytes of all builds, and how they are built."""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import inspect
import os
import pickle
import pkgutil
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import startrack
from startrack.kernels import build, library, records

ROOT = Path(__file__).parent.parent
HEADER = (build.FOLDER / "startrack_kernels.h").read_text()
C_TYPES = {
    "float64": "double", "float32": "float", "int64": "int64_t", "int32": "int32_t", "uint8": "uint8_t",
    "uint16": "uint16_t", "bool": "bool", "int8": "int8_t", "uint64": "uint64_t",
    "ground": "const struct ground *restrict", "table": "const struct table *restrict",
}  # fmt: skip
LEVEL_SCRIPT = "import test_kernels; print(test_kernels.bytes_of_all_kernels())"


@pytest.fixture(scope="module")
def declared():
    """Declarations in Python of all kernels and records, by name."""
    for one in pkgutil.walk_packages(startrack.__path__, "startrack."):
        source = importlib.util.find_spec(one.name).origin
        if "kernels.library import" in Path(source).read_text(encoding="utf-8"):
            importlib.import_module(one.name)
    return library.DECLARED


def prototype(name, arguments, result):
    """The C declaration that the declarations of a kernel in Python stand for."""
    sizes = dict.fromkeys(dim for one in arguments for dim, _ in one.shape or () if not dim.isdigit())
    words = [f"int64_t {size}" for size in sizes]
    for one in arguments:
        kind = C_TYPES[one.dtype]
        pointer = f"{'' if one.is_written else 'const '}{kind} *restrict"
        words.append(f"{kind if one.shape is None else pointer}")
    return f"{C_TYPES[result] if result else 'void'} {name}", words


def test_declarations_in_python_are_those_of_the_header(declared):
    found = {}
    for kind, name, text in re.findall(r"KERNEL (\w+) (\w+)\((.*?)\);", HEADER, re.DOTALL):
        found[name] = f"{kind} {name}", [" ".join(one.split()) for one in text.split(",")]
    del found["has_x86_64_v3"]
    assert found.keys() == declared.keys()
    for name, (arguments, result) in declared.items():
        head, words = prototype(name, arguments, result)
        assert head == found[name][0]
        sizes = len(words) - len(arguments)
        assert words[:sizes] == found[name][1][:sizes], name
        assert words[sizes:] == [re.sub(r" ?\w+$", "", one) for one in found[name][1][sizes:]], name


def test_records_in_python_are_the_structs_of_the_header(declared):
    assert declared
    found = {}
    for name, body in re.findall(r"\nstruct (\w+) \{(.*?)\n\};", HEADER, re.DOTALL):
        fields = re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL).split(";")[:-1]
        kinds = [re.fullmatch(r"\s*((?:const )?\w+) (.*)", one, re.DOTALL).groups() for one in fields]
        found[name] = [f"{kind} {one.strip()}" for kind, names in kinds for one in names.split(",")]
    expected = {}
    for name, (arguments, _) in records.RECORDS.items():
        sizes = dict.fromkeys(dim for one in arguments for dim, _ in one.shape or () if not dim.isdigit())
        arrays = [f"{'const ' * bool(one.shape)}{C_TYPES[one.dtype]} {'*' * bool(one.shape)}" for one in arguments]
        names = [one.text.split(":")[0] for one in arguments]
        expected[name] = [f"int64_t {size}" for size in sizes] + list(map("".join, zip(arrays, names, strict=True)))
    assert found == expected


def test_a_record_is_checked_when_it_is_made_and_made_anew_elsewhere():
    from map_helpers import basin

    from startrack.terrain.ground import surfaces

    ground = basin().ground
    expected, found = np.empty((2, 5))
    points = np.random.default_rng(1).uniform(-900.0, 900.0, (5, 2))
    surfaces(ground.record, points, expected)
    surfaces(pickle.loads(pickle.dumps(ground.record)), points, found)
    np.testing.assert_array_equal(found, expected)
    with pytest.raises(TypeError, match="heights"):
        assert replace(ground, heights=ground.heights.astype(np.float64)).record
    with pytest.raises(TypeError, match="levels"):
        assert replace(ground, levels=ground.levels[:0]).record
    for wrong in (ground, None, records.Record("table", *table_values())):
        with pytest.raises(TypeError, match="record ground is asked for"):
            surfaces(wrong, points, found)


def table_values():
    """Numbers of a table without cells."""
    return np.zeros((0, 3, 11), np.uint16), np.zeros(65536), np.zeros(3), np.zeros(3), 0, 0.0, 1.0, 1.0, 1.0


def test_each_function_of_the_header_is_documented():
    for text in re.split(r"\nKERNEL [^;]*;", HEADER)[:-1]:
        last = text.strip()
        assert last.endswith("*/") or not last, text  # of a group of functions the first one is


@pytest.mark.parametrize(
    "wrong",
    [
        lambda values, found: (values.astype(np.float32), found),
        lambda values, found: (values[::2], found),
        lambda values, found: (values.reshape(2, -1), found),
        lambda values, found: (values.tolist(), found),
        lambda values, found: (values, 1.0),
        lambda values, found: (values,),
        lambda values, found: (values, read_only(found)),
        lambda values, found: (values.byteswap().view(values.dtype.newbyteorder()), found),
        lambda values, found: (None, found),
    ],
)
def test_an_argument_that_is_not_as_declared_is_a_type_error(wrong):
    call = library.kernel("interpolate_circle", "values: float64[m]", "found: out float64[n]")
    values, found = np.arange(8.0), np.zeros(3)
    call(values, found)
    with pytest.raises(TypeError, match="interpolate_circle"):
        call(*wrong(values, found))


def read_only(array):
    view = array.view()
    view.flags.writeable = False
    return view


def test_shapes_that_do_not_go_together_are_a_type_error():
    call = library.kernel(
        "clear_disks", "mask: out bool[height, width]", "xy_px: int64[n, 2]", "radius_px: int64[n]",
        "large_px: float64", "touching: out bool[n]",
    )  # fmt: skip
    mask, xy, radius, touching = (
        np.ones((4, 5), bool),
        np.zeros((3, 2), np.int64),
        np.ones(3, np.int64),
        np.ones(3, bool),
    )
    call(mask, xy, radius, 0.5, touching)
    assert mask.sum() == 17
    for wrong in (
        (mask, xy[:2], radius, 0.5, touching),
        (mask, np.zeros((3, 3), np.int64), radius, 0.5, touching),
        (mask, xy, radius, 0.5, touching[:1]),
        (mask, xy, radius, "wide", touching),
        (mask, xy, radius, 0.5, touching[:0]),
    ):
        with pytest.raises((TypeError, ValueError)):
            call(*wrong)


def test_an_array_has_as_many_elements_as_are_added_to_its_size():
    call = library.kernel(
        "profiles_of", "xy_px: float64[n, 2]", "profiles: float64[steps + 1, wide]", "across: out float32[n, wide]",
        "down: out float32[n, wide]", "centre: out int64[n, 2]",
    )  # fmt: skip
    with pytest.raises(TypeError, match="profiles"):
        call(np.zeros((0, 2)), np.zeros((0, 5)), *np.zeros((2, 0, 5), np.float32), np.zeros((0, 2), np.int64))


def test_a_size_has_the_least_value_that_its_declaration_states():
    call = library.kernel(
        "pass_curve", "likelihood: float64[sectors, n >= 1]", "heights: float64[n]", "cells: float64[n]",
        "rough: float64", "jump: float64", "scratch: out float64[5, n]", "found: out float64[sectors]",
    )  # fmt: skip
    for n, is_enough in ((1, True), (0, False)):
        values = np.ones((2, n)), np.zeros(n), np.ones(n), 1.0, 0.1, np.empty((5, n)), np.empty(2)
        if is_enough:
            call(*values)
            continue
        with pytest.raises(TypeError, match="n >= 1"):
            call(*values)


@pytest.mark.parametrize("radius", [2**63, -(2**64), np.uint64(2**63)])
def test_a_number_beyond_64_bits_is_a_type_error(radius):
    call = library.kernel(
        "unfilter_grey_8", "rows: uint8[height, length + 1]", "pixel_bytes: int64", "scratch: out uint8[2, room]",
        "found: out float32[height, samples]",
    )  # fmt: skip
    room = np.zeros((0, 2), np.uint8), np.zeros((2, 2), np.uint8), np.zeros((0, 1), np.float32)
    call(room[0], 2**63 - 1, *room[1:])  # the greatest number is taken
    with pytest.raises(TypeError, match="pixel_bytes"):
        call(room[0], radius, *room[1:])


def test_what_the_processor_has_is_read_as_a_bool(monkeypatch):
    """A C function sets the lowest byte of its result alone: the others hold anything."""

    def has_x86_64_v3():
        return 0x5500 & (0xFF if getattr(has_x86_64_v3, "restype", ctypes.c_int) is ctypes.c_bool else 0xFFFF)

    monkeypatch.setattr(library, "_open", lambda level: SimpleNamespace(has_x86_64_v3=has_x86_64_v3))
    monkeypatch.delenv(library.VARIABLE, raising=False)
    assert library._load()[0] == "baseline"


def random_arguments(arguments, rng):
    """Arrays and numbers as declared, whose indices are those of elements that exist."""
    sizes: dict[str, int] = {}
    for one in arguments:
        for dim, _ in one.shape or ():
            sizes.setdefault(dim, int(dim) if dim.isdigit() else int(rng.integers(2, 9)))
    values = []
    for one in arguments:
        if one.shape is None:
            values.append(int(rng.integers(1, 3)) if one.dtype in ("int64", "bool") else float(rng.uniform(0.5, 2.0)))
            continue
        shape = tuple(sizes[dim] + more for dim, more in one.shape)
        if one.dtype.startswith("float"):
            values.append(rng.uniform(0.1, 2.0, shape).astype(one.dtype))
        else:
            values.append(rng.integers(0, 2, shape).astype(one.dtype))
    return values


# Kernels that trust more of their arguments than random ones can keep: a stamp lies in its image, cells are in order.
RANDOM = (
    "interpolate_circle", "filter_patches", "join_patches", "sum_sides", "score_shifts", "sum_cells", "clear_disks",
    "profiles_of", "are_same_handed", "count_alike", "rotation_between", "project_radial",
)  # fmt: skip


def bytes_of_all_kernels():
    """A hash of what kernels make of random arguments, and of scenes where they trust their arguments."""
    for package in ("evidence", "detection", "identification"):
        importlib.import_module(f"startrack.{package}")
    rng, key = np.random.default_rng(3), hashlib.sha256()
    for name in RANDOM:
        arguments, result = library.DECLARED[name]
        call = library.kernel(name, *(one.text for one in arguments), result=result)
        for _ in range(20):
            values = random_arguments(arguments, rng)
            values = [np.linspace(0.0, 1.0, 4097) if np.shape(v) == (4097,) else v for v in values]
            key.update(repr(call(*values)).encode())
            for one, value in zip(arguments, values, strict=True):
                if one.is_written:
                    key.update(value.tobytes())
    found = (
        photometry_of(rng), chain_of(rng), detection_of(rng), small_frames_of(rng), identification_of(rng),
        columns_of(rng), horizons_of(rng),
    )  # fmt: skip
    for array in (one for each in found for one in each):
        key.update(array.tobytes())
    return key.hexdigest()


def photometry_of(rng):
    """Fluxes and variances of stars beside an edge of the background."""
    from startrack.core.types import SmoothImage
    from startrack.evidence.photometry import Sources, measure

    image = rng.normal(100.0, 3.0, (96, 128)).astype(np.float32)
    image[:, 64:] += 40.0
    flat = SmoothImage.of(np.full(image.shape, 100.0, np.float32))
    noise = SmoothImage.of(np.full(image.shape, 3.0, np.float32))
    seen = SimpleNamespace(
        image_e=image, background=flat, noise=noise, dead=rng.random(image.shape) < 0.01, psf_sigma_px=1.1
    )
    xy = rng.uniform((40.0, 20.0), (96.0, 76.0), (300, 2))
    found = measure(
        seen, Sources(xy_px=xy, flux_e=rng.uniform(50.0, 900.0, 300), fraction_sigma=np.full(300, 0.1),
                      visible=rng.random(300)),
    )  # fmt: skip
    return found.flux_e, found.variance_e2, found.own_shot, found.neighbour_variance_e2, found.usable


def detection_of(rng):
    """Stars of a crowded frame with a gain, bias, saturated and masked pixels, and its residuals."""
    from startrack.core.types import Exposure
    from startrack.detection import Detector, damage, frame, streaks

    image = rng.poisson(100.0, (160, 203)).astype(np.float32)
    shape = np.exp(-0.5 * np.square(np.arange(-4, 5)) / 1.3)
    for row, column in rng.integers(0, (151, 194), (90, 2)):
        image[row : row + 9, column : column + 9] += np.rint(rng.uniform(40.0, 900.0) * np.outer(shape, shape))
    masked = np.zeros(image.shape, bool)
    masked[40:70, 90:101] = True
    filled, converted, saturated = damage.fill_masked(image, masked), np.empty_like(image), np.zeros_like(masked)
    frame._convert_counts(image, image, 1.7, rng.random(image.shape).astype(np.float32), 900.0, converted, saturated)
    sources = Detector()(Exposure(pixels_adu=filled, saturation_adu=900.0))
    assert len(sources.xy_px) > 20
    one = frame.Frame(filled, sources.background, sources.noise, None, frame.SourceNoise(1.0), found=converted)
    residuals = np.empty_like(image)
    streaks._fill_residuals(*one.light_and_noise, residuals)
    found = sources.xy_px, sources.covariance_px2, sources.flux_e, sources.snr, sources.saturated
    return (filled, converted, saturated, residuals, *found)


def small_frames_of(rng):
    """Numbers of sources in frames about as small as a stamp, each with a star beside a corner, or in the middle."""
    from startrack.core.types import Exposure, TooFewStars
    from startrack.detection import Detector

    sides, found = (1, 3, 7, 8, 9, 12, 24), []
    for height, width, at in [(h, w, at) for h in sides for w in sides for at in ((3, 3), (h // 2, w // 2))]:
        row, column = np.mgrid[:height, :width]
        distance = np.square(row - at[0]) + np.square(column - at[1])
        image = rng.poisson(100.0 + 5000.0 * np.exp(-0.5 * distance / 1.3)).astype(np.float32)
        try:
            found.append(len(Detector()(Exposure(pixels_adu=image, saturation_adu=4000.0)).xy_px))
        except TooFewStars:
            found.append(0)
    assert any(found)
    return (np.array(found),)


def chain_of(rng):
    """Profiles of random stars and sky light, and the likelihoods of skylines by them."""
    from startrack.core.types import MIDDLES_RAD, SECTORS, Evidence
    from startrack.localization import search_profiles
    from startrack.localization.likelihood import obstacle_chain, smooth_skyline
    from startrack.localization.likelihood.skyline_profiles import measure_moments, profiles_of

    stars, height = 3000, 0.02 * np.linspace(-1.0, 1.0, 13)
    rows = Evidence(
        azimuth_rad=np.concatenate([rng.uniform(0.0, 2 * np.pi, stars), np.repeat(MIDDLES_RAD, 13)]),
        elevation_rad=np.concatenate([rng.uniform(-0.3, 0.5, stars), np.tile(height, SECTORS)]),
        llr=np.concatenate([rng.normal(0.0, 4.0, stars), rng.normal(0.0, 9.0, 13 * SECTORS)]),
        extended_nats=np.concatenate([np.zeros(stars), rng.uniform(1.0, 90.0, 13 * SECTORS)]),
        edge_sigma_rad=np.concatenate([np.full(stars, 3e-4), np.full(13 * SECTORS, 2e-3)]),
    )
    soft, hard = (profiles_of(rows, rows.elevation_rad, sigma) for sigma in (np.full(SECTORS, 1e-3), np.zeros(SECTORS)))
    shifts = rng.normal(0.0, 0.01, (70, SECTORS))
    reach, moves = np.abs(shifts).max(axis=0), obstacle_chain.LIT_MOVES
    levels = obstacle_chain.Levels(reach, obstacle_chain.prepare_levels(soft, reach), hard, rng.random(SECTORS))
    likely = np.empty(len(shifts))
    obstacle_chain.chain_log_likelihoods(soft, levels, moves, shifts, 17, np.array([0, 3, 15]), likely)
    gains = obstacle_chain.gains_of_light(soft, shifts, rng.normal(0.0, 1e-3, shifts.shape))
    states = obstacle_chain.state_probabilities(obstacle_chain.emissions(soft, shifts[0], gains[0]), moves)
    lifted = np.empty(len(shifts))
    obstacle_chain.chain_log_likelihoods(soft, levels, moves, shifts, 17, np.array([0, 3, 15]), lifted, gains)
    clear = obstacle_chain.clear_emissions(hard, shifts, gains)
    search = search_profiles.SearchProfiles.of(rows)
    low = rng.uniform(-0.1, 0.1, (5, SECTORS))
    found = search.bound(low, low + 0.02), search.average(low[:, ::4], low[:, ::4] + 0.02), search.integral
    moments = measure_moments(soft)
    curve = smooth_skyline.list_free_logs(clear, 0.2 * np.linspace(-1.0, 1.0, len(clear)), np.array([1e-4, 1e-3]))
    assert np.isfinite(likely).all() and np.isfinite(curve).all()
    return (*soft, *hard, likely, gains, lifted, states, clear, *found, *moments, curve)


def identification_of(rng):
    """Stars and triangles near random rays, the attitude and the lens by their pairs, and which pairs agree."""
    from startrack.estimation.match import CandidatePairs, PhotometricScale
    from startrack.estimation.radial_fit import fit_radial, project_radial
    from startrack.identification.attitude_refinement import rotate_by_inliers
    from startrack.identification.star_grid import StarGrid, settle_rotation
    from startrack.identification.triangles import PatternIndex, sides_of_few, to_cube

    stars = rng.normal(size=(2000, 3))
    stars /= np.linalg.norm(stars, axis=1)[:, None]
    rays = stars[:40] + rng.normal(0.0, 3e-3, (40, 3))
    near = StarGrid(stars).neighbours(rays, 0.05)
    vertices, sides = sides_of_few(stars[:40], 20, 1.5)
    index = PatternIndex(stars, 1.5, vertices, sides, StarGrid(to_cube(sides, 1.5)))
    row, found = index.candidates(sides[:300] + rng.normal(0.0, 1e-3, (300, 3)), 5e-3, 3)
    cam, icrs = rays.take(near.ray, axis=0), stars.take(near.star, axis=0)
    R, hit = settle_rotation(cam, icrs, near.chord < 0.01, 1e-4)
    light = PhotometricScale(rng.normal(5.0, 1.0, 40), rng.random(40) < 0.1, 6.0, 5.0)
    v_mag, v_sigma = rng.normal(5.0, 1.0, len(near.ray)), np.full(len(near.ray), 0.3)
    pairs = CandidatePairs(near.ray, near.star, 200.0 * near.chord, v_mag, v_sigma, light)
    which = pairs.one_to_one_pairs
    agree, variance, refined, _ = rotate_by_inliers(
        which, near.ray, pairs.distance_px, np.full(40, 0.04), rays, icrs, np.eye(3)
    )
    lens, turned = np.array([np.log(500.0), 0.05, -0.05, 300.0, 250.0]), np.eye(3)
    view = stars[stars[:, 2] > 0.5]
    px, inside = project_radial(view, turned, lens, 1.0, 600, 500)
    free, known = np.array([True, True, False, True, True]), np.full(5, 0.1)
    fit_radial(px + rng.normal(0.0, 0.5, px.shape), view, 1.0, 1.0, 3, free, lens.copy(), known, turned, lens)
    assert len(which) > 9 and len(row) > 99 and agree.any() and np.isfinite([*lens, *refined.ravel()]).all()
    return (
        near.ray, near.star, near.chord, vertices, sides, row, found, R, hit, which, pairs.brightness_misfit, agree,
        variance, refined, px, inside, lens, turned,
    )  # fmt: skip


def columns_of(rng):
    """Log-likelihoods of steps of light, and messages around the compass."""
    from startrack.applications.horizon.posterior import add_steps, pass_messages

    n, total = 83, np.zeros((9, 83), np.float32)
    column, place = np.sort(rng.integers(0, 9, 30)), rng.uniform(-0.3, 1.0, 30)
    weight, passed = rng.random(30), rng.normal(size=30)
    add_steps(0.6, -0.1, 0.01, column, place, rng.uniform(1e-3, 0.1, 30), weight, passed, 0.3, np.empty(n), total)
    likelihood, landing = rng.uniform(0.1, 1.0, (3, 9, n)).astype(np.float32), rng.random(n)
    change = np.array([0.2, 0.7, 0.95]), np.array([0.5, 0.3, 0.15]), 0.05, landing / landing.sum()
    kinds = np.array([0.7, 0.1, 0.2]), 0.02
    return total, *(pass_messages(likelihood, forward, *change, *kinds) for forward in (True, False))


def horizons_of(rng):
    """Horizons, bounds and crests of a small map in air, and of a crater."""
    from map_helpers import basin

    from startrack.terrain import Cylinder, horizon_table
    from startrack.terrain.horizon_table import MIDDLES_RAD

    ground = replace(basin(), terrestrial_refraction_1=0.2, search_radius_m=20.0)
    points, azimuths = rng.uniform(-20.0, 20.0, (40, 2)), rng.uniform(0.0, 7.0, 40)
    traced = ground.horizons(points, azimuths)
    assert ground.table.square.across == 1
    with_table = ground.horizons(points, azimuths)
    narrow = ground.horizon_bounds_rad(points, np.float64(5.0), azimuths, 1e-3)
    point = ground.horizon_bounds_rad(points[:, None], np.full((40, 1), 0.5), azimuths, 1e-3)
    wide = [ground.horizon_bounds_rad(points[:, None], half, MIDDLES_RAD, 0.02) for half in (5.0, 200.0)]
    crests = ground.errors.expected_crests(points[0], azimuths)
    near = ground.near(points[0], 10.0, azimuths).horizon_rad(points[0] + rng.uniform(-9.0, 9.0, (5, 1, 2)), azimuths)
    most = ground.errors.most_sigma_rad(points, 3.0, azimuths, 0.05)
    memory, results = horizon_table.BoxMemory(16, 2, 40), np.empty((2, 40, 40))
    for _ in range(2):
        memory.fill(points, *results, lambda missing: rng.random((2, np.count_nonzero(missing), 40)))
    circle = Cylinder(diameter_m=900.0, depth_m=90.0).horizon_rad(points[:, None], azimuths)
    assert np.isfinite(traced[0]).all() and (narrow[0] <= narrow[1]).all()
    flat = [one for pair in wide for one in pair]
    values = ground.table.values, ground.ground_m(points), near, most, results, circle
    return *traced, *with_table, *narrow, *point, *flat, *crests, *values


def run_level(level, code, **more):
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}",
        "STARTRACK_KERNELS": level,
        **more,
    }
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)


def test_both_levels_give_the_same_bytes():
    if library.LEVEL != "v3":
        pytest.skip("this processor has one level only")
    one, other = (run_level(level, LEVEL_SCRIPT) for level in ("baseline", "v3"))
    assert one.returncode == other.returncode == 0, one.stderr + other.stderr
    assert len(one.stdout.strip()) == 64
    assert one.stdout == other.stdout


@pytest.mark.parametrize(("level", "words"), [("fast", "may be baseline, v3 or sanitized"), ("baseline", "")])
def test_the_variable_chooses_the_level(level, words):
    run = run_level(
        level, "from startrack.kernels.library import LEVEL, text_of; print(LEVEL, text_of('compiler_flags'))"
    )
    assert (run.returncode != 0) == bool(words)
    assert words in run.stderr
    assert words or (run.stdout.startswith("baseline ") and "-ffp-contract=off" in run.stdout)


def copy_kernels(folder):
    """A package of the loader and the C sources alone, without a library."""
    package = folder / "startrack" / "kernels"
    package.mkdir(parents=True)
    (folder / "startrack" / "__init__.py").touch()
    for path in build.FOLDER.iterdir():
        if path.is_file():
            (package / path.name).write_bytes(path.read_bytes())
    return package


def run_copy(folder, *words, **more):
    environment = {**os.environ, "PYTHONPATH": str(folder), **more}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment, cwd=folder)


LOAD = ("-c", "from startrack.kernels import library; print(library.LEVEL)")


@pytest.mark.slow
def test_a_changed_source_is_refused_with_the_command_that_helps(tmp_path):
    package = copy_kernels(tmp_path)
    for path in package.glob("*.c"):
        if path.name != "levels.c":  # that the loader calls; one source is soon compiled
            path.unlink()
    missing = run_copy(tmp_path, *LOAD)
    assert missing.returncode == 1
    assert "-m startrack.kernels.build" in missing.stderr
    assert run_copy(tmp_path, "-m", "startrack.kernels.build").returncode == 0
    assert run_copy(tmp_path, *LOAD).stdout.strip() == library.LEVEL
    first = set((package / "compiled").iterdir())
    with (package / "levels.c").open("a") as file:
        file.write("\n/* changed */\n")
    assert "does not exist for these C sources" in run_copy(tmp_path, *LOAD).stderr
    assert run_copy(tmp_path, "-m", "startrack.kernels.build").returncode == 0
    assert run_copy(tmp_path, *LOAD).returncode == 0
    assert not first & set((package / "compiled").iterdir())


@pytest.mark.slow
def test_a_failed_build_says_what_was_tried_and_what_helps(tmp_path):
    package = copy_kernels(tmp_path)
    nothing = tmp_path / "empty"
    nothing.mkdir()
    hidden = {"PATH": str(nothing), "CC": "no-such-compiler -O9"}
    code = (
        "import importlib.util as u; f = u.find_spec; u.find_spec = lambda n, *a: None if n == 'ziglang' else f(n, *a)"
    )
    run = run_copy(
        tmp_path, "-c", f"{code}; from startrack.kernels.build import main; raise SystemExit(main())", **hidden
    )
    assert run.returncode == 1
    for words in (
        "no-such-compiler -O9: No such file",
        "cc: No such file",
        "ziglang: not installed",
        "apt-get install gcc",
    ):
        assert words in run.stderr
    (package / "core.c").write_text("this is no C\n")
    run = run_copy(tmp_path, "-m", "startrack.kernels.build")
    assert run.returncode == 1
    assert "error" in run.stderr and "apt-get" in run.stderr
    assert list((package / "compiled").iterdir()) == []


def has(command):
    return subprocess.run(["which", command], capture_output=True).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_the_sources_compile_without_a_warning(tmp_path, compiler):
    if not has(compiler):
        pytest.skip(f"there is no {compiler} on this machine")
    strict = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only"]
    for source in build.FOLDER.glob("*.c"):
        run = subprocess.run([compiler, *strict, str(source)], capture_output=True, text=True)
        assert run.returncode == 0, run.stderr


@pytest.fixture(scope="module")
def run_sanitized(tmp_path_factory):
    """Runs code with a library of AddressSanitizer and UndefinedBehaviorSanitizer. Skips without a compiler of both."""
    folder = tmp_path_factory.mktemp("sanitized")
    compiler = next((one for one in ("gcc", "clang") if has(one)), None)
    if compiler is None:
        pytest.skip("neither gcc nor clang is installed, which have the sanitizers")
    name = "libasan.so" if compiler == "gcc" else "libclang_rt.asan-x86_64.so"
    found = subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True).stdout.strip()
    if not Path(found).is_absolute() or Path(found).read_bytes()[:4] != b"\x7fELF":
        pytest.skip(f"{compiler} has no AddressSanitizer on this machine")
    copy_kernels(folder)
    made = run_copy(folder, "-m", "startrack.kernels.build", "sanitized", CC=compiler)
    assert made.returncode == 0, made.stderr
    place = str(Path(made.stdout.strip()).parent)
    begin = f"import startrack.kernels.build as b; from pathlib import Path; b.COMPILED = Path({place!r}); "
    checks = {
        "LD_PRELOAD": f"{found} libstdc++.so.6",  # whose exceptions other libraries throw
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }

    def run(code):
        done = run_level("sanitized", begin + code, **checks)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-9000:]
        return done.stdout

    return run


@pytest.mark.slow
def test_no_kernel_reads_or_writes_beside_its_arrays(run_sanitized):
    """The random arguments again, and the comparisons with slow references."""
    assert run_sanitized(LEVEL_SCRIPT) == run_level("baseline", LEVEL_SCRIPT).stdout
    references = str(ROOT / "tests" / "test_kernels_references.py")
    run_sanitized(f"import pytest; raise SystemExit(pytest.main(['-q', '-p', 'no:cacheprovider', {references!r}]))")


@pytest.mark.slow
def test_no_mutated_file_makes_a_kernel_read_or_write_beside_its_arrays(run_sanitized, tmp_path):
    """2,000 files, of which some are read; an outcome that no reader may have is another test's matter."""
    assert "2000 files" in run_sanitized(
        f"from fuzz import targets; folder = Path({str(tmp_path)!r}); targets.prepare(folder); kinds = "
        "[*targets.READERS]; [targets.read(kinds[i % len(kinds)], *targets.mutated(kinds[i % len(kinds)], 3, i), "
        "folder) for i in range(2000)]; print('2000 files')"
    )


@pytest.mark.slow
def test_no_kernel_uses_memory_that_was_not_written():
    """New memory is filled with other bytes by the C library: the results are the same."""
    if sys.platform != "linux":
        pytest.skip("MALLOC_PERTURB_ is a variable of glibc")
    plain, poisoned = (run_level("baseline", LEVEL_SCRIPT, MALLOC_PERTURB_=fill) for fill in ("0", "165"))
    assert len(plain.stdout.strip()) == 64
    assert plain.stdout == poisoned.stdout


@pytest.mark.slow
@pytest.mark.parametrize("target", ["aarch64-freestanding", "riscv64-freestanding", "wasm32-freestanding"])
def test_the_sources_compile_for_a_rover_and_for_a_browser(tmp_path, target, zig_site):
    """They need no operating system: `math.h` and a few integers are all."""
    zig = [*build.ZIG, "-target", target, "-ffreestanding", *build.FLAGS]
    (tmp_path / "math.h").write_text(MATH_H)
    own = dict.fromkeys(("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"), str(tmp_path / "zig"))
    own["PYTHONPATH"] = str(zig_site)
    for source in sorted(build.FOLDER.glob("*.c")):
        run = subprocess.run(
            [*zig, "-I", str(tmp_path), "-c", str(source), "-o", str(tmp_path / f"{source.stem}.o")],
            capture_output=True, text=True, env={**os.environ, **own},
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
    assert len(list(tmp_path.glob("*.o"))) == len(list(build.FOLDER.glob("*.c")))


# What the kernels use of math.h, as a `libm` without an operating system declares it.
MATH_H = """
#define INFINITY __builtin_inff()
#define NAN __builtin_nanf("")
#define isnan(x) __builtin_isnan(x)
#define isfinite(x) __builtin_isfinite(x)
#define signbit(x) __builtin_signbit(x)
double exp(double), log(double), log10(double), sqrt(double), fabs(double), floor(double), ceil(double), rint(double);
double fmod(double, double), erf(double), copysign(double, double);
double sin(double), cos(double), tan(double), atan(double), atan2(double, double);
float sqrtf(float), fabsf(float);
"""


def test_the_loader_is_small():
    assert len(inspect.getsource(library).splitlines()) <= 135


def test_kernels_keep_no_state():
    """No global variable that is written to: only constants may stand at the top of a C source."""
    for path in build.FOLDER.glob("*.c"):
        text = re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
        assert re.findall(r"^(?=\w)(?!.*\bconst\b)[^(\n]*=.*", text, re.MULTILINE) == []
        assert re.findall(r"\b(?:malloc|calloc|realloc|free|printf|fopen)\(|Python\.h", text) == []
