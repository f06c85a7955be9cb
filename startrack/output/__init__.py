"""Results for people and programs: JSON, tables, pictures, pages, one-line summaries, and the table of quantities."""

from startrack.core.ecsv import Column, ecsv_text
from startrack.output.geo import feature, geojson_text, qgis_style_text
from startrack.output.html import fill_frame, page_text, write_page
from startrack.output.html.details import ground_map
from startrack.output.html.rows import Found, result_at, results_under
from startrack.output.picture.annotate import annotate
from startrack.output.picture.canvas import (
    TEXT_PX,
    TITLE_PX,
    Axes,
    Box,
    Canvas,
    Colour,
    Ink,
    Legend,
    box_around,
    encoded_bytes,
    mix_colours,
    nice_step,
    png_bytes,
)
from startrack.output.picture.maps import MARGIN_PX, SIDE_PX, Map, draw_overview, ellipse_m, relief_picture
from startrack.output.picture.panorama import horizon_picture, skyline_picture
from startrack.output.picture.prediction import comparison_picture, path_picture, prediction_picture, radius_classes
from startrack.output.quantities import QUANTITIES, table_columns
from startrack.output.quantity import (
    ABSENT,
    Kind,
    Quantity,
    Schema,
    file_schema,
    list_schema,
    markdown_table,
    object_schema,
    or_null,
    record_from,
    schema_of,
    schema_of_kind,
    show_everywhere,
)
from startrack.output.record import (
    SCHEMAS,
    refused_dict,
    result_dict,
    section_values,
    stage_values,
)
from startrack.output.tables import (
    cloud_texts,
    quantity_columns,
    skyline_table_text,
    skyline_texts_deg,
    star_table_text,
)
from startrack.output.text import Rows, explain, lens_text, refusal_line, rows, summary_line, verbose_text
from startrack.output.values import (
    ARCSEC_PER_RAD,
    boresight_rad,
    off_map,
    ranges_deg,
    ranges_text,
    sectors_off_map,
)
from startrack.output.write import (
    COMPANIONS,
    PICTURES,
    SKYLINE_FILES,
    json_text,
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
    "ABSENT", "ARCSEC_PER_RAD", "COMPANIONS", "MARGIN_PX", "PICTURES", "QUANTITIES", "SCHEMAS", "SIDE_PX",
    "SKYLINE_FILES", "TEXT_PX", "TITLE_PX", "Axes", "Box", "Canvas", "Colour", "Column", "Found", "Ink", "Kind",
    "Legend", "Map", "Quantity", "Rows", "Schema", "annotate", "boresight_rad", "box_around",
    "cloud_texts", "comparison_picture", "draw_overview", "ecsv_text", "ellipse_m", "encoded_bytes",
    "explain",
    "feature", "file_schema", "fill_frame", "geojson_text", "ground_map", "horizon_picture",
    "json_text", "lens_text", "list_schema", "markdown_table", "mix_colours", "nice_step",
    "object_schema", "off_map", "or_null", "page_text", "path_picture", "png_bytes", "prediction_picture",
    "prepare_folder", "qgis_style_text", "quantity_columns", "radius_classes", "ranges_deg", "ranges_text",
    "record_from", "refusal_line", "refused_dict", "relief_picture",
    "remove_companions", "result_at", "result_dict", "results_under", "rows", "schema_of", "schema_of_kind",
    "section_values",
    "sectors_off_map", "show_everywhere", "skyline_picture", "skyline_table_text", "skyline_texts_deg", "stage_values",
    "star_table_text", "summary_line", "table_columns", "verbose_text", "write_annotated", "write_geo",
    "write_json", "write_page", "write_results", "write_star_table", "write_wcs",
]  # fmt: skip
