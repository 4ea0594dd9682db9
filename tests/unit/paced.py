"""Recordings that wait for what reads them, whatever the computer's speed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from tagid.live.sure import EarlyEnding
from tagid.metadata import Ending
from tagid.recording.recorder import Watch
from tagid.recording.stream import ScanStream


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.001)


def paced(ending: EarlyEnding, watch: Watch) -> Watch:
    """The callbacks of a recording with an early ending that considers each scan before the next one."""
    streams: list[ScanStream] = []

    def began(stream: ScanStream) -> None:
        streams.append(stream)
        watch.began(stream)

    def enough() -> Ending | None:
        wait_for(lambda: ending.remark or ending.enough() or ending.considered == len(streams[0]))
        return ending.enough()

    return replace(ending.watching(replace(watch, began=began)), enough=enough)
