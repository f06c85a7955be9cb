"""Wheel and source distribution, built, installed and run in clean environments of every Python on this machine.

    python benchmarks/installation.py [--pythons PYTHON ...] [--lock FILE]

A Python is any of 3.11 and later on the PATH or among pyenv's versions. Each gets the wheel with its required packages
in an environment of its own, and then the smoke test: `startrack doctor`, a picture located from another folder, and
the type marker. The first also installs from the source distribution. `--lock` writes the versions that the first one
installed, for `pip install -r`. The sizes are those of all files in site-packages that the
installation made.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from _results import table, write_section

ROOT = Path(__file__).parent.parent
IMAGE = ROOT / "sample_images/near-wall.png"
OLDEST_MINOR, NEWEST_MINOR = 11, 30
BUILD = "import hatchling.build as b, sys; print(b.build_wheel(sys.argv[1])); print(b.build_sdist(sys.argv[1]))"
MARKER = "import importlib.resources as r; assert r.files('startrack').joinpath('py.typed').is_file()"
LOCK_HEAD = """# The versions that a clean installation of the core got on Python {python}, Linux x86_64:
#     pip install -r requirements.lock && pip install --no-deps .
# Made by: python benchmarks/installation.py --lock requirements.lock
"""


def main() -> None:
    """Run the check; write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="+", type=Path, default=list(found_pythons()))
    parser.add_argument("--lock", type=Path)
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = str(Path(folder) / "cache")
        wheel, sdist = build(Path(folder))
        for k, python in enumerate(args.pythons):
            for archive in [wheel, sdist][: 2 if k == 0 else 1]:
                rows.append(check(python, archive, Path(folder) / f"venv-{k}-{archive.suffix[1:]}"))
                print(*rows[-1], sep="  ", flush=True)
            if args.lock is not None and k == 0:
                args.lock.write_text(locked(Path(folder) / "venv-0-whl", rows[0][0]), encoding="utf-8")
        head = f"Wheel {megabytes(wheel.stat().st_size)}, source distribution {megabytes(sdist.stat().st_size)}.\n\n"
    columns = ["Python", "from", "installed, MB", "largest packages, MB", "doctor", "error of the sample's position, m"]
    write_section("Installation", "python benchmarks/installation.py", (), head + table(columns, rows))


def found_pythons() -> Iterator[Path]:
    """One interpreter of each version from 3.11 on, the oldest first."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for minor in range(OLDEST_MINOR, NEWEST_MINOR):
        on_path = shutil.which(f"python3.{minor}")
        of_pyenv = sorted(pyenv.glob(f"3.{minor}.*/bin/python3"))
        if of_pyenv or on_path:
            yield of_pyenv[-1] if of_pyenv else Path(str(on_path))


def build(folder: Path) -> tuple[Path, Path]:
    """The wheel and the source distribution in the folder."""
    lines = output(sys.executable, "-c", BUILD, str(folder), cwd=ROOT).splitlines()
    return folder / lines[-2], folder / lines[-1]


def check(python: Path, archive: Path, folder: Path) -> list[str]:
    """Install the archive in a new environment in the folder, run the smoke test; a row of the table."""
    output(str(python), "-m", "venv", str(folder))
    own = folder / "bin/python"
    before = site_sizes(own)
    output(str(own), "-m", "pip", "install", "-q", str(archive))
    sizes = {name: size - before.get(name, 0) for name, size in site_sizes(own).items()}
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    output(str(own), "-c", MARKER, cwd=elsewhere)
    doctor = output(str(folder / "bin/startrack"), "doctor", cwd=elsewhere)
    wrong = [line for line in doctor.splitlines()[1:] if not line.startswith("  ok ")]
    found = output(str(folder / "bin/startrack"), "locate", str(IMAGE), "--json", "--no-plots", cwd=elsewhere)
    position = json.loads(found)["position"]
    truth_m = json.loads(IMAGE.with_suffix(".truth.json").read_text())["position_enu_m"]
    error_m = ((position["east_m"] - truth_m[0]) ** 2 + (position["north_m"] - truth_m[1]) ** 2) ** 0.5
    largest = sorted(sizes, key=lambda name: -sizes[name])[:5]
    version = output(str(own), "-c", "import platform; print(platform.python_version())").strip()
    kind = "wheel" if archive.suffix == ".whl" else "source"
    shown = ", ".join(f"{name} {sizes[name] / 1e6:.0f}" for name in largest)
    return [version, kind, f"{sum(sizes.values()) / 1e6:.0f}", shown, "; ".join(wrong) or "ok", f"{error_m:.1f}"]


def site_sizes(python: Path) -> dict[str, int]:
    """Bytes on the disk of each folder and file in the environment's site-packages."""
    site = Path(output(str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    return {
        one.name: sum(f.stat().st_size for f in ([one] if one.is_file() else one.rglob("*")) if f.is_file())
        for one in site.iterdir()
    }


def locked(folder: Path, python: str) -> str:
    """The lock file of the environment in the folder."""
    frozen = output(str(folder / "bin/python"), "-m", "pip", "freeze", "--exclude", "startrack")
    return LOCK_HEAD.format(python=".".join(python.split(".")[:2])) + frozen


def megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"


def output(*words: str, cwd: Path | None = None) -> str:
    """Standard output of a command; its messages in an error if it fails."""
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, env=clean)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(words)}\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    main()
