"""What the waves would allow on bodies that are hard to read blind: two bounds, by full-wave responses.

With everything known (the echo of the body with every arrangement on it; centre, turn and level per frequency
are free), two objects whose echoes differ by an energy D^2 over the noise are confused with probability
Q(D / sqrt(2)). With nothing known of the body but that it lies within a radius r about its centre, its
echo has the harmonics |m| <= kappa r + (kappa r)^(1/3), each with a free amplitude at every frequency, and
only what of a tag's echo lies beyond them can be told from the body's.

Run `python tests/benchmarks/bodies_bound.py --write docs/results`.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from bodies_scenes import FULLWAVE, generator
from numpy.typing import NDArray
from provenance import made_with, publish
from scipy.special import log_ndtr

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.tags.bodies.signature import angular, near_field, order_mask, order_of
from tagid.tags.bodies.spectra import Spectra, centred

SEED = 2
DISTANCE_M = 1.0
OFFSET = 0.004 + 0.004j
TURN_STEP = np.deg2rad(5.0)
SNRS_DB = (20.0, 10.0, 0.0)
NOISELESS_DB = 200.0


@dataclass(frozen=True)
class Case:
    """A tagged object and what it may be taken for.

    Attributes:
        label: of the row.
        tagged, body: responses.
        one: response of the body, or a can like it, with one reflector; and that can.
        radius_m: of the body, the handle included.
        reference: response of one reflector, against which SNR is stated.
        layouts_deg: angles of other arrangements.
    """

    label: str
    tagged: str
    body: str
    one: tuple[str, str]
    radius_m: float
    reference: str
    others_deg: tuple[tuple[float, ...], ...]


PAIRS = ((), (0.0,), (0.0, 75.0), (0.0, 105.0), (0.0, 180.0), (0.0, 90.0, 225.0))
CASES = (
    Case("metal can, container-90", "can35_c90", "can35", ("can35_one", "can35"), 0.035, "free20_one", PAIRS),
    Case("ceramic cup, container-180", "cup36_c180", "cup36", ("cup36_one", "cup36"), 0.036, "free20_one",
         ((), (0.0,), (0.0, 165.0), (0.0, 90.0), (0.0, 90.0, 180.0), (337.5, 22.5, 157.5, 202.5))),
    Case("mug with a handle, container-90", "handle34_c90", "handle34", ("can35_one", "can35"), 0.062,
         "free20_one", PAIRS),
    Case("helmet shell, helmet-120 of 20 mm", "shell_h120_20", "shell", ("", ""), 0.101, "free20_one", ((),)),
    Case("helmet shell, helmet-120 of 40 mm", "shell_h120_40", "shell", ("", ""), 0.101, "free40_one", ((),)),
)  # fmt: skip


def spectra_of(name: str, reference: str, views: int, turn: float, snr_db: float = NOISELESS_DB) -> Spectra:
    """Spectra of a response at one place, without a room."""
    scan, _ = generator().make(
        name,
        np.random.default_rng([SEED, views]),
        reference=reference,
        views=views,
        distance=DISTANCE_M,
        centre=(OFFSET.real, OFFSET.imag),
        rotation=turn,
        snr_db=snr_db,
        room=False,
    )
    capture = Capture(
        scan["samples"], scan["range_start_m"], scan["range_step_m"], scan["angles_rad"],
        axis_distance_m=scan["axis_distance_m"],
    )  # fmt: skip
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    return Spectra.of(preprocess(capture, settings=settings))


def arranged(case: Case, angles_deg: tuple[float, ...]) -> str:
    """Name of a response of the case's body with reflectors at these angles."""
    made = generator()
    if not angles_deg:
        return case.body
    name = f"{case.body}@" + ",".join(f"{a:g}" for a in angles_deg)
    frequency, body = made.response(case.body)
    dense, one = made.response(case.one[0])
    added = one - made.response(case.one[1])[1]
    added = added[:: (len(dense) - 1) // (len(frequency) - 1)]
    order = np.fft.fftfreq(added.shape[2], 1 / added.shape[2])
    made._cache[name] = (
        frequency,
        body + sum(added * np.exp(-1j * order * np.deg2rad(a)) for a in angles_deg),
    )
    return name


def reference_of(case: Case) -> str:
    """The reference at the frequencies of the tagged object."""
    made = generator()
    frequency, values = made.response(case.reference)
    own = made.response(case.tagged)[0]
    if len(own) == len(frequency):
        return case.reference
    step = (len(frequency) - 1) // (len(own) - 1)
    name = f"{case.reference} at {len(own)}"
    made._cache[name] = (frequency[::step], values[::step])
    return name


def beside(data: NDArray[np.complex128], columns: NDArray[np.complex128]) -> float:
    """Energy of data (F, V) that columns (F, C, V) do not explain."""
    tall = np.swapaxes(columns, 1, 2)
    u, s, _ = np.linalg.svd(tall, full_matrices=False)
    u = u * (s > 1e-6 * s.max(axis=1, keepdims=True))[:, None]
    rest = data - (u @ (u.conj().swapaxes(1, 2) @ data[..., None]))[..., 0]
    return float(np.sum(np.abs(rest) ** 2))


@dataclass(frozen=True, eq=False)
class Receiver:
    """What turns a scattered field into spectra: the pulse and the filter, one level (F,) per frequency."""

    spectra: Spectra
    level: NDArray[np.complex128]

    @classmethod
    def of(cls, spectra: Spectra, name: str) -> Receiver:
        """The levels by which the field of a response becomes the spectra of it."""
        field = centred(field_of(name, spectra, 0.0))
        level = (field.conj() * spectra.data).sum(axis=1) / (np.abs(field) ** 2).sum(axis=1)
        return cls(spectra, level)

    def seen(self, name: str, turn: float) -> NDArray[np.complex128]:
        """(F, V) spectra of a response, not centred."""
        return np.asarray(self.level[:, None] * field_of(name, self.spectra, turn))


def field_of(name: str, spectra: Spectra, turn: float) -> NDArray[np.complex128]:
    """(F, V) field that a response returns at the wavenumbers of spectra."""
    side = (spectra.antenna - OFFSET) * np.exp(-1j * turn)
    frequency, values = generator().view(name, np.abs(side), np.angle(side))
    carrier = 4 * np.pi / SPEED_OF_LIGHT * np.abs(side)[:, None]
    smooth = values * np.exp(1j * carrier * frequency)
    wanted = spectra.wavenumbers * SPEED_OF_LIGHT / (4 * np.pi)
    found = np.stack([np.interp(wanted, frequency, one) for one in smooth], axis=1)
    return np.asarray(found * np.exp(-1j * spectra.wavenumbers[:, None] * (np.abs(side) - DISTANCE_M)))


def nearest(case: Case, own: Spectra, receiver: Receiver) -> tuple[float, tuple[float, ...]]:
    """Least energy between the object and another one in any turn, level free, and which one that is."""
    best: tuple[float, tuple[float, ...]] = (np.inf, ())
    side = own.antenna - OFFSET
    along = -1j * own.wavenumbers[:, None] * (side / np.abs(side))[None]
    for angles in case.others_deg:
        name = arranged(case, angles)
        for turn in np.arange(0, 2 * np.pi, TURN_STEP):
            other = receiver.seen(name, turn)
            turned = (receiver.seen(name, turn + 1e-3) - other) / 1e-3
            # Small moves and turns of the object: their derivatives, by the carrier's phase.
            columns = np.stack([other, along.real * other, along.imag * other, turned], axis=1)
            left = beside(own.data, centred(columns))
            best = min(best, (left, angles), key=lambda pair: pair[0])
    return best


def beyond_body(case: Case, tag: Spectra) -> float:
    """Share of the tag's echo that no body of that radius can return."""
    order = order_of(float(tag.wavenumbers[-1]), case.radius_m)
    mask = order_mask(tag.wavenumbers, case.radius_m, order)
    toward = tag.antenna - OFFSET
    carrier = tag.waves(np.abs(toward)) * (tag.distance_m / np.abs(toward)) ** 2
    near = near_field(tag.wavenumbers, order, tag.distance_m)
    basis = angular(np.angle(toward), order)
    columns = carrier[:, None] * basis.T[None] * (near * mask)[:, :, None]
    return beside(tag.data, centred(columns)) / tag.energy


def row(case: Case, views: int) -> list[str]:
    reference = reference_of(case)
    tagged = spectra_of(case.tagged, reference, views, 0.0)
    plain = spectra_of(case.body, reference, views, 0.0)
    tag = Spectra(
        tagged.data - plain.data, tagged.wavenumbers, tagged.antenna, tagged.height_m, tagged.distance_m, 0.0
    )
    least, which = nearest(case, tagged, Receiver.of(tagged, case.tagged))
    share = beyond_body(case, tag)
    cells = []
    for snr in SNRS_DB:
        noise = spectra_of(case.tagged, reference, views, 0.0, snr).noise
        error = float(log_ndtr(-np.sqrt(least / noise / 2)) / np.log(10))
        cells += [
            f"10^{error:.0f}" if error < -2 else f"{10**error:.2f}",
            f"{share * tag.energy / noise:.0f}",
        ]
    other = "body alone" if not which else ", ".join(f"{a:g}" for a in which)
    return [f"| {case.label} | {views} | {other} | {100 * share:.1f} % | " + " | ".join(cells) + " |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, nargs="*", default=[36])
    parser.add_argument("--write", type=Path, help="folder for bodies-bound.md")
    arguments = parser.parse_args()
    if not FULLWAVE.is_dir():
        raise SystemExit(f"{FULLWAVE} is missing: set TAGID_SHARED to the folder that holds fullwave/")
    head = [f"{what}, {snr:.0f} dB" for snr in SNRS_DB for what in ("confused", "tag beyond the body")]
    lines = [
        "# Tags on bodies: what the waves allow",
        "",
        *made_with(f"{SEED}, of the noise alone"),
        "Full-wave responses, 6 mm off the axis, vertical polarisation.",
        "",
        "*Confused*: probability that an ideal reader, which knows the echo of the body with every",
        "arrangement on it, takes the object for the nearest other one. *Tag beyond the body*: energy of the",
        "tag's echo, over the variance of the noise of one value, that no body of this radius can return. A",
        "reader that knows nothing of the body has no other evidence; fits to noise alone explain 40 to 50.",
        "",
        "With the body known, the waves hold far more than is needed at every SNR. With an unknown body of",
        "any shape, nothing is left of a tag on a mug with a handle, and little of one on a helmet shell at",
        "36 views: what is known of the body must help. Cups are read because they are round, helmets",
        "because a shell is a thin elliptic sheet; mugs with handles must be enrolled.",
        "",
        "| object | views | nearest other | share of the tag beyond the body | " + " | ".join(head) + " |",
        "|---|---|---|---|" + "---|" * len(head),
    ]
    for case in CASES:
        for views in arguments.views:
            lines += row(case, views)
    publish(lines, arguments.write, "bodies-bound.md")


if __name__ == "__main__":
    main()
