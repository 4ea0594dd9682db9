"""Turntables with a wire, one file each; a new one is a file here and a line in pyproject.toml."""
