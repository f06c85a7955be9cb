"""Import rules: strictly downward, no imports between stages of one layer; and fast start-up."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest

import startrack

ROOT = Path(startrack.__file__).parent

LAYERS = (  # lowest first; a package imports from lower layers only
    {"kernels"},
    {"core"},
    {"frames"},
    {"psf", "catalog", "camera", "terrain", "exposure"},
    {"estimation"},
    {"rendering", "detection", "identification", "evidence", "localization"},
    {"chain"},
    {"simulation", "output"},
    {"applications"},
    {"api"},
    {"cli"},
)
ALLOWED: set[tuple[str, str]] = set()  # exceptions: (package, package of the same or a higher layer)
HEAVY = (
    "astropy", "cv2", "lunarsky", "matplotlib", "PIL", "rich", "rosbags", "scipy", "skyfield", "spiceypy",
    "tifffile",
)  # fmt: skip
CV2_ROOMS = {"applications", "detection", "evidence", "exposure", "output"}  # image processing at the top


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


@lru_cache
def rooms() -> set[str]:
    return {room_of(path) for path in ROOT.rglob("*.py")} - {"__init__", "__main__", "data", "__pycache__"}


def layer(room: str) -> int:
    return next(k for k, names in enumerate(LAYERS) if room in names)


def imported_names(tree: ast.AST, package: tuple[str, ...]) -> Iterator[str]:
    """Dotted names of all modules that a source imports, wherever it does; `package` resolves relative ones."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield from (f"{module}.{alias.name}" for alias in node.names)


@lru_cache
def edges() -> list[tuple[Path, str, str]]:
    """(file, its package, imported package) for every import between packages."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        if path in (ROOT / "__init__.py", ROOT / "__main__.py"):  # the entry points
            continue
        package = ("startrack", *path.relative_to(ROOT).parent.parts)
        for name in imported_names(ast.parse(path.read_text(encoding="utf-8")), package):
            parts = name.split(".")
            if parts[0] == "startrack" and len(parts) > 1 and parts[1] in rooms() and parts[1] != room_of(path):
                found.append((path, room_of(path), parts[1]))
    return found


def violations(found: list[tuple[Path, str, str]]) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}: {room} imports {other}"
        for path, room, other in found
        if layer(other) >= layer(room) and (room, other) not in ALLOWED
    ]


def test_every_room_has_its_layer():
    placed = [room for names in LAYERS for room in names]
    assert sorted(placed) == sorted(set(placed))
    assert rooms() <= set(placed), f"give a layer to {rooms() - set(placed)}"
    assert set(placed) <= rooms(), f"no such room: {set(placed) - rooms()}"


def test_imports_run_strictly_downward():
    found = edges()
    assert len(found) > 100  # the sources were read
    assert violations(found) == []


def test_each_exception_is_still_needed():
    used = {(room, other) for _, room, other in edges()}
    assert used >= ALLOWED


@pytest.mark.parametrize(
    ("source", "room", "other"),
    [
        ("from startrack.output import text", "detection", "output"),
        ("import startrack.identification.index", "detection", "identification"),
        ("def f():\n    from startrack import chain", "camera", "chain"),
        ("from ..cli import common", "evidence", "cli"),
    ],
)
def test_the_check_sees_every_way_to_import(source, room, other):
    names = [name.split(".")[1] for name in imported_names(ast.parse(source), ("startrack", room))]
    assert names == [other]
    assert violations([(ROOT / room / "x.py", room, other)]) != []


FOLDERS = {"core", "estimation", "applications", "kernels"}  # of modules or packages that stand for themselves


def owner_of(name: str) -> str:
    """The package whose face a dotted module belongs to: `startrack.terrain`, `startrack.applications.tracking`."""
    parts = name.split(".")
    return ".".join(parts[: 3 if parts[1] in FOLDERS else 2])


def name_of(path: Path) -> str:
    return ".".join(("startrack", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")


def sources() -> dict[Path, ast.Module]:
    """Files of the package and their trees, but for the entry points."""
    paths = [path for path in sorted(ROOT.rglob("*.py")) if path not in (ROOT / "__init__.py", ROOT / "__main__.py")]
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def test_packages_are_imported_by_their_faces():
    past = [
        f"{path.relative_to(ROOT)}: {node.module}"
        for path, tree in sources().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").startswith("startrack.")
        and node.module != owner_of(node.module)
        and not f"{name_of(path)}.".startswith(f"{owner_of(node.module)}.")
    ]
    assert past == []


def test_no_file_of_the_package_imports_a_name_of_the_top_face():
    named = [(path, name.split(".")) for path, tree in sources().items() for name in imported_names(tree, ())]
    assert [path for path, parts in named if parts[0] == "startrack" and not {*parts[1:2]} <= rooms()] == []


def test_no_private_name_is_imported():
    names = [(path, name) for path, tree in sources().items() for name in imported_names(tree, ())]
    private = re.compile(r"startrack\..*\._[a-z]")
    assert [f"{path.relative_to(ROOT)}: {name}" for path, name in names if private.match(name)] == []


def test_no_modules_import_each_other():
    """Nor do longer circles exist. Imports for type checking and within functions do not count."""
    trees = {name_of(path): tree for path, tree in sources().items()}
    left = {}
    for name, tree in trees.items():
        now = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], type_ignores=[])
        modules = ([m for m in trees if f"{one}.".startswith(f"{m}.")] for one in imported_names(now, ()))
        left[name] = {max(found, key=len) for found in modules if found} - {name}
    while free := [name for name, others in left.items() if not others & left.keys()]:
        left = {name: others for name, others in left.items() if name not in free}
    assert left == {}


def is_number(node: ast.AST) -> bool:
    parts = ast.UnaryOp | ast.BinOp | ast.Tuple | ast.operator | ast.unaryop | ast.expr_context
    return all(isinstance(one, parts) or type(getattr(one, "value", None)) in (int, float) for one in ast.walk(node))


def test_no_two_files_have_a_number_of_the_same_name():
    found: dict[str, set[str]] = {}
    for path, tree in sources().items():
        for node in tree.body:
            if isinstance(node, ast.Assign) and is_number(node.value):
                for one in ast.walk(ast.Module(node.targets, type_ignores=[])):
                    if isinstance(one, ast.Name):
                        found.setdefault(one.id, set()).add(str(path.relative_to(ROOT)))
    assert len(found) > 500  # the sources were read
    assert {name: files for name, files in found.items() if len(files) > 1} == {}


def test_nothing_asks_of_which_class_a_terrain_a_lens_or_a_localizer_is():
    asked = re.compile(r"isinstance\([^()]*(Cylinder|HeightMap|Terrain|Posterior|Localizer|\bLens|KannalaBrandt)")
    assert [path for path in sources() if asked.search(path.read_text(encoding="utf-8"))] == []


def test_the_package_has_few_entries():
    assert len([path for path in ROOT.iterdir() if path.name not in ("__pycache__", "data")]) <= 23


def test_only_the_renderer_reads_the_truth():
    """The truth beside a rendered image is for tests and scorers: no stage reads it."""
    truth = re.compile(r"\bTruth\b|\.truth\b")
    readers = {room_of(path) for path in ROOT.rglob("*.py") if truth.search(path.read_text(encoding="utf-8"))}
    assert readers <= {"rendering", "cli", "api"}


def top_level_imports(path: Path) -> set[str]:
    """Modules that are imported with the file (not within a function or under TYPE_CHECKING)."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    now = ast.Module([node for node in body if isinstance(node, ast.Import | ast.ImportFrom)], type_ignores=[])
    return {name.split(".")[0] for name in imported_names(now, ("startrack", *path.relative_to(ROOT).parent.parts))}


