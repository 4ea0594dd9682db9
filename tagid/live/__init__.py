"""What a recording shows while it runs: the growing image, the evidence for each layout, the answer."""
