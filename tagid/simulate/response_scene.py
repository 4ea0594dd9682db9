"""Scenes made from a response: the object moves, rotates and is recorded like any other body.

Its echo is rendered from points along the line of sight to the object's origin, whose delayed pulses sum to
the response. So noise, room, wobble, placement and the emulator work unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.geometry import Aperture
from tagid.imaging.memory import require_memory
from tagid.simulate.acquisition import Acquisition, Placement, RangeWindow
from tagid.simulate.render import PulseTable, render_bodies
from tagid.simulate.response import Response
from tagid.simulate.scattering import Returns
from tagid.simulate.scene import Scene, StaticReturns
from tagid.simulate.snr import EchoLevels
from tagid.types import Floats

TAPER_HZ = 0.2e9
"""Width of the raised cosine at either end of the response's frequencies.

The pulse still has a few per cent of its amplitude there; without a taper its echo would extend over the
whole window. At the band's edges of 3.1 and 4.8 GHz the taper of a response over 2.8 to 5.2 GHz is 1.
"""

_BEFORE = 1 / 3
"""Fraction of the unambiguous depth in front of the object's origin; late echoes are behind it."""

_TAP_M = 0.03
"""Spacing of the points. Their sum repeats every c / (2 * 0.03 m) = 5 GHz: the repetitions of 2.8 to 5.2 GHz
are outside the pulse's spectrum."""


@dataclass(frozen=True, eq=False)
class ResponseBody:
    """A response as a reflecting body (`scattering.Body`).

    Spreading is included: the echo falls as (axis_distance_m / R)^2 with the distance R from the antenna to
    the object's origin, so that `Acquisition.range_law` must not be added. At that distance an echo has the
    amplitude gain * b, the gain in 1/m. The polarisation is "V" or "H".
    """

    response: Response
    polarisation: str = "V"
    axis_distance_m: float = 1.0
    gain: float = 1.0

    def returns(self, antennas: Floats) -> Returns:
        """Points x_i before and behind the origin, with a_i = sum_f b(f) taper(f) exp(2jk x_i) df 2 dx / c.

        Their pulses add up to the inverse Fourier transform of b * taper * (spectrum of the pulse).
        """
        r = self.response
        depth = r.unambiguous_m
        count = int(np.floor(depth / _TAP_M))
        require_memory(
            len(antennas) * count * 2 * (8 * 3 + 16),
            f"{len(antennas)} views of an object {depth:.3g} m deep",
            "Simulate fewer views.",
        )
        offset = -_BEFORE * depth + depth / count * np.arange(count)
        step_hz = r.frequency_hz[1] - r.frequency_hz[0]
        kernel = np.exp(2j * np.outer(r.wavenumber, offset)) * (step_hz * 2 * depth / count / SPEED_OF_LIGHT)
        b = r.seen_from(antennas, self.polarisation) * _taper(r.frequency_hz)
        away = np.linalg.norm(antennas, axis=1)
        along = -antennas / away[:, None]
        points = antennas[:, None] + along[:, None] * (away[:, None] + offset)[..., None]
        # Points behind the antenna belong to no echo.
        ahead = away[:, None] + offset > 0
        spread = (self.axis_distance_m / away) ** 2
        return Returns(points, np.asarray(self.gain * spread[:, None] * (b @ kernel) * ahead))


def _taper(frequency_hz: Floats) -> Floats:
    """(f,) 1 in the band, a raised cosine towards the ends, zero one step beyond them."""
    step = frequency_hz[1] - frequency_hz[0]
    width = min(TAPER_HZ, (frequency_hz[-1] - frequency_hz[0]) / 4)
    inside = np.minimum(frequency_hz - frequency_hz[0], frequency_hz[-1] - frequency_hz) + step
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(inside / (width + step), 0, 1)))


