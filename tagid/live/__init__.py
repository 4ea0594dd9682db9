"""Live view of a recording: the growing image, the evidence for each layout, the answer."""
