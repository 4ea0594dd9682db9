"""Computes states from the scans during recording, in separate threads.

The recording is never blocked: a slow computer shows fewer frames, but every scan is included in the next
one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M
from tagid.errors import DataError, TagidError
from tagid.geometry import ImageGrid
from tagid.imaging.types import Image
from tagid.live.angles import GrowingSpeed, LiveAngles
from tagid.live.ats import GrowingAts
from tagid.live.state import LiveState, Phase, Sinogram
from tagid.live.views import TOLERANCE_RAD, GrowingViews, capture_so_far, evidence_of, whole_image
from tagid.motion.device import Motion
from tagid.pipeline.settings import ImagingSettings
from tagid.signal import analytic, noise_power_of, snr_db
from tagid.workers import Worker

if TYPE_CHECKING:
    from tagid.pipeline.answer import Identification
    from tagid.radar.assembler import Scan
    from tagid.recording.session import Session
    from tagid.recording.stream import ScanStream
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout

MAX_PIXELS = 128
"""Pixels per side of the live image: screens show no more next to the other figures."""
FRAME_S = 0.12
"""Shortest time between two frames, s."""
_ROWS = 240
_JUDGED_SCANS = 64
_JOIN_S = 30.0


@dataclass(frozen=True)
class LiveSettings:
    """Inputs of the live view other than the scans: the motion, the registry's contents, and the settings."""

    motion: Motion
    layouts: Sequence[Layout] = ()
    signatures: Sequence[Signature] = ()
    registry_version: int | None = None
    imaging: ImagingSettings = field(default_factory=ImagingSettings)


