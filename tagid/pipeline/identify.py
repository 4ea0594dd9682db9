"""From a prepared capture to a name, without printing: one function for commands, reports and notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tagid.capture import Capture
from tagid.counting import counted
from tagid.errors import DataError
from tagid.imaging.bandcheck import sample_fault
from tagid.metadata import Ending
from tagid.pipeline.answer import Identification
from tagid.pipeline.prepared import PreparedCapture, as_prepared, check_moved
from tagid.pipeline.resolve import stopped_words
from tagid.pipeline.settings import ImagingSettings, Stopwatch, TagPriors
from tagid.reading.calibration import Bound
from tagid.reading.reading import Reading
from tagid.reading.verdict import Code
from tagid.signal import median

if TYPE_CHECKING:
    from tagid.enrolling.averaging import Sighting
    from tagid.reading.ending import EndingCalibration
    from tagid.reading.reader import ReaderSettings
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.bodies.spectra import Spectra
    from tagid.tags.layouts.layout import Layout

SURE = "sure"
"""`Ending.reason` of a scan that ended because the answer was certain."""
WHOLE_TURN = 0.97
"""Smallest share of a revolution that counts as complete: a gap of 10 degrees does not impair reading."""
LEAST_NAMED = 0.58
"""Smallest share of a revolution that names an object: a reflector on an opaque object is seen up to 75
degrees aside, so with a gap of more than 150 degrees some side was not seen, and what is there may be more
than the layout has."""


_VIEW_RAD = np.deg2rad(10)
"""Width of the sector that one view shows at most, rad: a gap of this width does not impair reading."""


@dataclass(frozen=True)
class Gap:
    """The widest gap between the directions from which an object was seen.

    Attributes:
        share: share of a turn that is covered: without this gap and others of more than 10 degrees, each less
            the usual step. A single view far from the others covers no side.
        sides: indexes of the two views beside the gap.
        shows_every_side: whether the part that is covered may name an object.
    """

    share: float
    sides: tuple[int, int]
    shows_every_side: bool


def widest_gap(capture: Capture) -> Gap | None:
    """The widest gap; None for a single view, or where neither angles nor positions are known yet.

    Antenna positions on any path cover the directions in which they lie from the origin.
    """
    if capture.views < 2:
        return None
    directions = capture.angles_rad
    if directions is None:
        ends = [end for end in (capture.antenna_positions_m, capture.receive_positions_m) if end is not None]
        if not ends:
            return None
        x, y = np.mean([end[:, :2] for end in ends], axis=0).T
        directions = np.arctan2(y, x)
    wrapped = np.mod(directions, 2 * np.pi)
    order = np.argsort(wrapped)
    gaps = np.diff(np.append(wrapped[order], wrapped[order[0]] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    step = median(gaps)
    excess = gaps - step
    uncovered = excess[widest] + excess[(excess > _VIEW_RAD) & (np.arange(len(gaps)) != widest)].sum()
    share = float(np.clip(1 - uncovered / (2 * np.pi), 0, 1))
    # A coarse step makes no direction seen: in this gap a view counts for its own width.
    blind = (gaps[widest] - min(step, _VIEW_RAD)) / (2 * np.pi)
    every = share >= LEAST_NAMED and blind <= 1 - LEAST_NAMED
    return Gap(share, (int(order[widest]), int(order[(widest + 1) % len(order)])), bool(every))


def share_seen(captures: Sequence[Capture]) -> float | None:
    """The share of a turn that the best of several recordings covers; None if it is unknown of all."""
    return max((gap.share for gap in map(widest_gap, captures) if gap is not None), default=None)


def ended_early(capture: Capture) -> bool:
    """Whether the recording ended on purpose before the turn did, because the answer was certain."""
    ended = capture.radar.ended
    return ended is not None and ended.reason == SURE


def of_the_part(reading: Reading, captures: Sequence[Capture]) -> Reading:
    """The reading of one capture, or of several jointly, as far as the parts of a turn that were seen carry
    it.

    What they show is withheld, but for two likely names, unless one of the captures shows every side of the
    object: in several, the object may lie in other directions. The bound on false accept is withheld where a
    capture is not of a whole turn, for which it is calibrated, unless the recording ended early with its own.
    """
    gaps = [widest_gap(capture) for capture in captures]
    shares = [0.0 if gap is None else gap.share for gap in gaps]
    unseen = not any(gap is not None and gap.shows_every_side for gap in gaps)
    if unseen or any(
        share < WHOLE_TURN and not ended_early(capture)
        for share, capture in zip(shares, captures, strict=True)
    ):
        reading = replace(reading, bound=None)
    if not unseen or reading.status == "ambiguous":
        return reading
    shows = {
        "identified": f"the scans show {reading.layout}, but not every side",
        "no_tag": "no tag shows",
    }.get(reading.status, reading.reason)
    resolved = captures[int(np.argmax(shares))].motion.resolved
    if resolved is None or resolved.standstill is None or reading.status == "no_tag":
        covered = f"the views cover {max(shares) * 360:.0f} of 360 degrees"
        return reading.refused(Code.PARTIAL, f"{covered}, and in these {shows}")
    return reading.refused(Code.STOPPED, f"{stopped_words(resolved.standstill)}, and until then {shows}")


def ended_answer(
    answer: Identification,
    ending: Ending | None,
    false_accept: float,
    calibration: EndingCalibration | None = None,
) -> Identification:
    """The answer of a capture that ended early, with the bound of the whole procedure.

    The recording goes on for some scans while a look is read; a name that these contradict is withdrawn.
    Other answers are returned unchanged. `false_accept` is that of the whole scan, `calibration` None for the
    package's own.
    """
    reading = answer.reading
    if ending is None or ending.reason != SURE or reading is None:
        return answer
    from tagid.reading.ending import EndingCalibration
    from tagid.reading.looks import SPENT

    if answer.status == "identified" and reading.layout == ending.layout:
        known = calibration or EndingCalibration.shipped()
        bound = Bound(
            ending.p_value or 1.0, SPENT * false_accept, ending.turns or 0, known.stratum, known.population
        )
        return replace(answer, reading=replace(reading, bound=bound))
    if answer.status != "identified":
        return answer
    reason = f"the first {ending.share or 0:.0%} of the turn show {ending.layout}, all scans {reading.layout}"
    withdrawn = replace(reading.refused(Code.DISAGREE, reason), bound=None)
    return replace(answer, status="unknown", reading=withdrawn, label="")


def reader_settings(settings: ImagingSettings, spent: float = 0.0) -> ReaderSettings:
    """Settings of the reader; a share of its false-accept probability was spent on parts of the turn."""
    from tagid.reading.columns import Priors
    from tagid.reading.reader import ReaderSettings

    return ReaderSettings(
        settings.false_accept * (1 - spent),
        Priors(settings.priors.centre_sigma_m, settings.priors.radius_sigma_m),
        settings.direction_known,
    )


_FEWEST_VIEWS = 3
READ_WAVELENGTHS_M = (0.037, 0.150)
"""Shortest and longest wavelength of scans in which tags are read: 8 and 2 GHz in vacuum."""
MIN_SIGNATURE_VIEWS = 24
"""Views per capture for a signature: two per harmonic of a cup, one per two harmonics of a helmet, for which
three captures together provide enough."""


def identify(
    capture: Capture | PreparedCapture,
    layouts: Sequence[Layout],
    settings: ImagingSettings | None = None,
    registry_version: int | None = None,
    signatures: Sequence[Signature] = (),
    spent: float = 0.0,
) -> Identification:
    """Name the object of a prepared capture; arguments and errors as `tagid.operate.turn.identify`.

    The tag is read in the scans and not in an image, whose artefacts could mislead it. `spent` is the share
    of the false-accept probability that was used before, by readings of parts of the turn; this reading has
    the rest.
    """
    from tagid.reading.reader import read

    prepared = as_prepared(capture, settings)
    _check_views(prepared)
    watch = Stopwatch()
    scans = prepared.scans(prepared.settings.preprocessing(matched_filter=False))
    with watch.stage("read"):
        reading = read(scans, layouts, reader_settings(prepared.settings, spent), signatures)
        reading = of_the_part(reading, [prepared.given])
    reading = _noted(prepared, reading)
    seconds = {**prepared.watch.seconds, **watch.seconds}
    return _answer(reading, [prepared.given], _labels(layouts, signatures), registry_version, seconds)


def _labels(layouts: Sequence[Layout], signatures: Sequence[Signature]) -> dict[str, str]:
    """Readable names of all that can be named; a layout's precedes that of an object of its name."""
    objects = {signature.name: signature.label for signature in signatures if signature.kind == "object"}
    return objects | {layout.name: layout.label for layout in layouts}


