"""Whole folders of images: found, located side by side, taken up again, and gathered into tables."""

from startrack.batch.find import Image, images_under, named_images
from startrack.batch.rows import Rows, gist, rows_of
from startrack.batch.store import (
    JOB,
    LOCK,
    in_the_tables,
    is_of_other_images,
    only_writer,
    printable,
    result_of,
    stored,
)
from startrack.batch.tables import write_tables
from startrack.batch.task import ImageDone, Task, locate_image, locate_images

__all__ = [
    "JOB",
    "LOCK",
    "Image",
    "ImageDone",
    "Rows",
    "Task",
    "gist",
    "images_under",
    "in_the_tables",
    "is_of_other_images",
    "locate_image",
    "locate_images",
    "named_images",
    "only_writer",
    "printable",
    "result_of",
    "rows_of",
    "stored",
    "write_tables",
]