class LiveView:
    """Computes states from scans, the newest in `state`; use it as a context manager.

    States are made on a worker thread; a second one reads the tag as soon as a turn is complete. On these
    threads `tell` is called with every new state; it must not block for long.
    """

    def __init__(
        self, settings: LiveSettings, tell: Callable[[LiveState], None] = lambda state: None
    ) -> None:
        self._settings = settings
        self._tell = tell
        self._lock = threading.Lock()
        self._hurry = threading.Event()
        self._stream: ScanStream | None = None
        self._stored: Capture | None = None
        self.state = LiveState()
        self._answer_at: float | None = None
        self._no_image = False
        self._stopped = ""
        grid = settings.imaging
        self._grid = ImageGrid(grid.extent_m, min(grid.pixels, MAX_PIXELS))
        self._angles = LiveAngles(settings.motion)
        unknown = settings.motion.nominal_s is None and not settings.motion.measures
        self._speed = GrowingSpeed() if unknown else None
        self._views = GrowingViews(self._grid, settings.layouts, settings.imaging)
        self._ats = GrowingAts(self._grid, settings.imaging) if settings.imaging.method == "ats" else None
        self._ats_image: Image | None = None
        self._worker: Worker | None = None
        self._fitter: Worker | None = None
        self._reader: Worker | None = None
        self._read_turn: float | None = None

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def silent_s(self) -> float:
        """Seconds for which the recording has waited for its next scan; 0 while it does not wait."""
        stream = self._stream
        return 0.0 if stream is None else stream.silent_s

    def began(self, stream: ScanStream) -> None:
        """Follow a recording; the function for `Watch.began`."""
        self._stream = stream
        self._publish(phase=Phase.TURNING)
        self._worker = self._start(lambda: self._work(stream), "live-view", "the live view stopped")

    def resolving(self, resolve: Callable[[Capture, str], Capture]) -> Callable[[Capture, str], Capture]:
        """The function for `Watch.resolve` that also passes the estimated period to the view."""

        def learning(capture: Capture, motion: str) -> Capture:
            result = resolve(capture, motion)
            resolved = result.motion.resolved
            # A multiple of the shortest repetition is resolved by imaging, and then counts as given.
            unknown = self._settings.motion.nominal_s is None
            if resolved is not None and resolved.period_s and (unknown or resolved.source == "data"):
                self._angles.learn(resolved.period_s)
            return result

        return learning

    def settle(self, prepared: Capture, answer: Identification) -> None:
        """Set the answer of the stored capture, and the prepared capture for the last frame."""
        self._answered(answer)
        self._stored = prepared
        self._hurry.set()

    def explain(self, answer: Identification) -> None:
        """Replace the final answer by the same one with its likely causes."""
        self._publish(answer=answer)

    def show(self, image: Image, sinogram: Sinogram | None = None) -> None:
        """Replace the image of the growing views by that of the whole recording; also a sinogram."""
        self._publish(image=image, sinogram=sinogram or self.state.sinogram)

    def reading(self) -> None:
        """Show that a stored recording is being read."""
        self._publish(phase=Phase.READING)

    def note(self, text: str) -> None:
        self._publish(note=text)

    def fail(self, error: TagidError) -> None:
        self._publish(phase=Phase.FAILED, note=f"{error.message}. {error.remedy}".strip())

    def close(self) -> None:
        """End the threads; the state is kept. After `settle` the last frame is still computed."""
        self._hurry.set()
        workers = [worker for worker in (self._worker, self._fitter, self._reader) if worker is not None]
        if all(worker.join(_JOIN_S) for worker in workers):
            self._forget()

    def _forget(self) -> None:
        """Release the scans, their sums and the recording, which in turn refers to this view.

        Garbage collection would find that cycle only after many scans of a station, each with sums of about
        10 MB.
        """
        self._stream = self._stored = None
        self._views = GrowingViews(self._grid, (), self._settings.imaging)
        self._ats = self._ats_image = None

    def _publish(self, *, after: Phase | None = None, **changes: object) -> None:
        """Publish the next state; with `after` only if the newest one is of this phase."""
        with self._lock:
            if after not in (None, self.state.phase):
                return
            state = self._change(changes)
        self._tell(state)

    def _change(self, changes: dict[str, object]) -> LiveState:
        """The next state; the lock is held."""
        frame = self.state.frame + 1
        self.state = replace(self.state, frame=frame, **changes)  # type: ignore[arg-type]
        return self.state

    def _answered_ahead(self, answer: Identification) -> None:
        """Publish the answer of the scans so far, unless that of the stored capture is available."""
        with self._lock:
            if self.state.final:
                return
            before = self.state.answer
            if before is None or not _same(before, answer):
                self._answer_at = time.monotonic()
            state = self._change({"answer": answer})
        self._tell(state)

    def _answered(self, answer: Identification) -> None:
        """Publish the answer of the stored capture."""
        with self._lock:
            before = self.state.answer
            if before is None or self._answer_at is None or not _same(before, answer):
                self._answer_at = time.monotonic()
            newest_s = None if self._stream is None else self._stream.newest_s
            after = None if newest_s is None else self._answer_at - newest_s
            state = self._change(
                {"answer": answer, "final": True, "answer_after_s": after, "phase": Phase.DONE}
            )
        self._tell(state)

    def _start(
        self,
        work: Callable[[], None],
        name: str,
        stopped: str,
        unwanted: Callable[[], bool] | None = None,
    ) -> Worker:
        """Start a worker whose failure is a remark in the state and costs the recording nothing."""
        worker = Worker(work, name, lambda error: self._remark(stopped, error), unwanted)
        try:
            worker.start()
        except RuntimeError as error:
            self._remark(f"no {name}", error)
        return worker

    def _remark(self, stopped: str, error: BaseException) -> None:
        why = error.message if isinstance(error, TagidError) else f"unexpected {type(error).__name__}"
        # The publication itself may be what failed; the state keeps the remark.
        with suppress(Exception):
            self._publish(note=f"{stopped} ({why}); the recording continues")

    def _work(self, stream: ScanStream) -> None:
        """The worker thread: publish new scans until the recording has ended, then the stored capture."""
        shown = 0
        while stream.wait(shown) and not self._hurry.is_set():
            began = time.monotonic()
            scans = stream.since()
            shown = len(scans)
            self._take(stream, scans)
            self._hurry.wait(max(0.0, FRAME_S - (time.monotonic() - began)))
        self._publish(after=Phase.TURNING, phase=Phase.READING)
        self._hurry.wait()
        if self._stored is not None:
            self._count_the_rest(stream)
            self._last_frame(self._stored)

    def _take(self, stream: ScanStream, scans: list[Scan]) -> None:
        """Add the new ones of all scans so far to the views, and publish."""
        session = stream.session
        period_s = self._speed.period_s(session, scans) if self._speed and not stream.ended else None
        if period_s is not None:
            self._angles.learn(period_s)
        angles = self._angles.of(scans)
        shown: dict[str, Any] = {}
        if angles is not None:
            shown["turned_rad"] = float(np.abs(angles).max())
        if self._angles.stopped != self._stopped:
            self._stopped = shown["note"] = self._angles.stopped
        if angles is not None and session.plan.axis_distance_m is not None and not self._no_image:
            # Before the views: where the speed is found late, all of them are formed at once.
            self._read_ahead(stream, scans, angles)
            try:
                self._views.update(capture_so_far(session, scans), angles, self._hurry.is_set)
                image, evidence = self._views.image(), self._views.evidence()
            except DataError as error:
                self._no_image = True
                shown["note"] = f"no live image: {error.message}"
            else:
                self._fit_ahead(stream)
                image = self._ats_image or image
                shown |= {"views": self._views.count, "image": image, "evidence": evidence}
        self._publish(**_recorded(session, scans), **shown)

    def _count_the_rest(self, stream: ScanStream) -> None:
        """Publish what was recorded: the last scans of a late view, or all of them, were in no frame."""
        scans = stream.since()
        if not scans:
            return
        # Also where all scans were shown: angles may have become known since.
        angles = self._angles.of(scans)
        turned = self.state.turned_rad if angles is None else float(np.abs(angles).max())
        self._publish(**_recorded(stream.session, scans), turned_rad=turned)

    def _fit_ahead(self, stream: ScanStream) -> None:
        """Continue the fit of the method ats with the new views, in its own thread."""
        capture, ats = self._views.capture, self._ats
        busy = self._fitter is not None and self._fitter.alive
        if ats is None or capture is None or busy or stream.ended or not ats.due(capture.views):
            return

        def fit() -> None:
            self._ats_image = ats.go_on(capture)

        self._fitter = self._start(fit, "live-fitter", "the fit ahead stopped")

    def _read_ahead(self, stream: ScanStream, scans: list[Scan], angles: NDArray[np.float64]) -> None:
        """Read the tag when a turn is complete, while the overlap is still being recorded."""
        turned = float(np.abs(angles).max())
        per_scan = turned / max(len(angles) - 1, 1)
        busy = self._reader is not None and self._reader.alive
        # After the last scan the stored capture is about to be read.
        if busy or stream.ended or not self._settings.layouts or turned < 2 * np.pi - 0.5 * per_scan:
            return
        if self._read_turn is not None and abs(per_scan / self._read_turn - 1) * 2 * np.pi < TOLERANCE_RAD:
            return
        self._read_turn = per_scan
        capture = replace(capture_so_far(stream.session, scans), angles_rad=angles.copy())
        # Once the recording has ended it would only delay the reading of the stored capture.
        self._reader = self._start(
            lambda: self._read(capture), "live-reader", "no answer ahead", lambda: stream.ended
        )

    def _read(self, capture: Capture) -> None:
        from tagid.pipeline.identify import identify
        from tagid.pipeline.prepared import prepare

        settings = self._settings
        answer = identify(
            prepare(capture, extent_m=settings.imaging.extent_m),
            settings.layouts,
            settings.imaging,
            settings.registry_version,
            settings.signatures,
        )
        self._answered_ahead(answer)

    def _last_frame(self, capture: Capture) -> None:
        """Image and evidence of the stored capture: every view once, with its final angle.

        On a busy machine the evidence has been computed of a few views only.
        """
        if capture.angles_rad is None or capture.axis_distance_m is None:
            return
        if self._ats is None:
            image = whole_image(capture, self._grid, self._settings.imaging)
        else:
            if self._fitter is not None and not self._fitter.join(_JOIN_S):
                return
            image = self._ats.go_on(capture, last=True)
        self._publish(image=image, views=capture.views)
        self._publish(evidence=evidence_of(capture, self._settings.layouts, self._settings.imaging))


