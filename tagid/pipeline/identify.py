"""From a prepared capture to a name, without printing: one function for commands, reports and notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tagid.capture import Capture
from tagid.counting import counted
from tagid.errors import DataError
from tagid.imaging.bandcheck import sample_fault
from tagid.imaging.preprocess import PreprocessSettings
from tagid.pipeline.answer import Identification
from tagid.pipeline.coverage import of_the_part, share_seen
from tagid.pipeline.prepared import PreparedCapture, as_prepared, check_moved
from tagid.pipeline.reading import reader_settings
from tagid.pipeline.settings import ImagingSettings, Stopwatch, TagPriors

if TYPE_CHECKING:
    from tagid.enrolling.averaging import Sighting
    from tagid.reading.hypothesis import Hypothesis
    from tagid.reading.reading import Reading
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.bodies.spectra import Spectra
    from tagid.tags.layouts.layout import Layout
    from tagid.tags.network.second_look import SecondLook

_FEWEST_VIEWS = 3
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
    """Name the object of a prepared capture.

    The tag is read in the scans and not in an image, whose artefacts could mislead it.

    Args:
        capture: the result of `prepare`, or a `PreparedCapture`, which has its own settings.
        layouts: the candidates.
        settings: only with a plain capture.
        registry_version: stored in the answer.
        signatures: enrolled bodies and objects.
        spent: share of the false-accept probability that was used before, by readings of parts of the turn;
            this reading has the rest.

    Raises:
        DataError: too few views or bins, the object lies outside the range window, or the samples are no
            waveform in the assumed band.
        RegistryError: no layout is enrolled.
    """
    from tagid.reading.reader import read

    prepared = as_prepared(capture, settings)
    _check_views(prepared)
    watch = Stopwatch()
    scans = prepared.scans(prepared.settings.preprocessing(matched_filter=False))
    with watch.stage("read"):
        reading = read(scans, layouts, reader_settings(prepared.settings, spent), signatures)
        reading = of_the_part(reading, [prepared.given])
    with watch.stage("look again"):
        reading, second = _looked_at_again(prepared, reading)
    label = _labels(layouts, signatures).get(reading.layout or "", "")
    seconds = {**prepared.watch.seconds, **watch.seconds}
    return Identification(
        reading.status,
        reading,
        prepared.given.uuid,
        registry_version,
        label,
        seconds,
        second=second,
        coverage=share_seen([prepared.given]),
    )


def _labels(layouts: Sequence[Layout], signatures: Sequence[Signature]) -> dict[str, str]:
    """Readable names of all that can be named; a layout's precedes that of an object of its name."""
    objects = {signature.name: signature.label for signature in signatures if signature.kind == "object"}
    return objects | {layout.name: layout.label for layout in layouts}


def without_body(prepared: PreparedCapture, answer: Identification) -> PreparedCapture:
    """The prepared capture minus the echo of the body found by the reader, for a picture of the tag.

    Returns the capture unchanged if no body hypothesis was selected.
    """
    from tagid.reading.subtract import without_body as subtracted

    body = None if answer.reading is None else _selected_body(answer.reading)
    if body is None:
        return prepared
    return PreparedCapture(subtracted(prepared.given, body), prepared.settings)


def _selected_body(reading: Reading) -> Hypothesis | None:
    """The hypothesis that won if it has a body, whose echo is no part of the tag; else None."""
    winner = reading.winner
    return None if winner is None or not winner.found.model.body_columns else winner


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
    captures = [one.given for one in prepared]
    settings = prepared[0].settings if prepared else ImagingSettings()
    for one in prepared:
        _check_views(one)
    recordings = [one.scans(settings.preprocessing(matched_filter=False)) for one in prepared]
    with watch.stage("read"):
        joint, alone = read_together(recordings, layouts, reader_settings(settings), signatures)
        alone = [of_the_part(own, [one.given]) for own, one in zip(alone, prepared, strict=True)]
        joint = of_the_part(joint, captures)
    labels = _labels(layouts, signatures)
    with watch.stage("look again"):
        looked = [_looked_at_again(one, reading) for reading, one in zip(alone, prepared, strict=True)]
    for one in prepared:
        watch.add(one.watch)

    def answer(reading: Reading, of: Sequence[Capture], second: SecondLook | None) -> Identification:
        return Identification(
            reading.status,
            reading,
            of[0].uuid if len(of) == 1 else None,
            registry_version,
            labels.get(reading.layout or "", ""),
            dict(watch.seconds),
            second=second,
            coverage=share_seen(of),
        )

    each = [answer(r, [c], second) for (r, second), c in zip(looked, captures, strict=True)]
    return answer(joint, captures, looked[0][1] if len(captures) == 1 else None), each


def aspect_spectra(capture: Capture, settings: ImagingSettings | None = None) -> Spectra:
    """Spectra of a prepared capture from which the signature of its object can be estimated.

    Raises DataError as `identify` does, and for free antenna positions.
    """
    from tagid.imaging.whitening import whitened
    from tagid.tags.bodies.signature import MAX_RADIUS_M, signature_wavenumbers
    from tagid.tags.bodies.spectra import Spectra
    from tagid.tags.reading.views import fold_views

    settings = settings or ImagingSettings()
    if capture.angles_rad is None:
        raise DataError(
            "the signature of an object requires a turntable, but this capture has free antenna positions",
            "Record the object on a turntable, or enrol its reflectors with `point`.",
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
    fault = sample_fault(prepared.given)
    if fault is not None and fault.certain:
        raise DataError(fault.text, f"{fault.remedy[0].upper()}{fault.remedy[1:]}.")


def _looked_at_again(prepared: PreparedCapture, reading: Reading) -> tuple[Reading, SecondLook | None]:
    """The reading, with a note where its bound does not hold, and what the network says."""
    if reading.status == "identified" and reading.bound and prepared.settings.priors != TagPriors():
        note = "the bound on false accept was calibrated with the default priors (tags.*_m)"
        reading = replace(reading, note=note)
    return reading, _second_look(prepared, reading)


def _second_look(prepared: PreparedCapture, reading: Reading) -> SecondLook | None:
    """The network's result for the backprojection without the body's echo, on its own grid.

    None for free antenna positions.
    """
    from tagid.reading.subtract import without_body as subtracted
    from tagid.tags.network.planes import GRID
    from tagid.tags.network.second_look import look_again

    if prepared.given.angles_rad is None:
        return None
    if (body := _selected_body(reading)) is not None:
        prepared = prepared.elsewhere(subtracted(prepared.capture, body))
    matched = PreprocessSettings(prepared.settings.background, matched_filter=True, extent_m=GRID.extent)
    return look_again(prepared.scans(matched), reading.reflectors, reading.offset_m)
