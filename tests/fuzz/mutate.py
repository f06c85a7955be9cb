"""Changes of valid files: bytes of binary formats, words of text formats, cards of FITS headers."""

from __future__ import annotations

import bz2
import gzip
import re
import struct
import zlib
from random import Random

TEXT_KINDS = {
    "sidecar", "camera", "converted", "terrain", "odometry", "table", "attitude", "label", "record",
}  # fmt: skip
PNG_KINDS = {"png", "layers", "correction"}
CHANGES = 1, 1, 1, 2, 3, 5  # of one file
CARD_BYTES = 80
HEADER_BYTES = 700  # of a binary file: half of the changes fall there
WORD = re.compile(rb'"[^"\n]*"|[+-]?\d+\.?\d*(?:[eE][+-]?\d+)?|\w+')
NUMBERS = (
    b"0", b"-1", b"1", b"0.0", b"-0.0", b"1e308", b"-1e308", b"1e-320", b"1e999", b"nan", b"inf", b"-inf", b"NaN",
    b"Infinity", b"2147483648", b"4294967296", b"18446744073709551616", b"9" * 400, b"9" * 5000, b"1e6", b"1e12",
    b"200000000", b"true", b"null", b"0x7fffffff", b"65535", b"90.0", b"180.0", b"360.0", b"1979-05-27",
)  # fmt: skip
TEXTS = (
    b'""', b'"text"', b'"two\\nlines"', b'"\\u0000"', b'"\\ud800"', b'"' + b"x" * 250 + b'"', b'"' + b"x" * 5000 + b'"',
    b'"../../../../etc/passwd"', b'"/dev/zero"', b'"/dev/stdin"', b'"."', b'"~"', b'"\xc3\xa4\xe2\x9c\xb6.toml"',
    b'"file:///etc/passwd"', b'"/vsicurl/http://localhost/a.tif"', b'"%s%n{0}"', b'"<script>alert(1)</script>"',
)  # fmt: skip
TABLES = (
    b"[]", b"{}", b"[[]]", b"[1, 2]", b'["a", 1]', b"[true, false]", b"[" * 1000 + b"]" * 1000, b"[" * 50_000,
    b'{"a":' * 1000 + b"1" + b"}" * 1000, b"[" + b"0," * 3000 + b"0]", b"!!python/object/apply:os.getcwd []",
    b"&a [*a]", b"\xff\xfe", b"\0",
)  # fmt: skip
VALUES = NUMBERS + TEXTS + TABLES
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 14143, 200_000_000)


def mutate(kind: str, data: bytes, random: Random) -> bytes:
    """A changed copy of the valid file `data` of a `kind`, drawn with `random`."""
    packing = {b"\x1f\x8b": (gzip.decompress, _gzip), b"BZh": (bz2.decompress, bz2.compress)}
    for mark, (unpack, pack) in packing.items():
        if data.startswith(mark) and random.random() < 0.5:
            return pack(mutate(kind, unpack(data), random))
    change = _change_words if kind in TEXT_KINDS else _change_bytes
    if kind == "fits" and random.random() < 0.6:
        change = _change_cards
    for _ in range(random.choice(CHANGES)):
        data = change(data, random) or b"\0"
    return repair_checksums(data) if kind in PNG_KINDS and random.random() < 0.8 else data


def _gzip(data: bytes) -> bytes:
    return gzip.compress(data, compresslevel=1, mtime=0)


def _change_bytes(data: bytes, random: Random) -> bytes:
    reach = len(data) if random.random() < 0.5 else min(len(data), HEADER_BYTES)
    at = random.randrange(reach)
    match random.randrange(7):
        case 0:
            return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :]
        case 1:
            return data[:at] + random.randbytes(1) + data[at + 1 :]
        case 2:
            return data[:at] + random.randbytes(random.randint(1, 16)) + data[at:]
        case 3:
            return data[:at] + data[at + random.randint(1, 64) :]
        case 4:
            end = at + random.randint(1, 64)
            to = random.randrange(len(data))
            return data[:to] + data[at:end] + data[to + (end - at if random.random() < 0.7 else 0) :]
        case 5:
            return data[: random.randrange(len(data))] if random.random() < 0.2 else data
    width, order = random.choice((("B", ""), ("H", "<"), ("H", ">"), ("I", "<"), ("I", ">"), ("d", "<")))
    number = random.choice(INTEGERS) & {"B": 0xFF, "H": 0xFFFF}.get(width, 0xFFFFFFFF)
    value = random.choice((float("nan"), float("inf"), 1e308, -1.0, 0.0)) if width == "d" else number
    packed = struct.pack(order + width, value)
    return data[:at] + packed + data[at + len(packed) :]


def _change_words(data: bytes, random: Random) -> bytes:
    """A word replaced by a value that is hard to read, a line lost, doubled or moved, or a byte changed."""
    act = random.random()
    if act < 0.1:
        return _change_bytes(data, random)
    if act < 0.3:
        lines = data.split(b"\n")
        at, to = random.randrange(len(lines)), random.randrange(len(lines))
        line = lines[at]
        if random.random() < 0.6:
            del lines[at]
        if random.random() < 0.6:
            lines.insert(to, line)
        return b"\n".join(lines)
    words = list(WORD.finditer(data))
    if not words:
        return data + random.choice(VALUES)
    word = random.choice(words)
    end = words[min(words.index(word) + random.randrange(4), len(words) - 1)].end() if act < 0.4 else word.end()
    return data[: word.start()] + random.choice(VALUES) + data[end:]


def _change_cards(data: bytes, random: Random) -> bytes:
    """One card of a FITS header with another value or key; the cards keep their 80 bytes."""
    cards = max(data.find(b"END     ") // CARD_BYTES, 1)
    at = CARD_BYTES * random.randrange(cards)
    card = data[at : at + CARD_BYTES]
    value = random.choice(VALUES)[:70].replace(b'"', b"'").replace(b"\n", b" ")
    act = random.randrange(4)
    if act == 0:
        other = CARD_BYTES * random.randrange(cards)
        new = data[other : other + CARD_BYTES]
    elif act == 1:
        keys = (b"NAXIS", b"NAXIS1", b"TFIELDS", b"BITPIX", b"PCOUNT", b"GCOUNT", b"BZERO", b"BSCALE", b"ZCMPTYPE")
        new = random.choice(keys).ljust(8) + b"= " + value.rjust(20)
    else:
        new = card[:10] + value.rjust(20)
    return data[:at] + new[:CARD_BYTES].ljust(CARD_BYTES) + data[at + CARD_BYTES :]


def repair_checksums(png: bytes) -> bytes:
    """The PNG file with the checksum of each chunk that is complete made right, so that the decoders are reached."""
    at, parts = 8, [png[:8]]
    while at + 12 <= len(png):
        (length,) = struct.unpack_from(">I", png, at)
        end = at + 8 + length
        if end + 4 > len(png):
            break
        parts += [png[at:end], struct.pack(">I", zlib.crc32(png[at + 4 : end]))]
        at = end + 4
    return b"".join([*parts, png[at:]])
