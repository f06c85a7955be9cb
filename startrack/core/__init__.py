"""What every package uses: values, errors with exit codes, files and locks, settings, compiled code, processes."""
