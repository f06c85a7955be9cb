"""ROS 1 and ROS 2 bags, read with rosbags (extra `ros`): their messages, and exposures from their images."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from startrack.core.errors import BadInput, how_to_install
from startrack.core.files import MAX_CAUSE_CHARS, MAX_TEXT_BYTES, FilePath, printable
from startrack.core.limits import has_room, memory_refusal
from startrack.core.types import Exposure
from startrack.exposure.decoding import Decoded, bad_image, check_size, decode_bytes, grey_float32, largest_value
from startrack.exposure.facts import Facts
from startrack.exposure.read import exposure_of_decoded

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
ODOMETRY_TYPES = ("nav_msgs/msg/Odometry",)
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
READING = {"reason": "bad_image", "flag": "--image-topic"}
NUMBERED = re.compile(r"(?P<bag>.+)#(?P<number>\d{1,9})")
# Encodings of sensor_msgs/Image (image_encodings.h) of one channel.
RAW_ENCODING = re.compile(r"(?:mono|bayer_(?P<pattern>rggb|bggr|gbrg|grbg))(?P<bits>8|16)")
BAYER_IN_FORMAT = re.compile(r"\s*bayer_(?P<pattern>rggb|bggr|gbrg|grbg)(?:8|16)\b")


class Message(NamedTuple):
    """Message of a topic."""

    topic: str
    stamp_ns: int  # of its header: nanoseconds since 1970, UTC
    content: Any  # fields as in the message's definition
    raw: bytes  # as stored


class StoredMessage(NamedTuple):
    """Place of one message of a topic in its bag."""

    topic: str
    log_time_ns: int  # when it was recorded; several messages may have the same
    sha256: str  # of its bytes


@dataclass(frozen=True)
class BagImage:
    """Image message of a bag; small, so that it is cheap to send to another process."""

    bag: str  # path of the file or folder
    number: int  # among the images of its topic, from 0, in the bag's order
    message: StoredMessage

    @property
    def path(self) -> str:
        """The text that names the image: BAG#NUMBER."""
        return f"{self.bag}#{self.number:06d}"


def is_bag(path: FilePath) -> bool:
    """Whether a path is that of a ROS bag: a file .bag, .db3 or .mcap, or a folder with metadata.yaml."""
    return Path(path).suffix.lower() in BAG_SUFFIXES or (Path(path) / "metadata.yaml").is_file()


def split_bag_path(path: str) -> tuple[str, int | None] | None:
    """The bag and the number of an image, of a `path` BAG or BAG#NUMBER; None where the path is of no bag."""
    found = None if os.path.exists(path) else NUMBERED.fullmatch(path)
    bag, number = (found["bag"], int(found["number"])) if found else (path, None)
    return (bag, number) if is_bag(bag) else None


def read_messages(
    path: FilePath, kinds: tuple[str, ...], topic: str | None, *, reason: str, flag: str
) -> Iterator[Message]:
    """The messages of one `topic` of the types `kinds`, one by one, in the order of the bag `path`.

    None takes the only topic of these types. `flag` is named in the advice where there are several.

    Raises:
        BadInput: `reason` with the file and the cause: no such file or topic, several topics, a damaged bag, a header
            without time, or rosbags is not installed.
    """
    with _refusals(path, reason), _open(Path(path), kinds, topic, flag) as (reader, connections):
        for connection, _, raw in reader.messages(connections=connections):
            yield _message(reader, connection, raw)


def list_bag_images(path: FilePath, topic: str | None = None) -> list[BagImage]:
    """The images of a `topic` of the bag at `path`, without their pixels. None: its only topic of images.

    Raises BadInput bad_image.
    """
    with _refusals(path, READING["reason"]), _open(Path(path), IMAGE_TYPES, topic, READING["flag"]) as bag:
        messages = (
            StoredMessage(connection.topic, log_time_ns, hashlib.sha256(raw).hexdigest())
            for connection, log_time_ns, raw in bag[0].messages(connections=bag[1])
        )
        return [BagImage(os.fspath(path), number, message) for number, message in enumerate(messages)]


