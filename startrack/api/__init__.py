"""The functions of the library: what the commands do, with astropy's types; each loads its own module."""
