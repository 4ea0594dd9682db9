"""A signature as a polar plot: the level of the echo over aspect at the ends and the centre of the band."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.report.canvas import Canvas
from tagid.report.colours import BLUE, GREEN, GRID, INK, ORANGE
from tagid.tags.bodies.signature import Signature, angular

SIZE, RADIUS, TOP = 720, 270, 60
RANGE_DB = 40.0
RING_DB = 10
COLOURS = (BLUE, GREEN, ORANGE)
ASPECTS = 360


def pattern_db(signature: Signature) -> NDArray[np.float64]:
    """(F, ASPECTS) level of the echo over azimuth in the object's frame, dB of each frequency's largest.

    The pulse's spectrum is part of every signature, so levels at different frequencies are not comparable.
    """
    azimuth = 2 * np.pi * np.arange(ASPECTS) / ASPECTS
    echo = np.abs(signature.harmonics @ angular(azimuth, signature.order).T)
    return np.asarray(20 * np.log10(np.maximum(echo / echo.max(axis=1, keepdims=True), 1e-6)))


def to_png(signature: Signature) -> bytes:
    """The plot as a PNG: aspect counter-clockwise from the right, level outwards, one line per frequency."""
    canvas = Canvas(SIZE, SIZE)
    middle = (SIZE / 2, TOP + RADIUS + 20)
    for ring in range(0, int(RANGE_DB) + 1, RING_DB):
        radius = RADIUS * (1 - ring / RANGE_DB)
        if radius > 0:
            canvas.circle(middle, radius, GRID, 1.5)
            canvas.text((middle[0] + 4, middle[1] - radius), f"-{ring} dB" if ring else "0 dB", 15)
    for degrees in range(0, 360, 30):
        spoke = np.exp(-1j * np.deg2rad(degrees)) * RADIUS
        canvas.line([middle, (middle[0] + spoke.real, middle[1] + spoke.imag)], GRID, 1)
        label = spoke * (1 + 22 / RADIUS)
        canvas.text((middle[0] + label.real, middle[1] + label.imag), str(degrees), 15, anchor="mm")
    levels = pattern_db(signature)
    count = len(levels)
    for index, colour in zip((0, count // 2, count - 1), COLOURS, strict=True):
        radius = RADIUS * np.clip(1 + levels[index] / RANGE_DB, 0, 1)
        turn = radius * np.exp(-2j * np.pi * np.arange(ASPECTS) / ASPECTS)
        points = [(middle[0] + float(p.real), middle[1] + float(p.imag)) for p in turn]
        canvas.line([*points, points[0]], colour, 2.5)
    canvas.text((20, 14), f"{signature.kind} {signature.name}  {signature.label}", 24, INK)
    names = [f"{f / 1e9:.1f} GHz" for f in signature.frequencies_hz[[0, count // 2, count - 1]]]
    for place, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
        canvas.text((20 + 130 * place, SIZE - 34), name, 20, colour)
    return canvas.png()
