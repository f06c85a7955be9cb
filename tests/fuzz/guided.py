"""The readers under atheris: the code that an input reaches decides which inputs are changed further.

atheris (https://pypi.org/project/atheris) is no dependency of the project. It calls the same check as the campaigns.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from . import targets
from .campaign import HANG_S, MEMORY_BYTES
from .seeds import seeds


def run_guided(kinds: list[str], runs: int, seed: int, failures: Path) -> int:
    """Run atheris on each kind, `runs` inputs in all, in a process each; 0 without a failure."""
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("--guided needs atheris: pip install atheris", file=sys.stderr)
        return 2
    codes = []
    failures.mkdir(parents=True, exist_ok=True)
    for kind in kinds:
        with tempfile.TemporaryDirectory(prefix="startrack-fuzz-") as corpus:
            for number, data in enumerate(seeds()[kind]):
                (Path(corpus) / f"{number}").write_bytes(data)
            options = [
                f"-runs={runs // len(kinds)}", f"-seed={seed}", f"-timeout={HANG_S:.0f}", "-max_len=40000",
                f"-rss_limit_mb={MEMORY_BYTES // 2**20 + 1024}", f"-artifact_prefix={failures}/{kind}-", "-verbosity=1",
            ]  # fmt: skip
            words = [sys.executable, "-m", f"{__package__}.guided", kind, corpus, *options]
            codes.append(subprocess.run(words, check=False).returncode)
            print(f"{kind}: {'no failure' if codes[-1] == 0 else f'failed, input in {failures}'}")
    return int(any(codes))


def fuzz(kind: str, options: list[str]) -> None:
    """Give one kind of input to atheris; ends the process."""
    import atheris

    with tempfile.TemporaryDirectory(prefix="startrack-fuzz-") as name:
        folder = Path(name)
        with atheris.instrument_imports(include=["startrack", "tifffile", "astropy.io.fits", "tomllib", "PIL"]):
            targets.prepare(folder)

        def check(data: bytes) -> None:
            targets.read(kind, data, len(data) % len(seeds()[kind]), folder)

        atheris.Setup([sys.argv[0], *options], check)
        atheris.Fuzz()


if __name__ == "__main__":
    fuzz(sys.argv[1], sys.argv[2:])
