"""Values, errors with exit codes, files and locks, settings and processes, which every package uses."""

__version__ = "0.2.0"  # of startrack
MAX_EXPOSURE_S = 1e6  # of an image
MAX_COUNT = 1_000_000  # of frames, cells or draws: more is a wrong unit
REPORTED_IMAGES = 30  # on a page, with their pictures
STAR_COUNT_SLOPE = 1.08  # natural logarithm of the stars per magnitude, V 6 to 10: 2.9 times as many
NARROWEST_DEG, WIDEST_DEG = 2.0, 280.0  # fields of view of an unknown lens
FIELD_TOLERANCE_1 = 0.1  # of a field of view that is given approximately
ODOMETRY_SIGMA, ODOMETRY_FLOOR_M = 0.02, 0.05  # of a move, relative to its length, and beside that
MAX_SPEED_M_S = 10.0  # of a rover: twice that of the Lunar Roving Vehicle at its fastest (18 km/h)
SKY_V_MAG_ARCSEC2 = 22.0  # diffuse light of a dark sky
