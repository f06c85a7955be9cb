"""The sources that a benchmark depends on, and a hash of them that comments and docstrings do not change.

They are the files that its imports reach, those inside functions included, in benchmarks/, tests/ and startrack/, with
the C sources beside them, and the files of benchmarks/ that it names. Of a package that gathers names only the modules
of the names in use count; where a module's name is made at run time, all of that folder count. A benchmark that starts
processes runs commands: it depends on all of startrack/. Data files (catalogues, terrains, cameras) are no part of it.
"""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
EVERYTHING = "*"  # instead of a name
STORING = ("_results.py", "_sources.py")  # how results are stored changes no figure


@cache
def hash_of(benchmark: Path) -> str:
    """Hash of all sources that the file of a benchmark depends on."""
    digest = hashlib.sha256()
    for path in sorted(sources_of(benchmark)):
        digest.update(f"{path.relative_to(ROOT).as_posix()}\n{code_of(path)}\n".encode())
    return digest.hexdigest()[:16]


@cache
def sources_of(benchmark: Path) -> frozenset[Path]:
    """Files that the file of a benchmark depends on, with itself."""
    found, todo, seen = set[Path](), [(benchmark, EVERYTHING)], set[tuple[Path, str]]()
    while todo:
        path, name = todo.pop()
        if (path, name) in seen or path.name in STORING:
            continue
        seen.add((path, name))
        found |= {path, *path.parent.glob("*.[ch]")}
        if path.name == "__init__.py" and name != EVERYTHING:
            todo += _of_gathered(path, name)
            continue
        todo += [at for module, one in imports_of(path) for at in _places(module, one)]
        if any(module == "subprocess" for module, _ in imports_of(path)) and not path.is_relative_to(
            ROOT / "startrack"
        ):
            todo += [(one, EVERYTHING) for one in (ROOT / "startrack").rglob("*.py")]
    return frozenset(found)


@cache
def _places(module: str, name: str) -> list[tuple[Path, str]]:
    """Where a name of a module is looked for; none where it is not ours."""
    for base in (ROOT / "benchmarks", ROOT / "tests", ROOT):
        at = base.joinpath(*module.split("."))
        inside = at / f"{name}.py", at / name / "__init__.py", at.with_suffix(".py")
        if inner := next((one for one in inside if one.is_file()), None):
            return [(inner, EVERYTHING)]
        if (package := at / "__init__.py").is_file():
            return [(package, name)]
    return []


def _of_gathered(package: Path, name: str) -> list[tuple[Path, str]]:
    """Where a package has the `name` from; all that it imports where it defines the name itself."""
    gathered = [(module, one) for module, one in imports_of(package) if one == name]
    lazy = next((one for key, one in lazy_modules(package) if key == name), None)
    if lazy is not None:
        gathered.append((f"{package.parent.name}.{lazy}", name))
    places = [at for module, one in gathered or imports_of(package) for at in _places(module, one)]
    return places if gathered or places else []


@cache
def imports_of(path: Path) -> tuple[tuple[str, str], ...]:
    """Modules and names that a file imports anywhere, those for types alone left out."""
    found, todo = list[tuple[str, str]](), list[ast.AST](ast.parse(path.read_text(encoding="utf-8")).body)
    is_whole = False  # whether startrack itself is imported, whose names are then its attributes
    attributes = list[tuple[str, str]]()
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            todo += node.orelse
            continue
        if isinstance(node, ast.ImportFrom):
            above = path.parents[node.level - 1].relative_to(ROOT).parts if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            found += [(module, one.name) for one in node.names]
        elif isinstance(node, ast.Import):
            is_whole |= any(one.name == "startrack" for one in node.names)
            found += [(one.name, EVERYTHING) for one in node.names if one.name != "startrack"]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "startrack":
            attributes.append(("startrack", node.attr))
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module"
            and _is_made(node, path)
        ):
            found += [(".".join(path.parent.relative_to(ROOT).parts), one.stem) for one in path.parent.glob("*.py")]
        elif isinstance(node, ast.Constant) and str(node.value).endswith(".py") and path.parent.name == "benchmarks":
            found.append((Path(str(node.value)).stem, EVERYTHING))
        todo += ast.iter_child_nodes(node)
    return tuple(dict.fromkeys([*found, *(attributes if is_whole else [])]))


def _is_made(call: ast.Call, path: Path) -> bool:
    """Whether a module's name is made at run time, by other means than a table of `lazy_modules`."""
    return bool(call.args) and not isinstance(call.args[0], ast.Constant) and not lazy_modules(path)


@cache
def lazy_modules(package: Path) -> tuple[tuple[str, str], ...]:
    """Names that a package loads at their first use, and the module of each: its table whose name ends in _MODULES."""
    for node in ast.parse(package.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and any(getattr(one, "id", "").endswith("_MODULES") for one in node.targets):
            return tuple(ast.literal_eval(node.value).items())
    return ()


@cache
def code_of(path: Path) -> str:
    """The text of a source without comments, docstrings and empty lines; C sources as they are."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return text
    lines = text.splitlines()
    for first, last in _docstrings(ast.parse(text)):
        lines[first:last] = [""] * (last - first)
    kept = "\n".join(lines) + "\n"
    lines = kept.splitlines()
    for token in _comments(kept):
        row, column = token.start
        lines[row - 1] = lines[row - 1][:column]
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _docstrings(tree: ast.Module) -> Iterator[tuple[int, int]]:
    """First line, from 0, and the line after the last one of each docstring that is no whole body."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and len(node.body) > 1:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(getattr(first.value, "value", None), str):
                yield first.lineno - 1, first.end_lineno or first.lineno


def _comments(text: str) -> list[tokenize.TokenInfo]:
    return [one for one in tokenize.generate_tokens(io.StringIO(text).readline) if one.type == tokenize.COMMENT]
