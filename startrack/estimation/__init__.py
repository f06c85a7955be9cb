"""Statistics of directions: attitude, least squares, matches of detections and stars, chance."""
