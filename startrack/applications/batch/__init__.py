"""Batches: find the images of a folder, locate them in parallel, resume a stopped run, write tables."""

from startrack.applications.batch.find import Image, images_of_bag, images_under, listed_images, result_stems
from startrack.applications.batch.store import (
    JOB,
    LOCK,
    belongs_to_other_images,
    lock_results,
    record_path,
    stored_record,
    tabled_results,
    text_of_name,
)
from startrack.applications.batch.tables import Rows, has_parquet, table_rows, table_values, write_tables
from startrack.applications.batch.task import ImageDone, Task, locate_image, locate_images, read_task

__all__ = [
    "JOB", "LOCK", "Image", "ImageDone", "Rows", "Task", "belongs_to_other_images", "has_parquet", "images_of_bag",
    "images_under", "listed_images", "locate_image", "locate_images", "lock_results", "read_task", "record_path",
    "result_stems", "stored_record", "table_rows", "table_values", "tabled_results", "text_of_name", "write_tables",
]  # fmt: skip
