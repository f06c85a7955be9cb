"""Results for people and programs: results as JSON, star tables, annotated pictures, one-line summaries."""

from startrack.output.record import detection_dict, identification_dict, record_of, refused_dict, result_dict
from startrack.output.text import lens_text, refusal_line, summary_line, verbose_text
from startrack.output.write import (
    png_bytes,
    prepare_folder,
    remove_companions,
    write_annotated,
    write_geo,
    write_json,
    write_results,
    write_star_table,
    write_wcs,
)

__all__ = [
    "detection_dict",
    "identification_dict",
    "lens_text",
    "png_bytes",
    "prepare_folder",
    "record_of",
    "refusal_line",
    "refused_dict",
    "remove_companions",
    "result_dict",
    "summary_line",
    "verbose_text",
    "write_annotated",
    "write_geo",
    "write_json",
    "write_results",
    "write_star_table",
    "write_wcs",
]
