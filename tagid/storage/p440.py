"""Converts scans with a P440's numbers and timestamps to a Capture, for all file formats.

Binary recordings and the vendor's log share the grid, the wrapping counters and the signs of lost scans.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, ViewFlag
from tagid.constants import BIN_PS, SPEED_OF_LIGHT
from tagid.counting import counted
from tagid.errors import FileFormatError, UsageError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.storage.assembly import build_capture, unwrap

MAX_NODES = 64
"""Maximum number of radars distinguished in one file."""

RAW = 1
"""Filter of a scan as the radar took it."""

WINDOW = ("scan_start_ps", "scan_stop_ps")

GRID_PS = 2
"""A requested window end this close to the actual one is considered equal: the radar's grid is 1.9 ps."""

_RESTART = -64
"""A decrease of the scan number below this is a new run in the same file; smaller ones are reordering."""
_ALIKE = 8
"""Scans of the same number and time that are compared, where a program stored a constant."""


@dataclass(frozen=True, eq=False)
class P440Scans:
    """Complete scans in file order, on one grid.

    Attributes:
        samples: (views, bins) int32 counts.
        message_id: (views,) scan number as sent, u16, wraps.
        timestamp_ms: (views,) radar clock as sent, u32 ms, wraps.
        host_time_ns: (views,) ns since the epoch, or None.
        lost_id: (lost,) numbers of scans that are incomplete.
        info: the other fields of the first scan, by the names of `SCAN_INFO_DTYPE`.
        config: the configuration block; may be stale or empty.
    """

    samples: NDArray[np.int32]
    message_id: NDArray[np.int64]
    timestamp_ms: NDArray[np.int64]
    host_time_ns: NDArray[np.int64] | None
    lost_id: NDArray[np.int64]
    info: dict[str, Any]
    config: RadarSettings


def choose_node(path: Path, scans_of: dict[int, int], node: int | None) -> int:
    """The radar whose scans to read from a file: the requested `node`, or the only one.

    `scans_of` maps the number of each radar in the file (at most `MAX_NODES`) to the amount of its data.

    Raises UsageError if there are several and none was chosen, or the chosen one is not among them.
    """
    if node is None and len(scans_of) == 1:
        return next(iter(scans_of))
    if node in scans_of:
        return int(node)
    shown = ", ".join(str(number) for number in sorted(scans_of)[:8]) + ", ..." * (len(scans_of) > 8)
    if node is None:
        raise UsageError(
            f"{path}: holds scans of {len(scans_of)} radars (nodes {shown})",
            f"Choose one with `node`, e.g. `node={min(scans_of)}`.",
        )
    raise UsageError(f"{path}: holds no scan of node {node}", f"It holds {shown}; choose one with `node`.")


def p440_capture(path: Path, scans: P440Scans, cable_delay_ps: float, about: RadarInfo) -> Capture:
    """The capture of scans: exact repetitions left out, views sorted, lost scans counted and marked.

    Several runs in one file follow one another.

    The two-way delay of cables and antennas, ps, is subtracted from the ranges. `about` has the file's format
    as `source`, and what else it tells; the repetitions are added to `packets_ignored` and `ignored`.

    Raises FileFormatError: the grid is invalid.
    """
    start_ps, step_bins = scans.info["scan_start_ps"], scans.info["step_bins"]
    if step_bins < 1:
        raise FileFormatError(f"{path}: the scans have a step of {step_bins} bins", "The file is damaged.")
    kept = _new_scans(scans)
    repeated = len(scans.samples) - len(kept)
    number, time_ms = scans.message_id[kept], scans.timestamp_ms[kept]
    scan_id, order, lost = _sort(number, time_ms, scans.lost_id)
    samples = _reorder(scans.samples[kept] if repeated else scans.samples, order)
    again = (f"{counted(repeated, 'scan')} stored again",) if repeated else ()
    radar = replace(
        about,
        node_id=scans.info.get("node_id", scans.config.node_id or 0),
        config=scans.config,
        scan_info=scans.info,
        cable_delay_ps=float(cable_delay_ps),
        scans_lost=lost,
        packets_ignored=repeated + (about.packets_ignored or 0),
        ignored=(*again, *about.ignored),
    )
    host = scans.host_time_ns
    return build_capture(
        path,
        samples=samples,
        range_start_m=(start_ps - cable_delay_ps) * 1e-12 * SPEED_OF_LIGHT / 2,
        range_step_m=step_bins * BIN_PS * 1e-12 * SPEED_OF_LIGHT / 2,
        host_time_ns=None if host is None else host[kept][order],
        radar_time_ms=unwrap(time_ms[order], 1 << 32).astype(np.float64),
        scan_id=scan_id,
        flags=_flags(samples, scan_id, scans.config.clip_counts),
        radar=radar,
    )


