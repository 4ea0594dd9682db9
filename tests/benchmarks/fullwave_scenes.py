"""Captures of solved full-wave responses: of `shared/fullwave` beside the checkout (or where TAGID_SHARED
points), by that folder's own `scenes.py`, and of tests/data/responses, solved by `train.fullwave`.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from tagid.capture import Capture
from tagid.simulate.response_file import read_response
from tests.benchmarks.provenance import ROOT, SHARED, imported

FULLWAVE = SHARED / "fullwave"
NAMES = {"c90": "container-90", "c180": "container-180", "h120": "helmet-120", "lin": "helmet-linear"}
"""Ending of a solved object's name: the built-in layout that it carries. Any other ending carries none."""
OWN = ROOT / "tests" / "data" / "responses"


def known(name: str) -> bool:
    return any((folder / f"{name}.npz").is_file() for folder in (OWN, FULLWAVE / "responses"))


@cache
def full_wave() -> Any:
    """The scene maker beside the responses, which knows ours and sums of two, "a+b", too."""
    module = imported(FULLWAVE / "scenes.py")
    for own in OWN.glob("*.npz"):
        if (FULLWAVE / "responses" / own.name).is_file():
            continue
        response = read_response(own)
        rings = {(r.polarisation, round(r.distance_m, 3)): i for i, r in enumerate(response.rings)}
        if not {("V", 0.8), ("V", 1.0), ("V", 1.2)} <= rings.keys():
            continue  # solved at other distances, for other benchmarks
        b = response.scattering_length_m.astype(complex)
        upright = [b[:, rings["V", d]] for d in (0.8, 1.0, 1.2)]
        across = [b[:, i] for (polarisation, _), i in rings.items() if polarisation == "H"]
        four = np.stack([*upright, np.mean(across, axis=0)], axis=1)
        module._cache[own.stem] = (response.frequency_hz, np.fft.fft(four, axis=2) / four.shape[2])
    plain = module.response

    def sum_of(name: str) -> Any:
        if "+" not in name:
            return plain(name)
        first, second = name.split("+")
        frequencies, reply = plain(first)
        return frequencies, reply + plain(second)[1]

    module.response = sum_of
    return module


def single_of(solved: str) -> str:
    """The response of one reflector of an object's tag: alone, or what it adds to its body."""
    base = solved.split("_")[0]
    if base.startswith("free"):
        return f"{base}_one"
    if base == "shell":
        return "free40_one" if solved.endswith("40") else "free20_one"
    return f"{base}_one-{base}"


def recorded(name: str, rng: np.random.Generator, place: complex, **how: Any) -> Capture:
    """A capture of what the scene maker knows by a name, standing at x + jy, m; SNR against one reflector."""
    how = {"reference": single_of(name), **how}
    scan, _ = full_wave().make(name, rng, centre=(place.real, place.imag), **how)
    return Capture(
        scan["samples"],
        float(scan["range_start_m"]),
        float(scan["range_step_m"]),
        scan["angles_rad"],
        axis_distance_m=float(scan["axis_distance_m"]),
    )
