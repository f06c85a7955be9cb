"""Height maps: projections, posts in memory, files read and written. What makes ground of them lies above."""
