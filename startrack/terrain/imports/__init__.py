"""Import of elevation data as terrain files, with the errors of the maps."""
