"""Batches: find the images of a folder, locate them in parallel, resume a stopped run, write tables."""

from startrack.applications.batch.find import (
    LOCK,
    Image,
    image_tree,
    images_of_bag,
    images_under,
    listed_images,
    lock_results,
    maps_among,
    record_path,
    result_stems,
)
from startrack.applications.batch.tables import (
    MANIFEST,
    Rows,
    belongs_to_other_images,
    has_parquet,
    table_rows,
    table_values,
    tabled_results,
    write_tables,
)
from startrack.applications.batch.task import (
    JOB,
    ImageDone,
    Task,
    locate_image,
    locate_images,
    read_task,
    stored_record,
    text_of_name,
)

__all__ = [
    "JOB", "LOCK", "MANIFEST", "Image", "ImageDone", "Rows", "Task", "belongs_to_other_images", "has_parquet",
    "image_tree", "images_of_bag", "images_under", "listed_images", "locate_image", "locate_images", "lock_results",
    "maps_among", "read_task", "record_path", "result_stems", "stored_record", "table_rows",
    "table_values", "tabled_results", "text_of_name", "write_tables",
]  # fmt: skip
