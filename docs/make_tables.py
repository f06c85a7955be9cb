"""Writes what CONTRIBUTING.md, docs/formats.md and docs/track.md show of the code, and two pages of the results.

    python docs/make_tables.py

Each table stands between `<!-- table NAME -->` and `<!-- end -->`; the text around it is written by hand.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # of the module beside this one

from measured_figures import figure_tables, question_table

import startrack
from startrack.applications.prediction import CELL_QUANTITIES, PATH_QUANTITIES
from startrack.applications.tracking import FRAME_QUANTITIES
from startrack.core.errors import Reason
from startrack.output import QUANTITIES, markdown_table

NAMES = ("../CONTRIBUTING.md", "formats.md", "track.md", "how-good.md", "results.md")
PAGES = [Path(__file__).parent / name for name in NAMES]
PACKAGE = Path(startrack.__file__).parent


def reason_table() -> str:
    """Reasons with their exit codes and meanings."""
    rows = [f"| `{one.value}` | {one.exit_code} | {one.meaning} |" for one in Reason]
    return "\n".join(["| reason | exit code | meaning |", "| --- | --- | --- |", *rows])


def package_list() -> str:
    """Packages of `startrack/`, each above all that it imports, with the first sentence of its docstring."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}
    imports: dict[str, set[str]] = {}
    for path, tree in trees.items():
        name = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        imports.setdefault(name, set()).update(m.split(".")[1] for m in modules if m.startswith("startrack."))
    names = [name for name in imports if not name.startswith("__")]

    def height(name: str) -> int:
        return 1 + max((height(other) for other in imports[name] - {name}), default=0)

    def sentence(name: str) -> str:
        path = PACKAGE / f"{name}.py"
        text = ast.get_docstring(trees[path if path in trees else PACKAGE / name / "__init__.py"]) or ""
        return text.partition("\n\n")[0].replace("\n", " ").rstrip(".")

    rows = sorted(names, key=lambda name: (-height(name), name))
    return "\n".join(["```text", *(f"{name:<16}{sentence(name)}" for name in rows), "```"])


def page_with_tables(text: str) -> str:
    """The page `text` with its tables as the code has them."""
    tables = {
        "packages": package_list(),
        "figures": figure_tables(),
        "questions": question_table(),
        "quantities": markdown_table(QUANTITIES, "key"),
        "reasons": reason_table(),
        "track": markdown_table(FRAME_QUANTITIES, "column"),
        "prediction": markdown_table((*CELL_QUANTITIES, *PATH_QUANTITIES), "band, column"),
    }
    return re.sub(
        r"(<!-- table (\w+) -->\n).*?(\n?<!-- end -->)",
        lambda found: found[1] + tables[found[2]] + found[3],
        text,
        flags=re.DOTALL,
    )


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(page_with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
