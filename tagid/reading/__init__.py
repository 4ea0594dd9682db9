"""Reads a tag in recordings: hypotheses of one model, compared by their log evidence."""
