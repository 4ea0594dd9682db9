"""Step 2, the empty room: noise, interference, what moves, leakage and clipping.

The table stands in place, without an object, and nobody walks.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.commissioning.bench import REACH_M, Bench, radar_facts, reported
from tagid.commissioning.pictures import echo_over_range, noise_spectrum
from tagid.commissioning.rows import Level, Row, StepReport
from tagid.config import change_settings, data_folder
from tagid.constants import BACKGROUND_FILE, BANDWIDTH_HZ, CENTER_FREQUENCY_HZ, SAMPLE_STEP_S, SPEED_OF_LIGHT
from tagid.files import make_folder
from tagid.recording.calibration import make_reference, usable
from tagid.recording.inspection import clipped_fraction
from tagid.rig import Measured
from tagid.signal import analytic, noise_power_of, snr_db
from tagid.simulate.budget import MOST_GAIN, LinkBudget
from tagid.simulate.source import noise_counts
from tagid.storage.hdf5 import write_capture
from tagid.types import Floats

NOISE_DB: Final = 3.0
"""Recordings have 90 to 160 counts at integration index 11: within 2.5 dB of the expected 120."""
_LINE_DB: Final = 6.0
_LINE_WIDTH_HZ: Final = 300e6
"""A line is compared with the spectrum this far around it: pulses of another radar are wider."""
_BURSTS: Final = 0.03
"""Share of noisy scans from which another transmitter is suspected; noise alone has less than 0.1 %."""
_USUAL_DELAY_PS: Final = (8_000.0, 15_000.0)
_MARGIN_DB: Final = 3.0
_MOVES_DB: Final = -6.0
"""Changing echo over the noise, from which something moves among the object's ranges."""
_DRIFTS: Final = 1e-3
"""Change of a static echo, over its power, while the radar warms up: 0.03 rad are 1 ps."""
_VIEW_SNR_DB: Final = 20.0
_INDICES: Final = range(9, 16)


def watch_room(bench: Bench) -> StepReport:
    """Record the empty scene, store it as background reference, and report what is wrong with it.

    Raises DeviceError and its subclasses, DataError, StorageError.
    """
    capture = make_reference(bench.take_still("empty room"))
    scans = usable(capture)
    index = bench.config["radar.integration"]
    rest = _second_differences(scans)
    noise = _noise(rest)
    sigma = noise / math.sqrt(2 * (len(scans) - 2) * scans.shape[1])
    path = data_folder() / BACKGROUND_FILE
    name = bench.keep_recording("room", capture)
    make_folder(path.parent)
    write_capture(path, capture)
    change_settings({"radar.background": str(path)})
    frequency_hz, power = _spectrum(rest)
    line, clipping = _line(frequency_hz, power, len(rest)), _clipping(bench, capture)
    cause = "the line above" if line is not None else "the receiver clips" if clipping.code else ""
    bursts = _bursts(rest, cause)
    explained = line is not None or bursts.code != ""
    rows = [
        _noise_row(noise, sigma, index, explained),
        line or Row("interference", Level.PASS, text="no line in the spectrum"),
        bursts,
        _moving(capture, scans, bench.axis_distance_m(), bursts.code != ""),
        clipping,
        _integration(bench),
    ]
    values = {"noise_counts": Measured(noise, sigma)}
    pictures = (
        echo_over_range(capture.ranges_m, scans.mean(axis=0), noise, "empty room"),
        noise_spectrum(frequency_hz, power),
    )
    facts = radar_facts(capture)
    return reported("room", rows, values=values, facts=facts, recording=name, pictures=pictures)


