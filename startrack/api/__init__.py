"""The library: functions that do what the commands do, with astropy's types; each loads its own module."""
