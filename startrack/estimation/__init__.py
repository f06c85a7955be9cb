"""Statistics: attitude, lens, least squares, matches of detections and stars, chance, filter and smoother of tracks."""