def _reorder(samples: NDArray[np.int32], order: NDArray[np.intp]) -> NDArray[np.int32]:
    """samples[order] in place: a second copy of a recording could exceed the memory."""
    if np.array_equal(order, np.arange(len(order))):
        return samples
    done = np.zeros(len(order), dtype=bool)
    for start in range(len(order)):
        if done[start]:
            continue
        kept = samples[start].copy()
        row = start
        while not done[row]:
            done[row] = True
            source = int(order[row])
            samples[row] = kept if source == start else samples[source]
            row = source
    return samples


def _new_scans(scans: P440Scans) -> NDArray[np.intp]:
    """Rows of the scans that do not repeat an earlier one exactly: number, time and samples."""
    first: dict[tuple[int, int], list[int]] = {}
    rows = []
    columns = zip(scans.message_id.tolist(), scans.timestamp_ms.tolist(), strict=True)
    for row, key in enumerate(columns):
        others = first.setdefault(key, [])
        if not any(np.array_equal(scans.samples[row], scans.samples[other]) for other in others[-_ALIKE:]):
            others.append(row)
            rows.append(row)
    return np.array(rows, dtype=np.intp)


def _sort(
    message_id: NDArray[np.int64], timestamp_ms: NDArray[np.int64], lost_id: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.intp], int]:
    """Unwrapped numbers in order, the order, and how many scans are missing.

    The order is that of the times, which separates runs and undoes a sorting by text. Where numbers and times
    agree better in the order of the file (a restarted radar has the same times again), the scans of each run
    in it are sorted by number.
    """
    number = unwrap(message_id, 1 << 16)
    time = unwrap(timestamp_ms, 1 << 32)
    order = np.lexsort((number, time))
    by_time = unwrap(message_id[order], 1 << 16)
    if _disorder(by_time, time[order]) <= _disorder(number, time):
        number = by_time
        run = np.cumsum(np.diff(by_time, prepend=by_time[0]) < 0, dtype=np.int64)
    else:
        run = _runs(number)
        order = np.lexsort((number, run))
        number, run = number[order], run[order]
    steps = np.diff(number)[np.diff(run) == 0]
    missing = int(np.maximum(steps - 1, 0).sum())
    # Incomplete scans before the first or after the last complete one leave no gap between complete ones.
    inside = (lost_id - number.min()) % (1 << 16) <= number.max() - number.min()
    return number, order, missing + int(len(lost_id) - np.count_nonzero(inside))


def _disorder(number: NDArray[np.int64], time: NDArray[np.int64]) -> int:
    """At how many scans the number does not grow, or the time falls."""
    return int(np.count_nonzero((np.diff(number) <= 0) | (np.diff(time) < 0)))


def _runs(number: NDArray[np.int64]) -> NDArray[np.int64]:
    """The run of each scan in file order.

    One begins where the number falls by more than reordering explains, or falls and repeats later.
    """
    starts = np.zeros(len(number), dtype=np.int64)
    seen: set[int] = set()
    fall = 0
    values = number.tolist()
    for row, value in enumerate(values):
        step = value - values[row - 1] if row else 0
        if step < 0:
            fall = row
        if step < _RESTART or (value in seen and fall):
            starts[fall] = 1
            seen, fall = set(values[fall:row]), 0
        seen.add(value)
    return np.cumsum(starts)


def _flags(samples: NDArray[np.int32], scan_id: NDArray[np.int64], clip: int | None) -> NDArray[np.uint8]:
    flags = np.zeros(len(samples), dtype=np.uint8)
    flags[0] |= np.uint8(ViewFlag.FIRST)
    flags[1:][np.diff(scan_id) != 1] |= np.uint8(ViewFlag.AFTER_LOSS)
    if clip is not None:
        # Not abs(): it overflows for the most negative int32.
        clipped = (samples.max(axis=1) >= clip) | (samples.min(axis=1) <= -clip)
        flags[clipped] |= np.uint8(ViewFlag.CLIPPED)
    return flags
