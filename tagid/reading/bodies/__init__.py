"""Bodies with an echo of their own shape: one file per kind."""
