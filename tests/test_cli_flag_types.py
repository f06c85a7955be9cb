"""Values of flags: every one that is converted refuses what is no number, in a short line."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import pytest

from startrack.cli.main import _parser, main

WORDS = ("nan", "inf", "-inf", "1e999", "9" * 5000, "x" * 5000, "", "1,nan,2", "nan..2", "٣,x")


def converted_flags(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.Action]]:
    """The command of each flag whose value is converted, and the flag; also those of actions."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in dict.fromkeys(action.choices.values()):
                yield from converted_flags(command)
        elif action.type is not None:
            yield parser.prog, action


FLAGS = [pytest.param(flag, id=f"{command} {flag.dest}") for command, flag in converted_flags(_parser()[0])]


@pytest.mark.parametrize("flag", FLAGS)
def test_a_value_that_is_no_number_is_refused(flag: argparse.Action) -> None:
    assert callable(flag.type)
    for word in WORDS:
        if flag.type is int and word.isdigit():  # of --seed, where nothing is random
            continue
        with pytest.raises((argparse.ArgumentTypeError, ValueError)) as refusal:
            flag.type(word)
        assert isinstance(refusal.value, argparse.ArgumentTypeError) or flag.type is int
        assert len(str(refusal.value)) < 200 or flag.type is int


@pytest.mark.parametrize("flag", ["--half=inf", "--half=-5", "--radius=0", "--latitude=nan", "--sigma=-1"])
def test_lengths_of_an_imported_map_are_checked_first(
    flag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--latitude=-90", "--longitude=0", "-o", str(tmp_path / "own.toml"), flag]
    with pytest.raises(SystemExit, match="2"):
        main(["terrain", "import", "no-such-map.tif", *words])
    assert flag.partition("=")[0] in capsys.readouterr().err
