"""What a reflector on a body returns over the aspect: one file per kind, and the list of all."""
