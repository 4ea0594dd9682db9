"""A command that runs beside a benchmark: an emulated radar, a station."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any


@contextlib.contextmanager
def started(words: Sequence[str], environment: Mapping[str, str] | None = None) -> Iterator[dict[str, Any]]:
    """`tagid` with some words, and the data of the result by which it says that it is ready."""
    command = [sys.executable, "-m", "tagid", *words, "--output", "json"]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())["data"]
        finally:
            process.terminate()