def choose_bag_image(path: FilePath, number: int | None, topic: str | None = None) -> BagImage:
    """The image `number` (None: the only one) of a `topic` of the bag at `path`.

    Raises BadInput bad_image where there is no such image, or several.
    """
    images, name = list_bag_images(path, topic), printable(path)
    if number is None and len(images) != 1:
        raise BadInput(
            "bad_image",
            f"{name}: holds {len(images)} images: choose one, {name}#0 to {name}#{len(images) - 1}, or locate all with "
            f"startrack batch {name}",
        )
    if number is not None and number >= len(images):
        raise BadInput("bad_image", f"{name}: has no image {number}: it holds {len(images)}, from 0")
    return images[number or 0]


def read_bag_image(image: BagImage, **given: Any) -> Exposure:
    """The exposure of one `image` with the facts `given`. Time and exceptions are as of `read_bag_exposures`.

    The message is found by its time and hash.
    """
    topic, start, sha256 = image.message
    with (
        _refusals(image.bag, READING["reason"]),
        _open(Path(image.bag), IMAGE_TYPES, topic, "") as (reader, connections),
    ):
        stored = reader.messages(connections=connections, start=start, stop=start + 1)
        found = next((one for one in stored if hashlib.sha256(one[2]).hexdigest() == sha256), None)
        if found is None:
            raise _Fault(f"topic {topic} has changed since its messages were listed")
        message = _message(reader, found[0], found[2])
    where = f"{printable(image.bag)}: image {image.number} of {topic}"
    return _exposure_of(message, where, Path(image.path).name, image.path, given)


def read_bag_exposures(path: FilePath, topic: str | None = None, **given: Any) -> Iterator[Exposure]:
    """The exposures of a bag's image `topic` (None: its only one), one by one, in the bag's order.

    sensor_msgs/Image in mono8, mono16 or a Bayer encoding, and sensor_msgs/CompressedImage of PNG or JPEG. The time
    of a message's header is taken as the middle of the exposure. The exposures are named BAG-0000, BAG-0001, ...
    `path` is a file or the folder of a ROS 2 bag. A bag does not have `exposure_s`, `time_sigma_s`, `camera`,
    `terrain`, `mask`, `dark` and `flat`: they are `given`, as in `read_exposure`.

    Raises:
        BadInput: bad_image with the file and the cause, in one line.
        ValueError: `time_sigma_s` is no usable number of seconds.
    """
    for number, message in enumerate(read_messages(path, IMAGE_TYPES, topic, **READING)):
        where = f"{printable(path)}: image {number} of {message.topic}"
        yield _exposure_of(message, where, f"{Path(path).stem}-{number:04d}", str(path), given)


def exposure_of_message(content: Any, name: str, **given: Any) -> Exposure:
    """The exposure of one message, with what `read_bag_exposures` says of encodings and time.

    Args:
        content: a sensor_msgs/Image or CompressedImage of rclpy or rosbags.
        name: name of the exposure.
        given: facts that the message does not have: `camera`, `exposure_s` and the like, as in `read_exposure`.

    Raises:
        BadInput: bad_image with the name and the cause, in one line: an encoding that is not read, a wrong number of
            bytes, a header without time.
        ValueError: as `read_bag_exposures`.
    """
    try:
        stamp_ns = _stamp_ns(content)
    except _Fault as fault:
        raise BadInput(READING["reason"], f"{printable(name)}: {fault}") from fault
    message = Message("", stamp_ns, content, bytes(content.data))
    return _exposure_of(message, printable(name), name, "", given)


def _exposure_of(message: Message, where: str, name: str, path: str, given: dict[str, Any]) -> Exposure:
    """The exposure of a message with the facts `given`; a refusal names `where` it is."""
    try:
        decoded, pattern = _decode(message.content)
        time_utc = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=message.stamp_ns // 1000)
        facts = Facts(**{"time_utc": time_utc, "bayer_pattern": pattern, **given})
        return exposure_of_decoded(decoded, facts, raw=message.raw, name=name, path=path)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{where}: {cause}") from cause


