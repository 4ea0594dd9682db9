"""Benchmarks: what the figures of docs/results are measured with.

`python -m tests.benchmarks list` names them.
"""
