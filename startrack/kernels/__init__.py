"""The inner loops: C sources, the command that compiles them, and their functions for arrays of numpy."""

STAMP_LANES = 8  # pixels of a stamp that kernels sum together: stamps are filled up to a multiple


class LibraryMissing(ImportError):
    """The compiled library is not there, or not for this system; the message says what helps."""
