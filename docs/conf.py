"""Settings of the documentation site.

    sphinx-build -W --keep-going docs build/site

The pages are also read on their own, outside the site. Their links to files of the repository become links to the
pages that include these files (`link_to_pages`, `link_in_included`).
"""

from __future__ import annotations

import re
from dataclasses import is_dataclass
from itertools import groupby, takewhile
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

import startrack

project = "startrack"
author = "The startrack developers"
copyright = "The startrack developers. Licence: MIT"
release = version = startrack.__version__

extensions = ["myst_parser", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["images/*"]
myst_enable_extensions = ["colon_fence", "attrs_inline"]
myst_heading_anchors = 3
suppress_warnings = [
    "myst.header",  # included parts of README.md begin below the heading of their page
    "ref.python",  # a type whose short name several packages have is linked to the first
]

autodoc_default_options = {"members": True, "undoc-members": True, "exclude-members": "from_dict"}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
smartquotes = False
default_role = "code"  # `name` in a docstring

html_theme = "furo"
html_title = f"startrack {startrack.__version__}"
html_logo = html_favicon = "_static/logo.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = True  # the search shows excerpts of it
html_show_sourcelink = False
copybutton_selector = "div.highlight-sh pre, div.highlight-python pre, div.highlight-toml pre"

PAGES_OF_FILES = {  # file of the repository to the page that includes it
    "CONVENTIONS.md": "conventions.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "README.md": "index.md",
    "benchmarks/RESULTS.md": "results.md",
    "startrack/terrain/protocol.py": "api/terrain.md",
}


def link_to_pages(app: Sphinx, docname: str, source: list[str]) -> None:
    """Replace a page's links to files outside docs/ by links to their pages."""
    up = "../" * docname.count("/")
    for file, page in PAGES_OF_FILES.items():
        source[0] = source[0].replace(f"]({up}../{file}", f"]({up}{page}")


def link_in_included(app: Sphinx, path: Path, docname: str, source: list[str]) -> None:
    """The same in a file of the repository's root that a page of docs/ includes."""
    source[0] = source[0].replace("](docs/", "](")
    for file, page in PAGES_OF_FILES.items():
        source[0] = source[0].replace(f"]({file}", f"]({page}")


def keep_attribute(app: Sphinx, what: str, name: str, one: Any, options: Any, lines: list[str]) -> None:
    """Before Napoleon: it takes the words before a colon for the type of an attribute. Bars are no references."""
    lines[:] = [line.replace("|", r"\|") for line in lines]
    if what in ("attribute", "property"):
        kept[name] = list(lines)


def restore_attribute(app: Sphinx, what: str, name: str, one: Any, options: Any, lines: list[str]) -> None:
    """After Napoleon."""
    lines[:] = kept.pop(name, lines)


def link_figures(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    """Make each figure a link to its file."""
    for image in list(doctree.findall(nodes.image)):
        if image["uri"] in app.env.images and not isinstance(image.parent, nodes.reference):
            file = "../" * docname.count("/") + f"_images/{app.env.images[image['uri']][1]}"
            link = nodes.reference("", "", internal=True, refuri=file, classes=["figure"])
            image.replace_self(link)
            link += image


def leave_out_fields(app: Sphinx, what: str, name: str, one: Any, *rest: Any) -> tuple[str, str] | None:
    """No signature of a dataclass: its fields follow."""
    return ("", "") if what == "class" and is_dataclass(one) else None


def fold_fields(app: Sphinx, doctree: nodes.document) -> None:
    """Keep fields and properties out of the table of contents, fold the many of a class, and write types shortly."""
    for one in doctree.findall(addnodes.desc):
        if one["objtype"] in FIELDS:
            one["no-contents-entry"] = True
            for annotation in one[0].findall(addnodes.desc_annotation):
                join_texts(annotation)
    for content in list(doctree.findall(addnodes.desc_content)):
        parts = [child for child in content if isinstance(child, addnodes.desc)]
        fields = list(takewhile(lambda part: part["objtype"] in FIELDS, parts))
        if len(fields) > MOST_OPEN_FIELDS:
            content.insert(content.index(fields[0]), nodes.raw("", OPEN_FOLD.format(len(fields)), format="html"))
            content.insert(content.index(fields[-1]) + 1, nodes.raw("", "</details>", format="html"))


def names_startrack(one: nodes.Node) -> bool:
    return isinstance(one, addnodes.pending_xref) and one["reftarget"].startswith("startrack")


def join_texts(annotation: addnodes.desc_annotation) -> None:
    """One text of all that is no link to a type of startrack, with short names of arrays."""
    children: list[nodes.Node] = []
    for is_link, part in groupby(annotation.children, names_startrack):
        together = list(part)
        text = ARRAY_TYPE.sub(r"NDArray[\1]", "".join(one.astext() for one in together))
        children += together if is_link else [nodes.Text(text)]
    annotation.children = []
    annotation.extend(children)


def complete_landmarks(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Give the captions of the contents a level as headings, and let keys scroll code and tables."""
    contents, body = context.get("furo_navigation_tree"), context.get("body")
    if contents:
        context["furo_navigation_tree"] = contents.replace('role="heading"', 'role="heading" aria-level="2"')
    if body:
        focusable = body.replace("<pre>", '<pre tabindex="0">')
        context["body"] = focusable.replace('<div class="table-wrapper', '<div tabindex="0" class="table-wrapper')


def source_with_field_comments(module: str) -> tuple[str | None, str | None]:
    """File and source of a module for autodoc, where the comment after a field of a dataclass documents the field."""
    path, source = module_source(module)
    if source is None and path is not None:
        source = Path(path).read_text(encoding="utf-8")
    return path, None if source is None else FIELD.sub(r"\1  #: ", source)


ARRAY_TYPE = re.compile(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]")
FIELDS = ("attribute", "property")
MOST_OPEN_FIELDS = 4
OPEN_FOLD = "<details><summary>{} fields and properties</summary>"
FIELD = re.compile(r"^(    \w+: [^#\n]*\S)  # (?!fmt|type|noqa)", re.MULTILINE)
kept: dict[str, list[str]] = {}
module_source = ModuleAnalyzer.get_module_source
ModuleAnalyzer.get_module_source = staticmethod(source_with_field_comments)  # type: ignore[method-assign]


def setup(app: Sphinx) -> None:
    """Connect the handlers."""
    app.connect("source-read", link_to_pages)
    app.connect("include-read", link_in_included)
    app.connect("autodoc-process-signature", leave_out_fields)
    app.connect("doctree-read", fold_fields, priority=400)  # Sphinx collects the tables of contents at 500
    app.connect("doctree-resolved", link_figures)
    app.connect("html-page-context", complete_landmarks, priority=900)  # after the theme
    app.connect("autodoc-process-docstring", keep_attribute, priority=400)  # Napoleon has 500
    app.connect("autodoc-process-docstring", restore_attribute, priority=600)
