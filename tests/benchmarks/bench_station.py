"""Memory and threads of a station over many scans of the emulator.

    python tests/benchmarks/bench_station.py [--scans 2000] [--every 50]

Prints scans, resident memory (MB), threads and open files, one line per `--every` scans.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "e2e"))
from station_harness import healthy, source


def main() -> None:
    words = argparse.ArgumentParser()
    words.add_argument("--scans", type=int, default=2000)
    words.add_argument("--every", type=int, default=50)
    asked = words.parse_args()
    with tempfile.TemporaryDirectory() as home:
        os.environ |= {"TAGID_CONFIG": f"{home}/c.toml", "TAGID_DATA": f"{home}/data"}
        from tagid.station.server import Server
        from tagid.station.station import Station

        place = Path(home) / "out"
        place.mkdir()
        station = Station(source(place), healthy)
        with Server(station, "127.0.0.1", 0):
            for number in range(1, asked.scans + 1):
                station.start(None)
                assert station.scan is not None
                station.scan.join(300)
                for path in place.iterdir():
                    path.unlink()
                if number % asked.every == 0 or number in (1, 5):
                    print(number, round(resident_mb(), 1), threading.active_count(), files(), flush=True)


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def files() -> int:
    """Open files of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


if __name__ == "__main__":
    main()