def _recorded(session: Session, scans: list[Scan]) -> dict[str, Any]:
    """Fields of the state that need the scans so far and no angles; at least one scan."""
    sinogram, snr = _sinogram(session, scans)
    return {
        "scans": len(scans),
        "lost": session.intake.scans_lost,
        "seconds": (scans[-1].radar_time_ms - scans[0].radar_time_ms) * 1e-3,
        "sinogram": sinogram,
        "snr_db": snr,
    }


def _sinogram(session: Session, scans: list[Scan]) -> tuple[Sinogram | None, float | None]:
    if len(scans) < 3:
        return None, None
    every = -(-len(scans) // _ROWS)
    samples = np.stack([scan.samples for scan in scans[::every]]).astype(np.float64)
    changing = analytic(samples - samples.mean(axis=0))
    recent = np.stack([scan.samples for scan in scans[-_JUDGED_SCANS:]]).astype(np.float64)
    snr, _ = snr_db(changing, noise_power_of(analytic(recent)))
    start = session.config.range_start_m(session.plan.cable_delay_ps)
    rows = np.abs(changing).astype(np.float32)
    return Sinogram(rows, (start, start + RANGE_STEP_M * (rows.shape[1] - 1))), snr


def _same(first: Identification, second: Identification) -> bool:
    """Whether two answers are the same for the user."""
    names = (first.reading and first.reading.layout, second.reading and second.reading.layout)
    return first.status == second.status and names[0] == names[1]
