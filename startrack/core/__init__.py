"""What every package uses: values, errors with exit codes, files and locks, settings, compiled code, processes."""

MAX_EXPOSURE_S = 1e6  # of an image
REPORTED_IMAGES = 30  # on a page, with their pictures
