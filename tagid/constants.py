"""Physical constants and the P440's fixed numbers, each with its source.

They stand in one place because the wire, the imaging and the simulation must agree on them to the last digit.
"""

from __future__ import annotations

from typing import Final

SPEED_OF_LIGHT = 299_792_458.0
"""Speed of light in vacuum, m/s (SI, exact)."""

BIN_PS = 1e3 / (512 * 1.024)
"""One radar bin: 1 / (512 * 1.024) ns = 1.9073 ps (P440 MRM API; confirmed on recordings)."""

BINS_PER_SAMPLE = 32
"""A stored sample is 32 bins apart from the next (61.035 ps, 9.149 mm one way)."""

SAMPLE_STEP_S = BINS_PER_SAMPLE * BIN_PS * 1e-12
"""Fast-time sampling interval of a scan, s."""

RANGE_STEP_M = SPEED_OF_LIGHT * SAMPLE_STEP_S / 2
"""One-way range between samples, m."""

BAND_LOW_HZ = 3.1e9
"""Lower edge of the P440's band, Hz (paper, hardware section)."""

BAND_HIGH_HZ = 4.8e9
"""Upper edge of the P440's band, Hz (paper, hardware section)."""

CENTER_FREQUENCY_HZ = (BAND_LOW_HZ + BAND_HIGH_HZ) / 2
"""Middle of the band, 3.95 GHz. The paper prints 4.3 GHz, which is not the middle of the band it gives."""

BANDWIDTH_HZ = BAND_HIGH_HZ - BAND_LOW_HZ
"""Width of the band, Hz."""

SAMPLES_PER_BLOCK = 96
"""The P440 delivers samples in multiples of 96."""

CLIP_COUNTS_PER_INTEGRATION = 127
"""A sample saturates at 127 * 2^PII counts (measured on recordings)."""

BLAS_THREADS: Final = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Environment variables that limit the threads of numpy's linear algebra; read when numpy is imported."""

CAPTURE_SUFFIX: Final = ".tagid.h5"
"""Usual ending of a capture file's name."""
BACKGROUND_FILE: Final = f"background{CAPTURE_SUFFIX}"
"""The empty scene that `tagid radar calibrate` and `tagid commission` store, in the data folder."""
RIG_FILE: Final = "rig.toml"
"""Profile of the commissioned rig, in the data folder (`tagid.rig`)."""
