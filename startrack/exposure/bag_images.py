"""Exposures from the image messages of ROS bags."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from startrack.core.errors import BadInput
from startrack.core.files import FilePath, printable
from startrack.core.types import Exposure
from startrack.exposure.bag import (
    IMAGE_TYPES,
    Message,
    StoredMessage,
    is_bag,
    list_messages,
    read_message,
    read_messages,
)
from startrack.exposure.decoding import Decoded, check_size, decode_bytes, grey_float32, largest_value
from startrack.exposure.facts import Facts
from startrack.exposure.read import exposure_of_decoded

READING = {"reason": "bad_image", "flag": "--image-topic"}
UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
NUMBERED = re.compile(r"(?P<bag>.+)#(?P<number>\d{1,9})")
# Encodings of sensor_msgs/Image (image_encodings.h) of one channel.
RAW_ENCODING = re.compile(r"(?:mono|bayer_(?P<pattern>rggb|bggr|gbrg|grbg))(?P<bits>8|16)")
BAYER_IN_FORMAT = re.compile(r"\s*bayer_(?P<pattern>rggb|bggr|gbrg|grbg)(?:8|16)\b")


@dataclass(frozen=True)
class BagImage:
    """One image message of a bag; small, so that it is cheap to send to another process."""

    bag: str  # path of the file or folder
    number: int  # among the images of its topic, from 0, in the bag's order
    message: StoredMessage

    @property
    def path(self) -> str:
        """The text that names the image: BAG#NUMBER."""
        return f"{self.bag}#{self.number:06d}"


def split_bag_path(path: str) -> tuple[str, int | None] | None:
    """The bag and the number of an image, of a `path` BAG or BAG#NUMBER; None where the path is of no bag."""
    found = None if os.path.exists(path) else NUMBERED.fullmatch(path)
    bag, number = (found["bag"], int(found["number"])) if found else (path, None)
    return (bag, number) if is_bag(bag) else None


def list_bag_images(path: FilePath, topic: str | None = None) -> list[BagImage]:
    """The images of a `topic` of the bag at `path`, without their pixels. None: its only topic of images.

    Raises BadInput bad_image.
    """
    messages = list_messages(path, IMAGE_TYPES, topic, **READING)
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
    """The exposure of one `image` with the facts `given`. Time and exceptions are as of `read_bag_exposures`."""
    message = read_message(image.bag, IMAGE_TYPES, image.message, reason=READING["reason"])
    where = f"{printable(image.bag)}: image {image.number} of {message.topic}"
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


def _exposure_of(message: Message, where: str, name: str, path: str, given: dict[str, Any]) -> Exposure:
    """The exposure of a message with the facts `given`; a refusal names `where` it is."""
    try:
        decoded, pattern = _decode(message)
        time_utc = UNIX_EPOCH + timedelta(microseconds=message.stamp_ns // 1000)
        facts = Facts(**{"time_utc": time_utc, "bayer_pattern": pattern, **given})
        return exposure_of_decoded(decoded, facts, raw=message.raw, name=name, path=path)
    except BadInput as cause:
        raise BadInput(cause.reason, f"{where}: {cause}") from cause


def _decode(message: Message) -> tuple[Decoded, str | None]:
    """Pixels of a message, and the pattern of its mosaic. Raises BadInput bad_image."""
    content = message.content
    if message.kind == "sensor_msgs/msg/CompressedImage":
        bayer = BAYER_IN_FORMAT.match(str(content.format))
        return decode_bytes(bytes(content.data)), bayer["pattern"].upper() if bayer else None
    form = RAW_ENCODING.fullmatch(str(content.encoding))
    if form is None:
        raise BadInput(
            "bad_image", f"encoding {content.encoding!r}; startrack reads mono8, mono16, bayer_rggb8 and the like"
        )
    stored = _stored_pixels(content, np.dtype(f"{'>' if content.is_bigendian else '<'}u{int(form['bits']) // 8}"))
    pixels, _ = grey_float32(stored)
    decoded = Decoded(pixels_adu=pixels, saturation_adu=largest_value(stored.dtype))
    return decoded, form["pattern"].upper() if form["pattern"] else None


def _stored_pixels(image: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The pixels (H, W) of sensor_msgs/Image, whose rows may be padded to `step` bytes."""
    width, height, step, data = int(image.width), int(image.height), int(image.step), np.asarray(image.data)
    check_size(width, height)
    if step < width * dtype.itemsize or data.size != step * height:
        raise BadInput(
            "bad_image",
            f"{width} x {height} pixels of {dtype.itemsize} bytes, {step} bytes a row, in {data.size} bytes",
        )
    rows = np.ascontiguousarray(data.reshape(height, step)[:, : width * dtype.itemsize])
    return rows.view(dtype).astype(dtype.newbyteorder("="))
