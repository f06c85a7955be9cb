"""`startrack schema`: JSON schemas of the files that startrack reads and writes."""

from __future__ import annotations

import argparse
import json
from typing import Any


def add_parser(subparsers: Any) -> None:
    """Add `schema` to the commands of the `startrack` parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "schema",
        help="JSON schemas of the files",
        description="Print the JSON schema of one kind of file, or without a name the list of kinds.",
    )
    parser.add_argument("name", nargs="?", metavar="KIND", help="such as fix, identification, camera, terrain")
    parser.set_defaults(run=run, usage_error=parser.error)


def run(args: argparse.Namespace) -> int:
    """Print a schema; 0, or a usage error for an unknown kind."""
    from startrack.applications.tracking import TRACK
    from startrack.output.schema import SCHEMAS

    schemas = {**SCHEMAS, "track": TRACK}
    if args.name is None:
        print("\n".join(schemas))
    elif args.name in schemas:
        print(json.dumps(schemas[args.name], indent=2))
    else:
        args.usage_error(f"no schema is called {args.name!r}; there are: {', '.join(schemas)}")
    return 0