def _answer(
    reading: Reading,
    captures: Sequence[Capture],
    labels: dict[str, str],
    registry_version: int | None,
    seconds: dict[str, float],
) -> Identification:
    """The answer from one capture, or from several jointly."""
    return Identification(
        reading.status,
        reading,
        captures[0].uuid if len(captures) == 1 else None,
        registry_version,
        labels.get(reading.layout or "", ""),
        dict(seconds),
        coverage=share_seen(captures),
    )


def without_body(prepared: PreparedCapture, answer: Identification) -> PreparedCapture:
    """The prepared capture minus the echo of the body found by the reader, for a picture of the tag.

    Returns the capture unchanged if no body hypothesis was selected.
    """
    from tagid.reading.subtract import without_body as subtracted

    winner = None if answer.reading is None else answer.reading.winner
    if winner is None or not winner.estimate.model.body_columns:
        return prepared
    return PreparedCapture(subtracted(prepared.given, winner), prepared.settings)


def identify_together(
    given: Sequence[Capture | PreparedCapture],
    layouts: Sequence[Layout],
    settings: ImagingSettings | None = None,
    registry_version: int | None = None,
    signatures: Sequence[Signature] = (),
) -> tuple[Identification, list[Identification]]:
    """Name the object of several captures jointly, and of each alone (see `tagid.reading.several`).

    Arguments and errors are those of `identify`; prepared captures have the same settings.
    """
    from tagid.reading.reader import read_together

    watch = Stopwatch()
    prepared = [as_prepared(capture, settings) for capture in given]
    captures = [capture.given for capture in prepared]
    settings = prepared[0].settings if prepared else ImagingSettings()
    for capture in prepared:
        _check_views(capture)
    recordings = [capture.scans(settings.preprocessing(matched_filter=False)) for capture in prepared]
    with watch.stage("read"):
        joint, alone = read_together(recordings, layouts, reader_settings(settings), signatures)
        pairs = zip(alone, prepared, strict=True)
        alone = [_noted(capture, of_the_part(reading, [capture.given])) for reading, capture in pairs]
        joint = of_the_part(joint, captures)
    labels = _labels(layouts, signatures)
    for capture in prepared:
        watch.add(capture.watch)

    def answer(reading: Reading, of: Sequence[Capture]) -> Identification:
        return _answer(reading, of, labels, registry_version, watch.seconds)

    alone_answers = [answer(reading, [capture]) for reading, capture in zip(alone, captures, strict=True)]
    return answer(joint, captures), alone_answers


