"""Reading a tag together with the body that carries it."""
