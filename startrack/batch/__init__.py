"""Whole folders of images: found, located side by side, taken up again, and gathered into tables."""

from startrack.batch.find import Image, images_under, named_images
from startrack.batch.run import Batch, Counts
from startrack.batch.tables import write_tables
from startrack.batch.task import Task, locate_image, stored

__all__ = ["Batch", "Counts", "Image", "Task", "images_under", "locate_image", "named_images", "stored", "write_tables"]
