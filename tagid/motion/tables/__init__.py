"""Commanded turntables, one file each; a new one needs a file here and a line in pyproject.toml."""
