"""The methods that the thesis names (Kua 2008, chapter 2), each one file, built from what the thesis says of it."""