def aspect_spectra(capture: Capture, settings: ImagingSettings | None = None) -> Spectra:
    """Spectra of a prepared capture from which the signature of its object can be estimated.

    Raises DataError as `identify` does, and for free antenna positions.
    """
    from tagid.imaging.whitening import whitened
    from tagid.reading.views import fold_views
    from tagid.tags.bodies.signature import MAX_RADIUS_M, signature_wavenumbers
    from tagid.tags.bodies.spectra import Spectra

    settings = settings or ImagingSettings()
    if capture.angles_rad is None:
        raise DataError(
            "the signature of an object requires a turntable, but this capture has free antenna positions",
            "Record the object on a turntable, or enroll its reflectors with `point`.",
        )
    if capture.views < MIN_SIGNATURE_VIEWS:
        raise DataError(
            f"the capture has {counted(capture.views, 'view')}, a signature needs {MIN_SIGNATURE_VIEWS}",
            "Record more views per turn.",
        )
    prepared = PreparedCapture(capture, settings)
    scans = prepared.scans(settings.preprocessing(matched_filter=False))
    wavenumbers = signature_wavenumbers(capture.center_frequency_hz, capture.bandwidth_hz)
    if len(wavenumbers) < 3:
        raise DataError(
            f"a band of {capture.bandwidth_hz / 1e6:.0f} MHz contains {len(wavenumbers)} frequencies of a "
            "signature, but 3 are needed",
            "Correct the capture's bandwidth_hz.",
        )
    return Spectra.of(fold_views(whitened(scans), MAX_RADIUS_M), wavenumbers=wavenumbers)


def sight_reflectors(capture: Capture, name: str, settings: ImagingSettings | None = None) -> Sighting:
    """Strong reflectors of a prepared capture and their covariance, without knowledge of any layout.

    Raises DataError as `identify` does.
    """
    from tagid.enrolling.averaging import MOST_SEARCHED_M, SEARCHED_M, Sighting

    prepared = PreparedCapture(capture, settings)
    settings = prepared.settings
    scans = prepared.focused(prepared.scans(settings.preprocessing_for_focus(capture, matched_filter=False)))
    radius = float(np.clip(settings.extent_m / 2 - 0.01, SEARCHED_M, MOST_SEARCHED_M))
    return Sighting.of(scans, name, radius)


def _check_views(prepared: PreparedCapture) -> None:
    views = prepared.given.views
    if views < _FEWEST_VIEWS:
        raise DataError(
            f"the capture has {counted(views, 'view')}, too few to read a tag",
            "Record at least 12 views per turn.",
        )
    check_moved(prepared.given)
    least, most = READ_WAVELENGTHS_M
    wavelength = prepared.given.wavelength_m
    if not least <= wavelength <= most:
        raise DataError(
            f"tags are read at 2 to 8 GHz, wavelengths of {least * 1e3:.0f} to {most * 1e3:.0f} mm; the "
            f"wavelength of these scans is {wavelength * 1e3:.3g} mm",
            "Image them with `tagid reconstruct`, or correct center_frequency_hz and wave_speed_m_s.",
        )
    fault = sample_fault(prepared.given)
    if fault is not None and fault.certain:
        raise DataError(fault.text, f"{fault.remedy[0].upper()}{fault.remedy[1:]}.")


def _noted(prepared: PreparedCapture, reading: Reading) -> Reading:
    """The reading, with a note where its bound does not hold."""
    if reading.status == "identified" and reading.bound and prepared.settings.priors != TagPriors():
        note = "the bound on false accept was calibrated with the default priors (tags.*_m)"
        return replace(reading, note=note)
    return reading