def _decode(content: Any) -> tuple[Decoded, str | None]:
    """Pixels of a message's `content`, and the pattern of its mosaic. Raises BadInput bad_image."""
    if hasattr(content, "format"):
        bayer = BAYER_IN_FORMAT.match(str(content.format))
        return decode_bytes(bytes(content.data)), bayer["pattern"].upper() if bayer else None
    form = RAW_ENCODING.fullmatch(str(content.encoding))
    if form is None:
        raise bad_image(f"encoding {content.encoding!r}; startrack reads mono8, mono16, bayer_rggb8 and the like")
    dtype = np.dtype(f"{'>' if content.is_bigendian else '<'}u{int(form['bits']) // 8}")
    width, height, step, data = int(content.width), int(content.height), int(content.step), np.asarray(content.data)
    check_size(width, height)
    row_bytes = width * dtype.itemsize
    if step < row_bytes or data.size != step * height:
        raise bad_image(
            f"{width} x {height} pixels of {dtype.itemsize} bytes, {step} bytes a row, in {data.size} bytes"
        )
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row_bytes])
    stored = rows.view(dtype).astype(dtype.newbyteorder("="))
    decoded = Decoded(pixels_adu=grey_float32(stored)[0], saturation_adu=largest_value(stored.dtype))
    return decoded, form["pattern"].upper() if form["pattern"] else None


@contextmanager
def _refusals(path: FilePath, reason: str) -> Iterator[None]:
    """Turn any fault of a bag into BadInput `reason` with the file and the cause in one line."""
    if find_spec("rosbags") is None:
        raise BadInput(reason, f"{printable(path)}: ROS bags need rosbags: {how_to_install('ros')}")
    try:
        yield
    except _Fault as fault:
        raise BadInput(reason, f"{printable(path)}: {_escape(str(fault))}") from fault
    except OSError as error:
        raise BadInput(reason, f"{printable(path)}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # rosbags raises many types for a damaged file
        cause = _escape(f"{type(error).__name__}: {error}")[:MAX_CAUSE_CHARS]
        damaged = f"{printable(path)}: damaged or unknown ROS bag"
        if isinstance(error, MemoryError) and has_room():  # room for as many bytes as the file states
            raise BadInput(reason, f"{damaged} (a length in it is beyond its end)") from None
        raise memory_refusal(error) or BadInput(reason, f"{damaged} ({cause})") from error


def _escape(text: str) -> str:
    """The text in one line, control characters escaped: a damaged bag may have any in a name."""
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in " ".join(text.split()))


class _Fault(Exception):
    """Why the content of a bag cannot be used."""


@contextmanager
def _open(path: Path, kinds: tuple[str, ...], topic: str | None, flag: str) -> Iterator[tuple[Any, list[Any]]]:
    """The reader of a bag, and the connections of the one topic to read."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not path.exists():
        raise _Fault("no such file")
    metadata = path / "metadata.yaml"
    if path.is_dir() and not metadata.is_file():
        raise _Fault("is a folder without metadata.yaml, not a ROS 2 bag")
    if path.is_dir() and metadata.stat().st_size > MAX_TEXT_BYTES:  # which rosbags would read for minutes
        raise _Fault(f"its metadata.yaml has more than {MAX_TEXT_BYTES // 2**20} MiB")
    # Files of older ROS 2 releases lack the definitions; those of the messages read here have never changed.
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        used = _choose_topic([(one.topic, one.msgtype) for one in reader.connections], kinds, topic, flag)
        connections = [one for one in reader.connections if one.topic == used and one.msgtype in kinds]
        yield reader, connections


def _message(reader: Any, connection: Any, raw: bytes) -> Message:
    content: Any = reader.deserialize(raw, connection.msgtype)
    try:
        stamp_ns = _stamp_ns(content)
    except _Fault as fault:
        raise _Fault(f"topic {connection.topic}: {fault}") from fault
    return Message(connection.topic, stamp_ns, content, bytes(raw))


def _stamp_ns(content: Any) -> int:
    """The time of a message's header, nanoseconds since 1970."""
    stamp = content.header.stamp
    stamp_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    if stamp_ns <= 0:
        raise _Fault("a message's header has no time")
    return stamp_ns


def _choose_topic(topics: list[tuple[str, str]], kinds: tuple[str, ...], topic: str | None, flag: str) -> str:
    """The topic to read, from the pairs of name and type in the bag."""
    found = sorted({name for name, kind in topics if kind in kinds})
    wanted = " or ".join(kind.replace("/msg/", "/") for kind in kinds)
    listed = ", ".join(found) if found else "none"
    if topic is not None and topic not in found:
        raise _Fault(f"has no topic {topic} of type {wanted}; topics of that type: {listed}")
    if topic is None and not found:
        raise _Fault(f"has no topic of type {wanted}")
    if topic is None and len(found) > 1:
        raise _Fault(f"has several topics of type {wanted}: choose one with {flag}: {listed}")
    return found[0] if topic is None else topic
