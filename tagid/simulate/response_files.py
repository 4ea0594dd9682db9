"""An object given by its response file on the command line, as a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tagid.errors import UsageError
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.presets import room_clutter
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import ResponseBody, peak_echo, response_scene
from tagid.simulate.scene import Scene, StaticReturns


@dataclass(frozen=True)
class ResponseFiles:
    """An object given by its response file, with the reference for the SNR of its recordings.

    Attributes:
        response: response of the object.
        polarisation: "V" or "H".
        reference: response whose strongest echo is the SNR's signal; None means the object's own.
        reference_body: response that is subtracted from the reference: tagged object minus its body.
    """

    response: Path
    polarisation: str = "V"
    reference: Path | None = None
    reference_body: Path | None = None

    def __post_init__(self) -> None:
        if self.reference_body is not None and self.reference is None:
            raise UsageError("a reference body is given without a reference", "Add `snr_reference=FILE`.")

    def scene(self, acquisition: Acquisition, seed: int = 0) -> Scene:
        """The object in a room drawn from the seed, scaled by the object if that exceeds its reference.

        Raises the reader's errors, and UsageError if the response does not cover the acquisition.
        """
        response = read_response(self.response)
        reference = None if self.reference is None else read_response(self.reference)
        if reference is not None and self.reference_body is not None:
            reference = reference.without(read_response(self.reference_body))
        alone = response_scene(response, acquisition, self.polarisation, reference)
        bodies = [body for body in alone.object if isinstance(body, ResponseBody)]
        for body in bodies:
            # An emulator says before its first scan that the response does not cover where the object stands.
            peak_echo(body, acquisition, acquisition.placement)
        strengths = [peak_echo(body, acquisition) for body in bodies]
        room = room_clutter(np.random.default_rng(seed))
        room = StaticReturns(room.ranges_m, room.amplitudes * max(1.0, *strengths))
        return response_scene(response, acquisition, self.polarisation, reference, room)
