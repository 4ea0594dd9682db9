"""Planning of a recording: link budget, expected rates, and possible improvements."""
