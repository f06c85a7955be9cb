"""What the readers and writers of other programs' camera files share: their parts, keys and numbers, YAML and XML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from startrack.camera.camera import Camera
from startrack.camera.lenses import MAX_COEFFICIENTS, KannalaBrandt, Pinhole

MAX_YAML_CHARS = 2**18  # the loader takes 3 s for 2^20
Coefficients = tuple[float, ...] | None  # of a fisheye; None of a pinhole


class Part(NamedTuple):
    """One camera of a file: its name there, the size of its pictures as text, and its content."""

    name: str
    size: str
    content: Any


def matrix_of(camera: Camera) -> list[float]:
    """Camera matrix K (9,), row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def keys_of(
    size_px: Sequence[Any], focal_px: tuple[float, float], centre_px: tuple[float, float], k: Coefficients
) -> dict[str, Any]:
    """The keys of a camera file."""
    keys = {"size_px": tuple(map(int, size_px)), "focal_px": focal_px, "centre_px": centre_px}
    if k is None:
        return {**keys, "model": Pinhole.model}
    return {**keys, "model": KannalaBrandt.model, **({"k": k} if any(k) else {})}


def read_numbers(values: Any, count: int, key: str) -> list[float]:
    """`count` finite numbers. Raises ValueError naming the key."""
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise ValueError(f"{key} must be {count} numbers")
    numbers = [float(v) for v in values]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{key} must be {count} finite numbers")
    return numbers


def read_distortion(
    model: str, coefficients: Any, fisheyes: tuple[str, ...], pinholes: tuple[str, ...]
) -> tuple[float, ...] | None:
    """k1 to k4 of a fisheye `model`, None for a pinhole without distortion. Raises ValueError for any other."""
    if model in fisheyes:
        return tuple(read_numbers(coefficients, MAX_COEFFICIENTS, "distortion coefficients"))
    if model not in pinholes:
        raise ValueError(f"the distortion model {model!r} has no counterpart")
    if any(float(c) for c in coefficients):
        raise ValueError(f"distortion {model} with coefficients other than 0 has no counterpart; fisheye models have")
    return None


def read_yaml(text: str) -> list[dict[str, Any]]:
    """The mappings of a YAML file, one of each document that is not empty. Raises ValueError if there is none."""
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # a few of them are a file of any size
                raise yaml.YAMLError("aliases (*name) are not read")
            return super().compose_node(parent, index)

    if len(text) > MAX_YAML_CHARS:
        raise ValueError(f"more than {MAX_YAML_CHARS // 2**10} KiB")
    try:
        found = [value for value in yaml.load_all(text, Loader) if value is not None]
    except (yaml.YAMLError, RecursionError) as cause:
        raise ValueError(str(cause)) from cause
    if not found or not all(isinstance(value, dict) for value in found):
        raise ValueError("no keys")
    return found


def yaml_list(values: Sequence[float]) -> str:
    """A list in one line of YAML, numbers to the last digit."""
    import yaml

    return str(yaml.safe_dump([float(v) for v in values], default_flow_style=True, width=math.inf)).strip()


def read_xml(text: str) -> dict[str, Any]:
    """The entries of a FileStorage in XML: texts, and matrices as dictionaries. Raises ValueError."""
    from xml.etree import ElementTree

    try:
        entries = ElementTree.fromstring(text)
    except ElementTree.ParseError as cause:
        raise ValueError(str(cause)) from cause
    found: dict[str, Any] = {}
    for entry in entries:
        parts = {part.tag: (part.text or "").strip() for part in entry}
        found[entry.tag] = {**parts, "data": parts.get("data", "").split()} if parts else (entry.text or "").strip()
    return found
