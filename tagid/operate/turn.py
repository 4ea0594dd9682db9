"""One revolution from radar to answer: record, read, explain, draw. Every front end calls these functions.

A recording therefore has one answer: `tagid scan`, `tagid identify`, a report, the station and the Python API
give the same document.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.capture import Capture
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.errors import DataError, TagidError, UsageError, displayable
from tagid.operate.truth import Comparison, compare
from tagid.operate.words import headline, method_shown, notes
from tagid.pipeline.answer import Cause, Identification
from tagid.pipeline.diagnosis import other_axis_m, recording_remarks, with_causes
from tagid.pipeline.identify import ended_answer, identify_together, without_body
from tagid.pipeline.identify import identify as read_tag
from tagid.pipeline.prepared import LoadSettings, PreparedCapture, as_prepared, intake_remarks, load_capture
from tagid.pipeline.settings import ImagingSettings, Stopwatch
from tagid.result import Problem
from tagid.storage.history import utc_text
from tagid.types import Progress

if TYPE_CHECKING:
    from tagid.enrolling.registry import RegistryContents
    from tagid.live.engine import LiveView
    from tagid.motion.device import Motion
    from tagid.operate.workplace import Workplace
    from tagid.pipeline.reconstruct import Reconstruction
    from tagid.recording.plan import RecordingPlan
    from tagid.recording.recorder import Watch
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout


@dataclass(frozen=True, eq=False)
class ReadingSetup:
    """All that an answer depends on besides the recording.

    Attributes:
        loading: settings of loading a recording.
        imaging: settings of imaging and reading.
        enrolled: contents of the registry.
    """

    loading: LoadSettings
    imaging: ImagingSettings
    enrolled: RegistryContents


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded revolution, and its file."""

    capture: Capture
    path: Path


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer of one recording, or of several of one object.

    Attributes:
        identification: the reading, with likely causes and remarks; status "failed" if `error` is set.
        file: name of the (first) recording; empty for a capture in memory.
        prepared: the prepared capture; None if reading failed, and for several recordings.
        error: the error that prevented reading; None if there was none.
        alone: the answer of each recording, if there were several.
        recorded_utc: time of the (first) recording, ISO 8601; None if its file does not tell it.
        truth: comparison with the known truth of a simulated object; None for a real one.
        notes: problems that do not concern the recording, e.g. that the history could not be written.
    """

    identification: Identification
    file: str = ""
    prepared: PreparedCapture | None = None
    error: TagidError | None = None
    alone: tuple[Answer, ...] = ()
    recorded_utc: str | None = None
    truth: Comparison | None = None
    notes: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        """One of "identified", "unknown", "ambiguous", "no_tag" and "failed"."""
        return self.identification.status

    @property
    def name(self) -> str | None:
        """Name of the layout or object; None unless identified."""
        reading = self.identification.reading
        return reading.layout if reading is not None and self.status == "identified" else None

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Likely causes if nothing is named, most certain first; each has a remedy."""
        return self.identification.causes

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the recording, one sentence each."""
        return self.identification.remarks

    def to_dict(self) -> dict[str, Any]:
        """The answer document of the contract as plain JSON values (docs/formats.md)."""
        captures = [answer.prepared for answer in (self.alone or (self,))]
        notes = (prepared.given.object.note for prepared in captures if prepared is not None)
        note = next((note for note in notes if note), "")
        document = {
            "file": self.file,
            "recorded_utc": self.recorded_utc,
            "recording_note": note,
            **self.identification.to_dict(),
            "truth": None if self.truth is None else asdict(self.truth),
        }
        return {**document, "votes": [_vote(answer) for answer in self.alone]} if self.alone else document


def _vote(answer: Answer) -> dict[str, Any]:
    reading = answer.identification.reading
    return {
        "file": answer.file,
        "capture_uuid": answer.identification.capture_uuid,
        "status": answer.status,
        "layout": reading.layout if reading else None,
        "score": reading.score if reading else 0.0,
        "margin": reading.margin if reading else 0.0,
    }


def record_turn(
    place: Workplace,
    plan: RecordingPlan,
    motion: Motion | None = None,
    watch: Watch | None = None,
    radar_url: str | None = None,
) -> Recorded:
    """Record one revolution into the next free file of the workplace's folder.

    Motion and radar are those of the settings, unless others are given. Unless `watch` has `resolve`, the
    angles are determined from the scans.

    Raises:
        UsageError: the URL of radar or motion is malformed.
        DeviceError: the radar or the motion failed.
        DataError: no scan arrived.
        StorageError: a file cannot be written.
        CaptureInterrupted: the user stopped the recording.
    """
    from tagid.motion.urls import open_motion
    from tagid.pipeline.turn import resolve_turn
    from tagid.recording.plan import capture_path
    from tagid.recording.radars import open_radar
    from tagid.recording.recorder import Watch, record

    watch = watch or Watch()
    paths: list[Path] = []

    def named(path: Path) -> None:
        paths.append(path)
        watch.named(path)

    radar = open_radar(radar_url or place.radar_url(), place.config["radar.timeout_s"])
    motion = motion or open_motion(place.config["motion.url"])
    watched = replace(watch, named=named, resolve=watch.resolve or resolve_turn)
    capture = record(radar, motion, plan, capture_path(place.folder()), watched)
    return Recorded(capture, paths[-1])


def identify(
    capture: Capture | PreparedCapture,
    layouts: Sequence[Layout],
    settings: ImagingSettings | None = None,
    registry_version: int | None = None,
    signatures: Sequence[Signature] = (),
) -> Identification:
    """Name the object of a prepared capture, with remarks on the recording, and likely causes if unnamed.

    Args:
        capture: the result of `prepare`, or a `PreparedCapture`, which has its own settings.
        layouts: the candidates.
        settings: settings of imaging and reading, only with a plain capture.
        registry_version: version of the registry that `layouts` come from; stored in the answer.
        signatures: the enrolled bodies and objects.

    Returns:
        The reading, with likely causes if nothing is named, and remarks on the recording.

    Raises:
        DataError: too few views or bins, the object lies outside the range window, or the samples are no
            waveform in the assumed band.
        RegistryError: no layout is enrolled.
    """
    return _identified(as_prepared(capture, settings), layouts, registry_version, signatures)


def _identified(
    prepared: PreparedCapture,
    layouts: Sequence[Layout],
    registry_version: int | None,
    signatures: Sequence[Signature],
    watcher: LiveView | None = None,
) -> Identification:
    """As `identify`; a watcher is shown the answer before the search for causes, which takes longer."""
    given = prepared.given
    ended = given.radar.ended
    answer = read_tag(
        prepared,
        layouts,
        registry_version=registry_version,
        signatures=signatures,
        spent=0.0 if ended is None or ended.spent is None else ended.spent,
    )
    answer = ended_answer(answer, ended, prepared.settings.false_accept)
    answer = replace(answer, remarks=remarks_on(given))
    if watcher is not None:
        watcher.settle(given, answer)
    answer = with_causes(answer, prepared, layouts)
    if watcher is not None:
        watcher.explain(answer)
    return answer


def remarks_on(capture: Capture) -> tuple[str, ...]:
    """What a user should know of a recording, one sentence each: losses, its file, its samples, its turn."""
    read_as = capture
    if capture.radar.source is None:  # the notes on an own recording state its losses
        read_as = replace(capture, radar=replace(capture.radar, scans_lost=None))
    losses = notes(capture.radar) if read_as is not capture else ()
    every = (*losses, *intake_remarks(read_as), *recording_remarks(capture))
    return tuple(dict.fromkeys(every))


def read(
    setup: ReadingSetup,
    source: Path | Capture,
    file: Path | str | None = None,
    watcher: LiveView | None = None,
) -> Answer:
    """Load a recording and name its object; status "failed" if it cannot be read.

    Args:
        setup: all that the answer depends on besides the recording.
        source: the recording's file, or a capture in memory.
        file: name of the recording in document and errors; None: that of `source`.
        watcher: shows the answer before the search for causes.
    """
    name = displayable(str(source if file is None and isinstance(source, Path) else file or ""))
    watch = Stopwatch()
    uuid = source.uuid if isinstance(source, Capture) else None
    began = datetime.now(UTC)
    try:
        with watch.stage("load"):
            capture = load_capture(source, setup.loading)
        uuid = capture.uuid
        prepared = PreparedCapture(capture, setup.imaging)
        enrolled = setup.enrolled
        answer = _identified(prepared, enrolled.layouts, enrolled.version, enrolled.signatures, watcher)
    except TagidError as error:
        return failed(error, name, displayable(str(source)) if isinstance(source, Path) else "", uuid)
    answer = replace(answer, seconds={**watch.seconds, **answer.seconds})
    answer = replace(answer, remarks=(*answer.remarks, *setup.loading.against_the_rig(capture)))
    truth = compare(capture, answer, enrolled.layouts)
    return Answer(answer, name, prepared, recorded_utc=_recorded(source, capture, began), truth=truth)


def _recorded(source: Path | Capture, capture: Capture, read_at: datetime) -> str | None:
    """Time of a recording; a file without one gets the time at which it is read, which is none."""
    try:
        created = datetime.fromisoformat(capture.created_utc)
        created = created if created.tzinfo else created.replace(tzinfo=UTC)
        of_reading = isinstance(source, Path) and created >= read_at
        return None if of_reading else utc_text(created)
    except (ValueError, OverflowError):
        return None


def failed(error: TagidError, name: str, path: str = "", uuid: str | None = None) -> Answer:
    """The answer of a recording that could not be read; its error names the recording.

    The error may name it by another path, e.g. of a temporary copy; `uuid` is known if the capture was read.
    """
    message = error.message.replace(path, name) if path else error.message
    problem = Problem(error.code, message if name in message else f"{name}: {message}", error.remedy)
    return Answer(Identification("failed", None, uuid, None, error=problem), name, error=error)


def read_jointly(setup: ReadingSetup, sources: Sequence[Path | Capture]) -> Answer:
    """One joint answer from recordings of one object, files or captures; `alone` holds the answer of each.

    If nothing is named, the likely causes are those of the recordings.

    Raises DataError, FileFormatError, StorageError if one cannot be read; UsageError if none is given.
    """
    if not sources:
        raise UsageError("there is no recording to identify", "Give at least one.")
    names = [displayable(str(source)) if isinstance(source, Path) else "" for source in sources]
    enrolled = setup.enrolled
    began = datetime.now(UTC)
    kept, loaded = [0], list[PreparedCapture]()
    if len(sources) > 1:
        loaded = [PreparedCapture(load_capture(source, setup.loading), setup.imaging) for source in sources]
        kept = _distinct([prepared.given for prepared in loaded])
    copies = len(sources) - len(kept)
    copied = (f"{counted(copies, 'recording')} given again, which says nothing more",) if copies else ()
    if len(kept) == 1:
        only = read(setup, sources[0], names[0])
        if only.error is not None:
            raise only.error
        remarked = replace(only.identification, remarks=(*only.remarks, *copied))
        return replace(only, identification=remarked, alone=(only,))
    recordings, names = [loaded[i] for i in kept], [names[i] for i in kept]
    joint, readings = identify_together(
        recordings,
        enrolled.layouts,
        registry_version=enrolled.version,
        signatures=enrolled.signatures,
    )
    explained = []
    for prepared, reading, name in zip(recordings, readings, names, strict=True):
        odd = setup.loading.against_the_rig(prepared.given)
        reading = replace(reading, remarks=(*remarks_on(prepared.given), *odd))
        explained.append(Answer(with_causes(reading, prepared, enrolled.layouts), name, prepared))
    remarks = dict.fromkeys(remark for answer in explained for remark in answer.remarks)
    joint = replace(joint, remarks=(*remarks, *copied))
    if joint.status != "identified" and joint.reading is not None:
        causes = {cause.code: cause for answer in reversed(explained) for cause in answer.causes}
        advice = {
            answer.identification.reading.code: answer.identification.advice
            for answer in explained
            if answer.identification.reading is not None
        }
        joint = replace(joint, causes=tuple(causes.values()), advice=advice.get(joint.reading.code, ""))
    truths = [compare(recording.given, joint, enrolled.layouts) for recording in recordings]
    # They show the object in several poses; those of several objects have no common truth.
    alike = {truth and Comparison(truth.layout, truth.right, instead=truth.instead) for truth in truths}
    truth = alike.pop() if len(alike) == 1 else None
    recorded = _recorded(sources[0], recordings[0].given, began)
    return Answer(joint, names[0], alone=tuple(explained), recorded_utc=recorded, truth=truth)


def _distinct(captures: Sequence[Capture]) -> list[int]:
    """Numbers of the captures that are no copies of an earlier one: no two recordings have the same noise."""
    first: dict[bytes, int] = {}
    for i, capture in enumerate(captures):
        first.setdefault(hashlib.sha256(capture.samples.tobytes()).digest(), i)
    return sorted(first.values())


@dataclass(frozen=True, eq=False)
class Drawn:
    """The image of a recording, and whether the echo of a body was subtracted from it."""

    result: Reconstruction
    body_subtracted: bool


def draw(
    answer: Answer, png: Path | None, subtract_body: bool = True, progress: Progress | None = None
) -> Drawn:
    """Image one recording and write the picture with its name and reflectors, if there is a path for it.

    The echo of the body that the reader found is subtracted on request.

    Raises:
        TagidError: the error of an answer that failed.
        DataError: no image can be made, or the answer is of several recordings.
        StorageError: the picture cannot be written.
    """
    from tagid.pipeline.reconstruct import reconstruct

    if answer.prepared is None:
        raise answer.error or DataError("several recordings have no common image", "Draw them one by one.")
    prepared = answer.prepared
    if (distance_m := other_axis_m(answer.identification, prepared.given)) is not None:
        # The search for the axis does not reach so far, and with a wrong one there is nothing to be seen.
        prepared = prepared.at_axis(distance_m)
    shown = without_body(prepared, answer.identification) if subtract_body else prepared
    result = reconstruct(shown, progress=progress)
    if png is not None:
        draw_image_of(result, answer.identification, png)
    return Drawn(result, shown is not prepared)


def draw_image_of(result: Reconstruction, answer: Identification | None, png: Path) -> None:
    """Write the picture of an image; an answer's name is its title, and its reflectors are marked.

    Raises StorageError.
    """
    from tagid.report.picture import Marker, draw_image

    reading = answer.reading if answer else None
    reflectors = reading.reflectors if reading else ()
    markers = [Marker(r.x_m, r.y_m, str(i), r.matched) for i, r in enumerate(reflectors, start=1)]
    name = method_shown(result)
    title = name if answer is None else f"{headline(answer)}  ({name})"
    image = result.image
    won = reading.explained_by if reading else None
    draw_image(
        image.values,
        image.grid.extent,
        png,
        title=title,
        reflectors=markers,
        centre_m=image.centre_m,
        outline=won.outline_m if won else (),
    )


def residuals_beside(png: Path) -> Path:
    """Path of the picture of what hypotheses leave, beside that of the image."""
    return png.with_name(f"{png.stem}.left{png.suffix}")


def draw_residuals_of(answer: Identification, png: Path) -> None:
    """Write the picture of what the hypotheses that competed leave. Raises StorageError."""
    from tagid.report.residuals import draw_residuals

    if answer.reading is not None and answer.reading.residuals is not None:
        draw_residuals(answer.reading.residuals, answer.reading.hypotheses, png)


def picture_of(capture: Path) -> Path:
    """Path of the picture that belongs to a capture file."""
    return capture.with_name(f"{capture.name.removesuffix(CAPTURE_SUFFIX)}.png")
