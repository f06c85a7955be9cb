"""Messages of ROS 1 and ROS 2 bags, read with the package rosbags (extra `ros`)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from startrack.core.errors import BadInput
from startrack.core.files import MAX_CAUSE_CHARS, FilePath, printable

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
ODOMETRY_TYPES = ("nav_msgs/msg/Odometry",)
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


class Message(NamedTuple):
    """One message of a topic."""

    topic: str
    kind: str  # such as "nav_msgs/msg/Odometry"
    stamp_ns: int  # of its header: nanoseconds since 1970, UTC
    content: Any  # fields as in the message's definition
    raw: bytes  # as stored

    @property
    def stamp_s(self) -> float:
        """The header's time [Unix s]."""
        return self.stamp_ns / 1e9


class StoredMessage(NamedTuple):
    """Where one message of a topic is in its bag."""

    topic: str
    log_time_ns: int  # when it was recorded; several messages may have the same
    sha256: str  # of its bytes


def is_bag(path: FilePath) -> bool:
    """Whether a path is that of a ROS bag: a file .bag, .db3 or .mcap, or a folder with metadata.yaml."""
    return Path(path).suffix.lower() in BAG_SUFFIXES or (Path(path) / "metadata.yaml").is_file()


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


def list_messages(
    path: FilePath, kinds: tuple[str, ...], topic: str | None, *, reason: str, flag: str
) -> list[StoredMessage]:
    """Where the messages of one topic are, in the bag's order, without their content. Arguments: `read_messages`.

    Raises BadInput as `read_messages`, but for a header without time.
    """
    with _refusals(path, reason), _open(Path(path), kinds, topic, flag) as (reader, connections):
        return [
            StoredMessage(connection.topic, log_time_ns, hashlib.sha256(raw).hexdigest())
            for connection, log_time_ns, raw in reader.messages(connections=connections)
        ]


def read_message(path: FilePath, kinds: tuple[str, ...], stored: StoredMessage, *, reason: str) -> Message:
    """The one message, found by its time and hash. Raises BadInput as `read_messages`, and if it is not there."""
    start = stored.log_time_ns
    with _refusals(path, reason), _open(Path(path), kinds, stored.topic, "") as (reader, connections):
        for connection, _, raw in reader.messages(connections=connections, start=start, stop=start + 1):
            if hashlib.sha256(raw).hexdigest() == stored.sha256:
                return _message(reader, connection, raw)
        raise _Fault(f"topic {stored.topic} has changed since its messages were listed")


@contextmanager
def _refusals(path: FilePath, reason: str) -> Iterator[None]:
    """Turn any fault of a bag into BadInput `reason` with the file and the cause in one line."""
    if find_spec("rosbags") is None:
        raise BadInput(
            reason, f"{printable(path)}: ROS bags need rosbags: pip install '.[ros]' in a clone of startrack"
        )
    try:
        yield
    except _Fault as fault:
        raise BadInput(reason, f"{printable(path)}: {_escape(str(fault))}") from fault
    except OSError as error:
        raise BadInput(reason, f"{printable(path)}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # rosbags raises many types for a damaged file
        cause = _escape(f"{type(error).__name__}: {error}")[:MAX_CAUSE_CHARS]
        raise BadInput(reason, f"{printable(path)}: damaged or unknown ROS bag ({cause})") from error


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
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise _Fault("is a folder without metadata.yaml, not a ROS 2 bag")
    # Files of older ROS 2 releases lack the definitions; those of the messages read here have never changed.
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        used = _choose_topic([(one.topic, one.msgtype) for one in reader.connections], kinds, topic, flag)
        connections = [one for one in reader.connections if one.topic == used and one.msgtype in kinds]
        yield reader, connections


def _message(reader: Any, connection: Any, raw: bytes) -> Message:
    content: Any = reader.deserialize(raw, connection.msgtype)
    stamp = content.header.stamp
    stamp_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
    if stamp_ns <= 0:
        raise _Fault(f"topic {connection.topic}: a message's header has no time")
    return Message(connection.topic, connection.msgtype, stamp_ns, content, bytes(raw))


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
