"""Settings of the reader from those of the pipeline."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tagid.pipeline.settings import ImagingSettings

if TYPE_CHECKING:
    from tagid.reading.reader import ReaderSettings


def reader_settings(settings: ImagingSettings, spent: float = 0.0) -> ReaderSettings:
    """Settings of the reader.

    Args:
        settings: of imaging and reading.
        spent: share of the false-accept probability that was used before, by readings of parts of the turn.
    """
    from tagid.reading.columns import Priors
    from tagid.reading.reader import ReaderSettings

    return ReaderSettings(
        settings.false_accept * (1 - spent),
        Priors(settings.priors.centre_sigma_m, settings.priors.radius_sigma_m),
        settings.direction_known,
    )
