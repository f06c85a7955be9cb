"""The commands: arguments, degrees, printing and exit codes."""
