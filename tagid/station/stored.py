"""Stored captures on the page: a file that a browser sends is identified, a scan is replayed as if live."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from tagid.config import Config, ConfigValue
from tagid.errors import CaptureInterrupted, StorageError, TagidError, UsageError
from tagid.files import storage_error
from tagid.live.state import Sinogram
from tagid.motion.turntable import FreeTurntable
from tagid.operate.turn import draw, picture_of, read, record_turn, residuals_beside
from tagid.operate.workplace import Workplace
from tagid.pipeline.turn import resolve_turn
from tagid.recording.curves import changing_envelope
from tagid.recording.plan import RecordingPlan
from tagid.recording.recorder import Watch
from tagid.station.scans import COMMAND, Run
from tagid.station.security import MOST_UPLOAD_BYTES
from tagid.storage.importers import read_any

LEAST_FREE_BYTES = 256 << 20
"""Space that an upload leaves on the disk for scans, bytes."""
REPLAY_S = 15.0
"""Longest replay of the scans, s; longer recordings are replayed faster than they were made."""
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")
_LONGEST_NAME = 80


def received_path(folder: Path, name: str) -> Path:
    """A new path in a folder for a file that a browser sends.

    Only letters, digits, dots and hyphens of the last part of its name are used.

    >>> received_path(Path("/nowhere"), "../../my scan.tagid.h5").name
    'received-my-scan.tagid.h5'
    """
    last = _UNSAFE.sub("-", name.replace("\\", "/").rpartition("/")[2])[-_LONGEST_NAME:].strip("-.")
    stem, dot, suffix = (last or "capture").partition(".")
    number, path = 1, folder / f"received-{stem}{dot}{suffix}"
    while path.exists() or path.is_symlink():
        number += 1
        path = folder / f"received-{stem}-{number}{dot}{suffix}"
    return path


async def receive(pieces: AsyncIterator[bytes], folder: Path, name: str) -> Path:
    """Store a file that a browser sends; returns its path, which is new.

    Raises UsageError if it is empty or too large; StorageError if the disk is nearly full, or cannot be
    written.
    """
    if shutil.disk_usage(folder).free < MOST_UPLOAD_BYTES + LEAST_FREE_BYTES:
        raise StorageError(f"the disk of {folder} is nearly full", "Free some space.")
    path = received_path(folder, name)
    size = 0
    try:
        with path.open("xb") as file:
            async for piece in pieces:
                size += len(piece)
                if size > MOST_UPLOAD_BYTES:
                    raise UsageError("the file is too large", f"Send at most {MOST_UPLOAD_BYTES >> 20} MB.")
                file.write(piece)
        if not size:
            raise UsageError("the file is empty", "Send a capture.")
    except OSError as error:
        path.unlink(missing_ok=True)
        raise storage_error(error, path, "writing") from error
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path


class ReceivedRun(Run):
    """The identification of a file that a browser sent; a file that cannot be read is removed."""

    def __init__(self, number: int, place: Workplace, path: Path) -> None:
        super().__init__(number, place, FreeTurntable())
        self._setup = replace(self._setup, loading=self._setup.loading.yielding)
        self.file = path.name
        self._path = path

    def _run(self) -> None:
        with self.view:
            self.view.reading()
            answer = read(self._setup, self._path, watcher=self.view)
            if answer.error is not None:
                self._path.unlink(missing_ok=True)
                raise answer.error
            picture, remarks = self._draw(answer, self._path)
            remarks += [*answer.remarks, *self._place.remember(COMMAND, [answer.to_dict()], {})]
            self.remark = "; ".join(remarks)
        if picture is not None and answer.prepared is not None:
            capture = answer.prepared.given
            ranges = float(capture.ranges_m[0]), float(capture.ranges_m[-1])
            rows = changing_envelope(capture).astype(np.float32)
            self.view.show(picture.result.image, Sinogram(rows, ranges))


class ReplayRun(Run):
    """A stored capture, shown as if it was recorded now; nothing is stored.

    The scans are replayed through the recording of a scan into a temporary folder. The answer is that of the
    stored file.

    Raises StorageError, FileFormatError if it cannot be read; UsageError if it lacks what a replay needs.
    """

    def __init__(self, number: int, place: Workplace, path: Path) -> None:
        capture = read_any(path)
        if capture.radar.config is None or capture.radar_time_ms is None or capture.views < 2:
            raise UsageError(
                f"{path.name} holds no settings or times of a radar", "Replay a capture of `tagid scan`."
            )
        resolved = capture.motion.resolved
        period_s = None if resolved is None else resolved.period_s
        super().__init__(number, place, FreeTurntable(60 / period_s if period_s else None))
        self.file = path.name
        self._path = path
        times = capture.radar_time_ms
        seconds = float(times[-1] - times[0]) * 1e-3
        self._seconds = seconds
        self._rate = max(1.0, seconds / REPLAY_S)
        self._given = capture
        residuals = residuals_beside(picture_of(path))
        self.residuals = residuals if residuals.is_file() else None

    def _run(self) -> None:
        with self.view:
            with tempfile.TemporaryDirectory(prefix="tagid-replay-") as folder:
                try:
                    self._replay(Path(folder))
                except CaptureInterrupted:
                    raise CaptureInterrupted("the replay was stopped") from None
                except TagidError:
                    # A recording that ends within a turn; what it shows is read below.
                    if self._stop.is_set():
                        raise
            answer = read(self._setup, self._path, watcher=self.view)
            if answer.error is not None:
                raise answer.error
            self.remark = "; ".join(answer.remarks)
            drawn = draw(answer, None)
        self.view.show(drawn.result.image)

    def _replay(self, folder: Path) -> None:
        capture = self._given
        url = f"replay://{quote(str(self._path.absolute()))}?rate={self._rate:.6g}"
        place = Workplace(_with(self._place.config, {"radar.url": url, "storage.folder": str(folder)}))
        plan = RecordingPlan(
            None,
            capture.axis_distance_m,
            capture.antenna_height_m,
            capture.antenna_separation_m,
            place.config["radar.cable_delay_ps"],
            max_seconds=self._seconds + 1.0,
            motion="free",
        )
        view = self.view
        watch = Watch(resolve=view.resolving(resolve_turn), began=view.began, stop=self._stop.is_set)
        record_turn(place, plan, self.motion, watch)


def _with(config: Config, changes: dict[str, str]) -> Config:
    values = {name: ConfigValue(value, "command line") for name, value in changes.items()}
    return replace(config, values={**config.values, **values})
