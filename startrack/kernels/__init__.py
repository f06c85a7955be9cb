"""The inner loops: C sources, the command that compiles them, and their functions for arrays of numpy."""
