"""Questions on the terminal. A stop signal takes effect at once, whenever it arrives.

`input` would not do: CPython handles a signal that arrives just before its read only after the next one.
"""

from __future__ import annotations

import os
import sys

import typer

from tagid import interrupts
from tagid.errors import visible

_ANSWERS = {"y": True, "yes": True, "n": False, "no": False}


def can_ask() -> bool:
    """Whether standard input is a terminal."""
    return sys.stdin is not None and sys.stdin.isatty()


def confirm(question: str, default: bool) -> bool:
    """Ask on stderr until the answer is yes or no; a stop signal or the end of the input counts as no.

    Args:
        question: its last character is the question mark.
        default: the answer of an empty line.
    """
    choices = "Y/n" if default else "y/N"
    while True:
        typer.echo(f"{visible(question)} [{choices}]: ", err=True, nl=False)
        try:
            answer = read_line().strip().lower()
        except (EOFError, KeyboardInterrupt):
            typer.echo(err=True)
            return False
        if not answer:
            return default
        if answer in _ANSWERS:
            return _ANSWERS[answer]
        typer.echo("Answer y or n.", err=True)


def read_line() -> str:
    """The next line of the standard input, which may be a terminal, a pipe or a file.

    No byte after the line is read. Stop signals take effect at once.

    Raises:
        EOFError: there is no further line. KeyboardInterrupt: a stop signal.
    """
    if sys.stdin is None:
        raise EOFError
    descriptor = sys.stdin.fileno()
    line = bytearray()
    while not line.endswith(b"\n"):
        interrupts.wait_readable(descriptor)
        byte = os.read(descriptor, 1)
        if not byte:
            break
        line += byte
    if not line:
        raise EOFError
    return line.decode(sys.stdin.encoding, "replace").rstrip("\r\n")
