"""One item from its file to its record and pictures: the work of a worker, local or remote.

A failing item must not end the batch, so every fault is stored in the item's record.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tagid import files
from tagid.batch.inputs import Source, filesystem
from tagid.batch.job import MAX_CAPTURE_BYTES, Answered, Job, Known, Outcome
from tagid.errors import FileFormatError, StorageError, TagidError, displayable
from tagid.operate.turn import Answer, failed, read
from tagid.pipeline.answer import Identification
from tagid.pipeline.diagnosis import axis_read_m
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import Stopwatch
from tagid.report.records import ItemRecord, Thumbnails
from tagid.report.thumbnails import draw_pictures
from tagid.storage.history import utc_text

RECORD_VERSION = 1
"""Version of an item's record; it changes only if a field is removed or changes its meaning."""
_CHUNK = 1 << 20


class Content(NamedTuple):
    """What a file holds: its sha256 in hex, and its size, bytes."""

    sha256: str | None = None
    size_bytes: int | None = None


def work(source: Source, job: Job) -> Outcome:
    """Identify one item; the content of its file never causes an exception."""
    watch = Stopwatch()
    began = time.process_time()
    content = Content()
    pictures = Thumbnails()
    try:
        with local_copy(source) as path:
            content = content_of(path)
            if content.sha256 in job.known:
                return Known(content.sha256, time.process_time() - began)
            answer = read(job.setup, path, source.name)
        if job.pictures and answer.prepared is not None:
            with watch.stage("pictures"):
                pictures = _pictures(answer.prepared, answer.identification, job)
    except TagidError as error:
        answer = _failed(source, error)
    except Exception as error:
        answer = _failed(source, unexpected(source, error))
    seconds = {**answer.identification.seconds, **watch.seconds}
    record = make_record(source, answer, seconds, content)
    return Answered(record, pictures, time.process_time() - began)


def unexpected(source: Source, error: BaseException) -> TagidError:
    """The report of an item that failed unexpectedly; the exception's type and location are logged."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "an unknown place"
    log = logging.getLogger("tagid")
    log.warning("%s: unexpected %s at %s", source.name, type(error).__name__, place)
    log.debug("%s", source.name, exc_info=error)
    return TagidError(
        f"{source.name}: unexpected {type(error).__name__}: {str(error)[:300]}",
        "This is a fault in tagid: run `tagid identify` on the file with -vv and report what it prints.",
    )


def make_record(source: Source, answer: Answer, seconds: dict[str, float], content: Content) -> ItemRecord:
    """An item's record: its answer, with file, content, s per stage and time."""
    document = {
        "schema": "tagid.report.item",
        "schema_version": RECORD_VERSION,
        "content_sha256": content.sha256,
        "size_bytes": content.size_bytes,
        **answer.to_dict(),
        "file": source.name,
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
        "time_utc": utc_text(),
    }
    return ItemRecord(document)


def failed_record(source: Source, error: TagidError) -> ItemRecord:
    """The record of an item that no worker could complete."""
    return make_record(source, _failed(source, error), {}, Content())


def content_of(path: Path) -> Content:
    """What a file holds, read in blocks. Raises StorageError, or FileFormatError if too large."""
    digest = hashlib.sha256()
    size = 0
    with files.open_regular(path) as (file, _):
        while piece := file.read(_CHUNK):
            digest.update(piece)
            size += len(piece)
            _check_size(size, str(path))
    return Content(digest.hexdigest(), size)


@contextmanager
def local_copy(source: Source) -> Iterator[Path]:
    """Context that gives the item's file as a path: the file itself or a temporary copy of a URL."""
    if not source.is_url:
        yield Path(source.location)
        return
    files, place = filesystem(source.location)
    handle, name = tempfile.mkstemp(suffix=Path(place).name[-40:])
    copy = Path(name)
    try:
        with os.fdopen(handle, "wb") as target:
            try:
                with files.open(place, "rb") as stream:
                    while piece := stream.read(_CHUNK):
                        target.write(piece)
                        _check_size(target.tell(), source.name)
            except (OSError, ValueError, NotImplementedError) as error:
                raise StorageError(
                    f"{source.name}: cannot be read: {error}",
                    "Check the URL, the network and permissions.",
                ) from error
        yield copy
    except TagidError as error:
        # The user does not know the copy's name.
        error.message = error.message.replace(str(copy), source.name)
        raise
    finally:
        copy.unlink(missing_ok=True)


def _check_size(size: int, name: str) -> None:
    if size > MAX_CAPTURE_BYTES:
        raise FileFormatError(
            f"{name}: has more than the limit of {MAX_CAPTURE_BYTES >> 20} MiB for an item of a batch",
            "Identify it alone with `tagid identify`.",
        )


def _failed(source: Source, error: TagidError) -> Answer:
    """The answer of an item that failed; its message does not depend on the path that was read."""
    return failed(error, source.name, displayable(source.location))


def _pictures(prepared: PreparedCapture, answer: Identification, job: Job) -> Thumbnails:
    # The report's pictures show nothing outside their extent, and the search takes a third of an item.
    result = reconstruct(pictured(prepared, answer), tell_outside=False)
    named = answer.reading.layout if answer.reading else None
    layout = next((layout for layout in job.setup.enrolled.layouts if layout.name == named), None)
    return draw_pictures(prepared.given, result, answer, layout)


def pictured(prepared: PreparedCapture, answer: Identification) -> PreparedCapture:
    """The capture at the axis distance that the reading found, which need not be searched again.

    Only a name without a body determines it; the pictures do not show how well they predict held-out views.
    """
    distance_m = axis_read_m(answer, prepared.given)
    if distance_m is None or prepared.pulse_estimate is not None:
        return prepared
    return prepared.at_axis(distance_m, held_out=False)
