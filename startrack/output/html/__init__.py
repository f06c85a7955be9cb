"""Results as one HTML page that needs no server, no network and no other file."""

from startrack.output.html.gather import Found, result_at, results_under
from startrack.output.html.write import DEFAULT_IMAGES, filled_frame, page_text, write_page

__all__ = ["DEFAULT_IMAGES", "Found", "filled_frame", "page_text", "result_at", "results_under", "write_page"]
