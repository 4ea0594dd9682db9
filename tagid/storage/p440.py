"""Converts scans with a P440's numbers and timestamps to a Capture, for all file formats.

Binary recordings and the vendor's log share the grid, the wrapping counters and the signs of lost scans.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, ViewFlag
from tagid.constants import BIN_PS, SPEED_OF_LIGHT
from tagid.errors import FileFormatError, UsageError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.storage.assembly import build_capture, unwrap

MAX_NODES = 64
"""Maximum number of radars distinguished in one file."""

GRID_PS = 2
"""A requested window end this close to the actual one is considered equal: the radar's grid is 1.9 ps."""

_RESTART = -64
"""A decrease of the scan number below this is a new run in the same file; smaller ones are reordering."""


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
    """The radar whose scans to read from a file.

    Args:
        path: the file, for messages.
        scans_of: number of each radar in the file (at most `MAX_NODES`) -> amount of its data.
        node: the requested one; None selects the only one.

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
            f"Choose one with --node, e.g. --node {min(scans_of)}.",
        )
    raise UsageError(f"{path}: holds no scan of node {node}", f"It holds {shown}; choose one with --node.")


def p440_capture(path: Path, scans: P440Scans, source: str, cable_delay_ps: float) -> Capture:
    """The capture of scans: views sorted by scan number within each run, lost scans counted and marked.

    Args:
        path: the file, for messages.
        scans: the scans read from the file.
        source: name of the file's format, stored in `radar.source`.
        cable_delay_ps: two-way delay of cables and antennas to subtract from the ranges, ps.

    Raises:
        FileFormatError: the grid is invalid.
    """
    start_ps, step_bins = scans.info["scan_start_ps"], scans.info["step_bins"]
    if step_bins < 1:
        raise FileFormatError(f"{path}: the scans have a step of {step_bins} bins", "The file is damaged.")
    scan_id, order, lost = _sort(scans.message_id, scans.lost_id)
    samples = _reorder(scans.samples, order)
    radar = RadarInfo(
        source=source,
        node_id=scans.info.get("node_id", scans.config.node_id or 0),
        config=scans.config,
        scan_info=scans.info,
        cable_delay_ps=float(cable_delay_ps),
        scans_lost=lost,
    )
    host = scans.host_time_ns
    return build_capture(
        path,
        samples=samples,
        range_start_m=(start_ps - cable_delay_ps) * 1e-12 * SPEED_OF_LIGHT / 2,
        range_step_m=step_bins * BIN_PS * 1e-12 * SPEED_OF_LIGHT / 2,
        host_time_ns=None if host is None else host[order],
        radar_time_ms=unwrap(scans.timestamp_ms[order], 1 << 32).astype(np.float64),
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


def _sort(
    message_id: NDArray[np.int64], lost_id: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.intp], int]:
    """Unwrapped numbers in order, the order, and how many scans are missing."""
    number = unwrap(message_id, 1 << 16)
    run = np.concatenate([np.zeros(1, np.int64), np.cumsum(np.diff(number) < _RESTART)])
    order = np.lexsort((number, run))
    number, run = number[order], run[order]
    steps = np.diff(number)[np.diff(run) == 0]
    missing = int(np.maximum(steps - 1, 0).sum())
    # Incomplete scans before the first or after the last complete one leave no gap between complete ones.
    inside = (lost_id - number.min()) % (1 << 16) <= number.max() - number.min()
    return number, order, missing + int(len(lost_id) - np.count_nonzero(inside))


def _flags(samples: NDArray[np.int32], scan_id: NDArray[np.int64], clip: int | None) -> NDArray[np.uint8]:
    flags = np.zeros(len(samples), dtype=np.uint8)
    flags[0] |= np.uint8(ViewFlag.FIRST)
    flags[1:][np.diff(scan_id) != 1] |= np.uint8(ViewFlag.AFTER_LOSS)
    if clip is not None:
        # Not abs(): it overflows for the most negative int32.
        clipped = (samples.max(axis=1) >= clip) | (samples.min(axis=1) <= -clip)
        flags[clipped] |= np.uint8(ViewFlag.CLIPPED)
    return flags
