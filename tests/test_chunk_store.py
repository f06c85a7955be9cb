"""Stored chunks: what was damaged on disk is computed again, and never used."""

from __future__ import annotations

import os
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from startrack.applications import chunk_store
from startrack.applications.chunk_store import ChunkStore
from startrack.core.errors import BadOutput
from startrack.core.stored import read_json_object, read_sealed, write_sealed

BAR = SimpleNamespace(advance=lambda steps: None)


def chunk_of(task):
    return {"values": np.arange(50.0) * len(task)}


def store_in(folder, computed):
    return ChunkStore(
        folder, lambda task: computed.append(task) or chunk_of(task), lambda task: f"key-{task}", jobs=1,
        progress=lambda what, total: nullcontext(BAR),
    )  # fmt: skip


def damage(data, kind):
    """A byte changed in the data, in the list of members, behind all, or the end cut off; or nothing left."""
    if kind == "empty":
        return b""
    if kind == "cut":
        return data[:-40]
    at = {"data": 90, "list": data.rindex(b"PK\x01\x02") + 12, "end": len(data) - 1}[kind]
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize("kind", ["data", "list", "end", "cut", "empty"])
def test_a_damaged_chunk_is_computed_again(tmp_path, kind):
    computed = []
    with store_in(tmp_path, computed) as store:
        list(store.chunks("first", ["a", "bb"]))
        file = tmp_path / "key-bb.npz"
        with np.load(file) as stored:  # whole, it opens as any archive
            np.testing.assert_array_equal(stored["values"], chunk_of("bb")["values"])
        file.write_bytes(damage(file.read_bytes(), kind))
        again = list(store.chunks("again", ["a", "bb"]))
    assert computed == ["a", "bb", "bb"]
    np.testing.assert_array_equal(again[1]["values"], chunk_of("bb")["values"])


def test_a_folder_in_the_place_of_a_chunk_is_reported(tmp_path):
    (tmp_path / "key-a.npz").mkdir()
    with store_in(tmp_path, []) as store:
        for act in (lambda: list(store.chunks("first", ["a"])), lambda: store.discard(["a"])):
            with pytest.raises(BadOutput, match=r"key-a\.npz: cannot be replaced"):
                act()


@pytest.mark.parametrize("text", ["[" * 100_000, "[1]", "{", "", None])
def test_what_is_no_json_object_counts_as_missing(tmp_path, text):
    file = tmp_path / "a.json"
    if text is None:
        os.mkfifo(file)  # reading it would block
    else:
        file.write_text(text)
    assert read_json_object(file) is None
    assert read_sealed(file) is None


def test_sealed_data_are_read_as_they_were_written(tmp_path):
    for data in (b"", b"one", bytes(100)):
        write_sealed(tmp_path / "a", data)
        assert read_sealed(tmp_path / "a") == data
    assert read_sealed(tmp_path / "none") is None


def test_a_changed_kernel_changes_the_keys_of_chunks(monkeypatch):
    before = chunk_store.settings_digest(("core/*.py",), {"draws": 3})
    assert chunk_store.settings_digest(("core/*.py",), {"draws": 3}) == before
    monkeypatch.setattr(chunk_store, "source_key", lambda: "of other C sources")
    assert chunk_store.settings_digest(("core/*.py",), {"draws": 3}) != before