def test_heavy_modules_are_imported_where_they_are_used():
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in ROOT.rglob("*.py")
        for name in top_level_imports(path) & set(HEAVY)
        if not (name == "cv2" and room_of(path) in CV2_ROOMS)
    }
    assert found == set()


LOADED = "import sys, json; print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"


def loaded_after(code: str, names: str = LOADED) -> set[str]:
    run = subprocess.run([sys.executable, "-c", f"{code}\n{names}"], capture_output=True, text=True, check=True)
    return set(json.loads(run.stdout.splitlines()[-1]))


def test_help_is_printed_without_numpy_or_any_heavy_module():
    code = "from startrack.cli.main import main\ntry:\n    main(['locate', '--help'])\nexcept SystemExit:\n    pass"
    loaded = loaded_after(code)
    assert "startrack" in loaded
    assert loaded & {*HEAVY, "numpy"} == set()


def test_the_library_is_imported_without_the_slow_ones():
    """The pipeline computes with numpy, scipy and cv2; ephemerides, FITS, plots and progress bars can wait."""
    loaded = loaded_after("import startrack.chain.pipeline, startrack.output")
    assert loaded & (set(HEAVY) - {"cv2", "scipy"}) == set()


def test_an_image_is_located_without_what_takes_long_to_load(tmp_path):
    """All files of a result are written without astropy, and with those parts of scipy that no other part needs."""
    image = Path(__file__).parent.parent / "sample_images" / "near-wall.png"
    code = f"from startrack.cli.main import main\nmain(['locate', {str(image)!r}, '-q', '-D', {str(tmp_path)!r}])"
    loaded = loaded_after(code, "import sys, json; print(json.dumps(sorted(sys.modules)))")
    assert (tmp_path / "near-wall.corr").is_file()
    assert loaded & (set(HEAVY) - {"cv2", "scipy", "PIL", "spiceypy"}) == set()
    assert loaded & {"scipy.optimize", "scipy.ndimage", "scipy.interpolate", "scipy.stats", "urllib.request"} == set()