def _second_differences(scans: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scans without what changes slowly, with the noise of one scan: static echoes and persons cancel."""
    return np.diff(scans, 2, axis=0) / math.sqrt(6)


def _noise(rest: NDArray[np.float64]) -> float:
    """Standard deviation of a sample of second differences, from the bins in which nothing moves."""
    return float(np.sqrt((rest[:, _quiet(rest)] ** 2).mean()))


def _quiet(rest: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(bins,) where the changes are those of noise: persons in the room move at few ranges."""
    power = (rest**2).mean(axis=0)
    return np.asarray(power <= (1 + 6 * math.sqrt(2 / len(rest))) * np.median(power))


def _noise_row(noise: float, sigma: float, index: int, explained: bool) -> Row:
    expected = noise_counts(index)
    above = 20 * math.log10(noise / expected)
    text = f"{above:+.1f} dB against {expected:.0f} counts of other recordings"
    row = partial(Row, "noise of a sample", value=noise, sigma=sigma, unit="counts", text=text)
    if abs(above) <= NOISE_DB:
        return row(Level.PASS)
    if above > 0:
        advice = "Another transmitter is in the band: find it and switch it off, then repeat this step."
        return row(Level.NOTE if explained else Level.FAIL, advice=advice, code="noise")
    advice = "The receiver hears nothing: check the cable of the receiving antenna and radar.antenna_mode."
    return row(Level.FAIL, advice=advice, code="deaf")


def _spectrum(rest: NDArray[np.float64]) -> tuple[Floats, Floats]:
    """(frequency, Hz; power) of the noise, mean over the scans, from the bins in which nothing moves."""
    window = _quiet(rest) * np.hanning(rest.shape[1])
    power = (np.abs(np.fft.rfft(rest * window, axis=1)) ** 2).mean(axis=0)
    return np.asarray(np.fft.rfftfreq(rest.shape[1], SAMPLE_STEP_S), np.float64), power


def _line(frequency: Floats, power: Floats, scans: int) -> Row | None:
    """The strongest line of the noise's spectrum over so many scans; None if there is none."""
    frequency, power = frequency[2:-2], power[2:-2]
    half = round(_LINE_WIDTH_HZ / (frequency[1] - frequency[0]))
    around = np.lib.stride_tricks.sliding_window_view(np.pad(power, half, mode="reflect"), 2 * half + 1)
    over = power / np.median(around, axis=1)
    best = int(over.argmax())
    level = 10 * math.log10(over[best])
    if level < _LINE_DB:
        return None
    at = float(frequency[best])
    sigma = 10 / math.log(10) / math.sqrt(scans)
    inside = abs(at - CENTER_FREQUENCY_HZ) < BANDWIDTH_HZ / 2
    if 2.35e9 < at < 2.55e9:
        what = "a microwave oven or a wireless network"
        advice = "Switch off the microwave oven, or move away from it; then repeat this step."
        code = "microwave"
    else:
        what = "a transmitter in the radar's band" if inside else "a transmitter beside the radar's band"
        advice, code = "Find and switch off the transmitter, then repeat this step.", "line"
    return Row(
        "interference", Level.FAIL, level, sigma, "dB", f"line at {at / 1e9:.2f} GHz: {what}", advice, code
    )


def _bursts(rest: NDArray[np.float64], cause: str) -> Row:
    """Scans that are noisier than their neighbours, by a cause that is known, or by another radar."""
    energy = (rest[:, _quiet(rest)] ** 2).mean(axis=1)
    # Most second differences may contain a noisy scan: the quietest tenth tells the noise.
    quiet = float(np.percentile(energy, 10))
    noisy = float(np.mean(energy > quiet * (1 + 8 * math.sqrt(4 / rest.shape[1]))))
    sigma = math.sqrt(max(noisy * (1 - noisy), 1 / len(energy)) / len(energy))
    if noisy <= _BURSTS:
        return Row("noisy scans", Level.PASS, 100 * noisy, 100 * sigma, "%")
    row = partial(Row, "noisy scans", value=100 * noisy, sigma=100 * sigma, unit="%")
    if cause:
        return row(Level.NOTE, text=cause, code="noisy")
    advice = "Another UWB radar is near: stop it, or `tagid radar config --code-channel N --save`."
    return row(Level.FAIL, text="pulses of another radar", advice=advice, code="other-radar")


def _moving(capture: Capture, scans: NDArray[np.float64], axis_m: float, explained: bool) -> Row:
    """Changing echoes at the ranges of the object, for any usual delay."""
    low, high = (ps * 1e-12 * SPEED_OF_LIGHT / 2 for ps in _USUAL_DELAY_PS)
    ranges = capture.ranges_m
    here = (ranges > axis_m - REACH_M / 2 + low) & (ranges < axis_m + REACH_M / 2 + high)
    every = analytic(scans.astype(np.float32))
    level, place = snr_db(every[:, here], noise_power_of(every))
    if level is None or place is None:
        return Row("moving echoes", Level.PASS, text="no changing echo at the object's ranges")
    at = float(ranges[here][place]) - (low + high) / 2
    sigma = 10 / math.log(10) * math.sqrt(2 / len(scans))
    row = partial(Row, "moving echoes", value=level, sigma=sigma, unit="dB")
    if explained:
        return row(Level.NOTE, text="not decided among noisy scans")
    echo = every[:, here][:, place]
    static = float(np.abs(echo.mean()) ** 2)
    if level < _MOVES_DB or float(np.var(echo)) < _DRIFTS * static:
        return row(Level.NOTE, text=f"an echo near {at:.1f} m drifts")
    advice = "Keep everybody out of the beam and switch the table off, then repeat this step."
    text = f"an echo changes near {at:.1f} m: a person walking"
    return row(Level.FAIL, text=text, advice=advice, code="person")


def _clipping(bench: Bench, capture: Capture) -> Row:
    clip = capture.radar.clip_counts
    assert clip is not None
    largest = float(np.abs(usable(capture)).max())
    margin = 20 * math.log10(clip / max(largest, 1.0))
    share = clipped_fraction(capture) or 0.0
    gain = bench.config["radar.gain"]
    spare = margin - _MARGIN_DB - 6.0 * bool(share)
    best = min(max(gain + math.floor(spare / LinkBudget.step_db), 0), MOST_GAIN)
    text = f"{100 * share:.2f} % of the samples are clipped"
    if spare >= 0:
        text = f"leakage between the antennas, walls; the largest gain is {best}, radar.gain is {gain}"
    advice = f"The gain is too high: `tagid config set radar.gain {best}`, or move the antennas apart."
    return Row.judged("margin to clipping", spare >= 0, margin, 0.1, "dB", text, advice, "gain")


def _integration(bench: Bench) -> Row:
    """The least integration with which a reflector of 40 mm stands out of a view."""
    length = bench.target.scattering_length(np.array([CENTER_FREQUENCY_HZ]))
    gain, now = bench.config["radar.gain"], bench.config["radar.integration"]
    for index in _INDICES:
        budget = LinkBudget(transmit_gain=gain, integration=index)
        snr = budget.snr_db(float(np.abs(length[0])), bench.axis_distance_m())
        if snr >= _VIEW_SNR_DB:
            break
    text = f"{index} gives the target {snr:.0f} dB at the axis"
    return Row(
        "recommended integration", Level.NOTE, float(index), unit=f"(radar.integration is {now})", text=text
    )
