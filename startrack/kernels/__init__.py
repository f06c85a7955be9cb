"""The inner loops: C sources, the command that compiles them, and their functions for arrays of numpy."""


class LibraryMissing(ImportError):
    """The compiled library is not there, or not for this system; the message says what helps."""
