"""Filters of the vendor's PC server program: filtered scans and detection lists, from raw scans.

A radar sends raw scans only. The server's filters are named by a mask (P440 MRM API): 1 raw, 2 fast time (the
pulse's band), 4 motion (change since the last scan), 8 detection list. The vendor's coefficients are not
published; these filters have the same meaning, but not the same numbers.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.constants import BANDWIDTH_HZ, CENTER_FREQUENCY_HZ, SAMPLE_STEP_S
from tagid.radar.messages import SAMPLES_PER_MESSAGE, MessageType, encode
from tagid.radar.scan_info import RAW_FILTER, scan_packets
from tagid.radar.settings import RadarConfig
from tagid.signal import analytic

FAST_TIME: Final = 2
MOTION: Final = 4
DETECTION_LIST: Final = 8
ALL_FILTERS: Final = RAW_FILTER | FAST_TIME | MOTION | DETECTION_LIST
_USUAL_MULTIPLIER: Final = 6
_LARGEST_U16: Final = 0xFFFF


class ServerFilters:
    """The filters of one run.

    Args:
        mask: outputs to send, a subset of `ALL_FILTERS`.
        multiplier: detection threshold as a multiple of the median magnitude of a scan; 0 means 6.
    """

    def __init__(self, mask: int, multiplier: int) -> None:
        self._mask = mask
        self._multiplier = multiplier or _USUAL_MULTIPLIER
        self._last: NDArray[np.float64] | None = None

    def packets(
        self, samples: NDArray[np.int32], config: RadarConfig, scan_id: int, timestamp_ms: int
    ) -> list[bytes]:
        """The messages that the server sends for one raw scan (config.samples,), one output after another."""
        out: list[bytes] = []
        if self._mask & RAW_FILTER:
            out += scan_packets(samples, config, scan_id, timestamp_ms)
        if not self._mask & ~RAW_FILTER:
            return out
        band = _in_band(samples)
        if self._last is None or self._last.shape != band.shape:
            self._last = band
        motion, self._last = band - self._last, band
        for bit, values in ((FAST_TIME, band), (MOTION, motion)):
            if self._mask & bit:
                counts = np.rint(values).astype(np.int32)
                out += scan_packets(counts, config, scan_id, timestamp_ms, bit)
        if self._mask & DETECTION_LIST:
            out.append(self._detections(motion, scan_id))
        return out

    def _detections(self, motion: NDArray[np.float64], scan_id: int) -> bytes:
        """The strongest maxima of the envelope above the threshold, in order of range."""
        envelope = np.abs(analytic(motion[None])[0]).astype(np.float64)
        padded = np.concatenate([[-1.0], envelope, [-1.0]])
        peaks = (padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:])
        found = np.flatnonzero(peaks & (envelope > self._multiplier * np.median(envelope)) & (envelope >= 1))
        if len(found) > SAMPLES_PER_MESSAGE:
            found = np.sort(found[np.argsort(envelope[found])[-SAMPLES_PER_MESSAGE:]])
        detections = np.zeros(SAMPLES_PER_MESSAGE, dtype=[("index", ">u2"), ("magnitude", ">u2")])
        detections["index"][: len(found)] = found
        detections["magnitude"][: len(found)] = np.minimum(np.rint(envelope[found]), _LARGEST_U16)
        return encode(MessageType.DETECTION_LIST_INFO, scan_id, count=len(found), detections=detections)


def _in_band(samples: NDArray[np.int32]) -> NDArray[np.float64]:
    """(bins,) samples limited to the band of the pulse."""
    spectrum = np.fft.rfft(samples.astype(np.float64))
    frequency = np.fft.rfftfreq(len(samples), SAMPLE_STEP_S)
    spectrum[np.abs(frequency - CENTER_FREQUENCY_HZ) > BANDWIDTH_HZ] = 0
    return np.asarray(np.fft.irfft(spectrum, len(samples)), dtype=np.float64)
