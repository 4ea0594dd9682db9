"""Scans in MATLAB files as the vendor's log reader returns them: the structs `cfg` and `scn`.

`scn` has one element per scan with the fields msgID, srcID, Tstmp (ms), Tstrt, Tstp (ps), Nbin (step, bins),
Nfilt, antID, Nscn and scn (samples); or one element whose fields hold all scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import BINS_PER_SAMPLE
from tagid.counting import counted
from tagid.errors import FileFormatError
from tagid.metadata import RadarInfo, RadarSettings
from tagid.radar.messages import MAX_SAMPLES_PER_SCAN
from tagid.storage.p440 import MAX_NODES, RAW, P440Scans, choose_node, p440_capture

_NEEDED: Final = ("scn", "tstrt", "tstmp")
_FIELDS: Final = {
    "msgid": 0xFFFF, "srcid": 0xFFFFFFFF, "tstmp": 0xFFFFFFFF, "tstrt": 2**31 - 1, "tstp": 2**31 - 1,
    "nbin": 0xFFFF, "nfilt": 0xFF, "antid": 0xFF,
}  # fmt: skip
"""Field of a scan, in lower case -> its largest value."""
_DEFAULTS: Final = {"nbin": BINS_PER_SAMPLE, "nfilt": RAW, "antid": 2, "srcid": 0, "tstp": 0}
_CONFIG: Final = {
    "nodeid": "node_id", "tstrt": "scan_start_ps", "tstp": "scan_stop_ps", "nbin": "resolution_bins",
    "bii": "base_integration_index", "iant": "antenna_mode", "gtmt": "transmit_gain", "ichan": "code_channel",
}  # fmt: skip


def read_scans(
    path: Path, variables: dict[str, Any], cable_delay_ps: float, node: int | None
) -> Capture | None:
    """The capture of the vendor's structs among the variables of a file; None where there are none.

    Raises:
        FileFormatError: values that are not those of a P440.
        UsageError: several radars and no `node`, or no scan of that one.
    """
    scans = [scan for value in variables.values() for scan in _scans(path, value)]
    if not scans:
        return None
    nodes: dict[int, int] = {}
    for scan in scans:
        if scan["srcid"] in nodes or len(nodes) < MAX_NODES:
            nodes[scan["srcid"]] = nodes.get(scan["srcid"], 0) + 1
    chosen = choose_node(path, nodes, node)
    scans = [scan for scan in scans if scan["srcid"] == chosen]
    wanted = RAW if any(scan["nfilt"] == RAW for scan in scans) else scans[0]["nfilt"]
    kept = [scan for scan in scans if scan["nfilt"] == wanted]
    first = kept[0]

    def grid(scan: dict[str, Any]) -> tuple[int, int, int]:
        return scan["tstrt"], scan["nbin"], len(scan["scn"])

    same = [scan for scan in kept if grid(scan) == grid(first)]
    ignored = []
    if filtered := len(scans) - len(kept):
        ignored.append(f"{counted(filtered, 'filtered scan')} of the same radar")
    if others := len(kept) - len(same):
        ignored.append(f"{counted(others, 'scan')} with another window")
    configs = [config for value in variables.values() for config in _configs(value)]
    config = next(
        (config for config in reversed(configs) if config.get("node_id") == chosen),
        configs[0] if configs else {},
    )
    window = {"scan_start_ps": first["tstrt"], "scan_stop_ps": first["tstp"]}
    numbers = {name: np.array([scan[name] for scan in same], np.int64) for name in ("msgid", "tstmp")}
    info = {"node_id": chosen, "step_bins": first["nbin"], "filter": wanted, "antenna_id": first["antid"]}
    p440 = P440Scans(
        samples=np.array([scan["scn"] for scan in same], np.int32),
        message_id=numbers["msgid"],
        timestamp_ms=numbers["tstmp"],
        host_time_ns=None,
        lost_id=np.zeros(0, np.int64),
        info={**info, **window},
        config=RadarSettings.from_json({**config, **window} if config else {}),
    )
    about = RadarInfo(source="mrm-ret", packets_ignored=filtered + others, ignored=tuple(ignored))
    return p440_capture(path, p440, cable_delay_ps, about)


def _structs(value: Any) -> Iterator[dict[str, Any]]:
    """All structs in a variable, with the names of their fields in lower case."""
    for element in value if isinstance(value, list) else ():
        yield {name.lower(): field for name, field in element.items()}
        for field in element.values():
            yield from _structs(field)


def _scans(path: Path, value: Any) -> Iterator[dict[str, Any]]:
    """The scans in a variable: its fields, in lower case, as whole numbers, and the samples."""
    number = 0
    for element in _structs(value):
        fields = {name: field for name, field in element.items() if isinstance(field, np.ndarray)}
        if not all(name in fields for name in _NEEDED) or not fields["scn"].size:
            continue
        count = fields["tstmp"].size
        samples = fields["scn"]
        if samples.dtype.kind not in "iuf" or samples.ndim != 2 or samples.size % max(count, 1):
            raise FileFormatError(f"{path}: scn.scn has shape {samples.shape} and dtype {samples.dtype}")
        rows = samples.reshape(1, -1) if count == 1 else samples if len(samples) == count else samples.T
        if len(rows) != count or rows.shape[1] > MAX_SAMPLES_PER_SCAN:
            raise FileFormatError(
                f"{path}: scn.scn has shape {samples.shape} for {counted(count, 'time stamp')}"
            )
        plausible = np.isfinite(rows).all() and rows.min() >= -(2**31) and rows.max() < 2**31
        whole = rows.astype(np.int32) if plausible else None
        if whole is None or not np.array_equal(whole, rows):
            raise FileFormatError(f"{path}: scn.scn holds samples that are not whole numbers of a P440")
        columns = {
            name: _column(
                path, name, fields[name] if name in fields else _default(name, number, count), count
            )
            for name in _FIELDS
        }
        for at in range(count):
            yield {name: int(column[at]) for name, column in columns.items()} | {"scn": whole[at]}
        number += count


def _default(name: str, number: int, count: int) -> NDArray[Any]:
    return (
        np.array([_DEFAULTS.get(name, 0)]) if name != "msgid" else np.arange(number, number + count) & 0xFFFF
    )


def _column(path: Path, name: str, values: NDArray[Any], count: int) -> NDArray[np.int64]:
    flat = values.reshape(-1)
    least = -_FIELDS[name] if name in ("tstrt", "tstp") else 0
    if flat.size not in (1, count) or flat.dtype.kind not in "iuf" or not np.isfinite(flat).all():
        raise FileFormatError(f"{path}: scn.{name} is not one number per scan")
    if flat.min() < least or flat.max() > _FIELDS[name] or not np.array_equal(flat, np.rint(flat)):
        raise FileFormatError(f"{path}: scn.{name} reaches {flat.max():g}, which no P440 sends")
    return np.broadcast_to(flat.astype(np.int64), count) if flat.size == 1 else flat.astype(np.int64)


def _configs(value: Any) -> Iterator[dict[str, int]]:
    for fields in _structs(value):
        if "bii" not in fields:
            continue
        numbers = {ours: np.asarray(fields[theirs]) for theirs, ours in _CONFIG.items() if theirs in fields}
        yield {
            name: int(number.item())
            for name, number in numbers.items()
            if number.size == 1 and number.dtype.kind in "iuf" and abs(number.item()) < 2**32
        }