def peak_echo(body: ResponseBody, acquisition: Acquisition, *placements: Placement) -> float:
    """Largest envelope of the echo over one turn of 72 views.

    Pulse, distance and antenna height are those of the acquisition; no wobble. The object's origin is on the
    axis unless placements are given, which are those of several such bodies together.
    """
    distance = acquisition.axis_distance_m
    antennas = Aperture.turntable(
        2 * np.pi * np.arange(72) / 72, distance, acquisition.antenna_height_m
    ).positions
    window, table = RangeWindow.around(distance), PulseTable.of(acquisition.pulse)
    plain = Acquisition(axis_distance_m=distance, window=window)
    every = placements or (Placement(),)
    return float(np.abs(sum(render_bodies((body,), at, antennas, plain, table) for at in every)).max())


def _levels(
    response: Response, reference: Response | None, unit: ResponseBody, acquisition: Acquisition
) -> EchoLevels:
    """What the SNR of a response refers to; `unit` is the reference, or else the response, of peak 1.

    The echoes of several reflectors together are those of a reference with one reflector, which is turned and
    shifted to where each of the object's reflectors is.
    """
    if reference is None:
        return EchoLevels(1.0, 1.0, (), "the whole object, body included (`snr_reference` takes another)")
    name = reference.name + ("" if reference.difference else ", taken to have no body")
    count, reflectors = len(reference.reflectors_m), response.reflectors_m
    if count == 0:
        return EchoLevels(1.0, 1.0, (), f"{reference.name}; how many reflectors it has is not stated")
    if count > 1:
        return EchoLevels(1.0, 1.0, ("summed",), f"the {count} of {name}; per reflector it is not known")
    if len(reflectors) == 0:
        return EchoLevels(1.0, 1.0, ("reflector",), f"{name}; the object's own reflectors are not stated")
    (at,) = reference.reflectors_m
    try:
        summed = peak_echo(unit, acquisition, *(_moved(at, to) for to in reflectors))
    except UsageError:
        # Where they stand, the antenna is nearer than the reference's response allows.
        return EchoLevels(
            1.0, 1.0, ("reflector",), f"{name}; of the object's {len(reflectors)} it is not known"
        )
    return EchoLevels(1.0, summed, reference=f"{len(reflectors)} like that of {name}")


def _moved(at: Floats, to: Floats) -> Placement:
    """The placement that brings a reflector from one place (2,) to another, its outside still outside."""
    turn = float(np.arctan2(to[1], to[0]) - np.arctan2(at[1], at[0]))
    x, y = to - Placement(rotation_rad=turn).apply(at[None])[0]
    return Placement((float(x), float(y)), turn)


def response_scene(
    response: Response,
    acquisition: Acquisition,
    polarisation: str = "V",
    reference: Response | None = None,
    room: StaticReturns | None = None,
) -> Scene:
    """A scene of one object whose response is known, at polarisation "V" or "H".

    Amplitudes are scaled so that the strongest echo of the reference, its origin on the axis, is 1; the scale
    depends on the acquisition's distance, antenna height and pulse. The SNR of the acquisition refers to that
    echo, and the room's amplitudes are in its unit. The reference is for example one reflector alone or
    `tagged.without(untagged)`; None means the response itself.

    Raises UsageError: the response cannot be seen from there, or with that polarisation. DataError: the
    reference has no echo.
    """
    distance = acquisition.axis_distance_m
    shown = response if reference is None else reference
    peak = peak_echo(ResponseBody(shown, polarisation, distance), acquisition)
    if not peak > 0:
        raise DataError(f"response {shown.name} has no echo, so that no SNR can refer to it")
    body = ResponseBody(response, polarisation, distance, 1 / peak)
    levels = _levels(response, reference, ResponseBody(shown, polarisation, distance, 1 / peak), acquisition)
    about = {
        "response": response.name,
        "polarisation": polarisation,
        "snr_reference": shown.name,
        "reflectors_m": response.reflectors_m.tolist(),
        **{f"response_{key}": value for key, value in response.provenance.items()},
    }
    return Scene(response.name, (body,), room=room, levels=levels, description=about)
