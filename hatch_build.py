"""hatchling's hook: compiles the kernels beside the sources and puts them into the wheel.

Beside the sources they serve an editable installation, and Python that is started in the folder of the sources.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags

PLACE = "startrack/kernels/compiled"


def load_build(root: str) -> ModuleType:
    """startrack/kernels/build.py, without startrack, whose packages are not installed yet."""
    spec = importlib.util.spec_from_file_location("startrack_kernels_build", Path(root, "startrack/kernels/build.py"))
    assert spec is not None and spec.loader is not None
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class CustomBuildHook(BuildHookInterface[Any]):
    """Compiles with $CC or the system's compiler, else with that of the package ziglang."""

    scratch: tempfile.TemporaryDirectory[str] | None = None

    def dependencies(self) -> list[str]:
        """ziglang, where no other compiler works, or for another system."""
        build = load_build(self.root)
        try:
            if os.environ.get(build.VARIABLE):
                return [build.ZIGLANG]
            build.find_compiler(with_zig=False)
        except build.BuildFailed:
            return [build.ZIGLANG]
        return []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and put the libraries into a wheel for a system and any Python. Ends with a message.

        The system is this one, or the one that the variable STARTRACK_PLATFORM names.
        """
        build = load_build(self.root)
        tag = os.environ.get(build.VARIABLE)
        if tag and tag not in build.TARGETS:
            sys.exit(f"{build.VARIABLE} is {tag!r}; it may be one of: {', '.join(build.TARGETS)}")
        try:
            if version == "editable":
                build.build()
                return
            folder = build.COMPILED
            if tag or not os.access(build.FOLDER, os.W_OK):
                self.scratch = tempfile.TemporaryDirectory()
                folder = Path(self.scratch.name)
            made = build.build(folder, target=build.TARGETS[tag] if tag else None)
        except build.BuildFailed as cause:
            sys.exit(f"startrack cannot be installed. {cause}")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{tag or _platform()}"
        build_data["force_include"].update({str(path): f"{PLACE}/{path.name}" for path in made})

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the folder in which the libraries were made."""
        if self.scratch is not None:
            self.scratch.cleanup()


def _platform() -> str:
    """This system in the words of wheels' names; a library is for no other Linux than one like this."""
    tags = (tag for tag in platform_tags() if not tag.startswith(("manylinux", "musllinux")))
    return next(tags)
