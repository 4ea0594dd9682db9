"""Remedies in the words of the command line: its options instead of the settings that the library names."""

from __future__ import annotations

import shlex
from dataclasses import replace

from tagid.result import Problem, Redrawn, Result, reworded, reworded_document

_SAME = (
    "align antenna_height antenna_height_file antenna_separation axis_distance background bind body"
    " budget cable_delay centre count dask device distance elevation engine enrolled file force levels"
    " limit max_seconds node noise out paper point polarisation prefix preset radius range_law reflector"
    " reflectors response resume rig rotation rows rpm scans scene seed since size slots snr snr_reference"
    " snr_reference_body spacing step surface_radius target turned_by unlike until_sure want wobble"
)
"""Arguments whose option has their name."""
OPTIONS = {name: "--" + name.replace("_", "-") for name in _SAME.split()} | {
    "centre_m": "--centre",
    "delay_m": "--delay-search",
    "focus_m": "--axis-search",
    "imaging.extent_m": "--extent",
    "imaging.method": "--method",
    "imaging.pixels": "--pixels",
    "motion.antenna_height_m": "--antenna-height",
    "motion.axis_distance_m": "--axis-distance",
    "motion.url": "--motion",
    "radar.url": "--radar",
    "radar.addresses": "--address, or `tagid config set radar.addresses`",
    "towards_m": "--side",
}
"""Option of each setting or argument that an error or remedy of the library names."""


def in_options(text: str) -> str:
    """Text with options in the place of settings.

    >>> in_options("Use `motion.url=free?rpm=2`, or override with `force`.")
    "Use --motion 'free?rpm=2', or override with --force."
    """
    return reworded(text, _option)


def _option(name: str, value: str) -> str | None:
    option = OPTIONS.get(name)
    return f"{option} {shlex.quote(value)}" if option and value else option


def result_in_options(result: Result) -> Result:
    """A result as the command line shows it, in text and in JSON."""
    return replace(
        result,
        data=reworded_document(result.data, in_options),
        human=None if result.human is None else Redrawn(result.human, in_options),
        messages=tuple(map(in_options, result.messages)),
        errors=tuple(Problem(e.code, in_options(e.message), in_options(e.remedy)) for e in result.errors),
    )
