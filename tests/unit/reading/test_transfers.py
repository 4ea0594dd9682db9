"""Patterns of reflectors beside bodies: limits, phases, and solved waves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.fields.shells import Shell, echoes, orders, reflection
from tagid.reading.transfers.rod import RODS
from tagid.reading.transfers.transfer import ANGLES, Transfer, aspects
from tagid.reading.transfers.wall import STRENGTHS, WALLS, Walls, patterns, wall
from tagid.simulate.response_file import read_response

RESPONSES = Path(__file__).parents[2] / "data" / "responses"
KAPPA = 4 * np.pi / SPEED_OF_LIGHT * np.linspace(3.2e9, 4.8e9, 9)
RADIUS_M = 0.045
FRONT, BEHIND = 0, ANGLES // 2


def table(transfer: Transfer) -> NDArray[np.complex128]:
    return transfer.table(KAPPA, RADIUS_M)


def patterns_beside(shell: Shell) -> NDArray[np.complex128]:
    coefficients = reflection(KAPPA / 2, [shell], orders(KAPPA / 2, RADIUS_M))
    return patterns(KAPPA / 2, coefficients, np.array([True]), RADIUS_M, 2)


@pytest.mark.parametrize("transfer", [*WALLS, *RODS], ids=lambda transfer: transfer.name)
def test_a_pattern_is_alike_to_either_side_and_of_falling_power(transfer: Transfer) -> None:
    seen = table(transfer)
    assert seen.shape == (len(transfer.power), len(KAPPA), ANGLES)
    np.testing.assert_allclose(seen[..., 1:], seen[..., :0:-1], atol=1e-12)
    energy = (np.abs(seen[..., : BEHIND + 1]) ** 2).sum(axis=2)
    assert (np.diff(energy, axis=0) <= 0).all()


def test_a_wall_of_air_is_free_space() -> None:
    seen = table(wall("air", "air", Walls((0.003,), (1.0,)), 2))
    np.testing.assert_allclose(seen[0], np.sqrt(np.sum(STRENGTHS)), atol=1e-6)
    assert np.abs(seen[1:]).max() < 1e-6


@pytest.mark.parametrize("transfer", WALLS, ids=lambda transfer: transfer.name)
def test_rings_of_nearly_one_radius_have_patterns_of_one_phase(transfer: Transfer) -> None:
    near, far = (transfer.table(KAPPA, radius)[0] for radius in (0.087, 0.09))
    assert np.abs(np.angle((far * near.conj()).sum(axis=1))).max() < 0.1


def test_the_patterns_hold_the_second_moment_of_the_fields() -> None:
    """Between front and back, too: the sign of the phase and of the delay shows there alone."""
    shell = Shell(0.030, 0.0, 1.0, True)
    seen = patterns_beside(shell)
    place = aspects()[[FRONT, BEHIND]]
    free = np.exp(1j * KAPPA[:, None] * RADIUS_M * np.cos(place))
    fields = echoes(KAPPA / 2, [shell], RADIUS_M, place)[:, 0] / free
    expected = np.einsum("pfa,pq,qfb->fab", fields, STRENGTHS, fields.conj())
    held = seen[..., [FRONT, BEHIND]]
    np.testing.assert_allclose(np.einsum("pfa,pfb->fab", held, held.conj()), expected, atol=1e-9)


def test_behind_a_low_loss_filling_a_reflector_is_late_and_strong() -> None:
    """Powder of permittivity 2.5: 30 mm late and 12 dB above the front in solved waves of a finite vessel."""
    powder = Shell(0.028, 0.0025, 2.6, False, "V", 2.5)
    seen = patterns_beside(powder)
    turn = np.unwrap(np.angle((seen[..., BEHIND] * seen[..., FRONT].conj()).sum(axis=0)))
    assert -np.polyfit(KAPPA, turn, 1)[0] == pytest.approx(0.030, abs=0.008)
    level = (np.abs(seen) ** 2).sum(axis=0).mean(axis=0)
    assert level[BEHIND] > 2 * level[FRONT]


@pytest.mark.parametrize(
    ("body", "name", "radius_m", "most"),
    [("can40", "metal, V", 0.049, 0.01), ("cup36", "glass, V", 0.045, 0.06)],
)
def test_a_class_of_walls_holds_a_solved_reflector(
    body: str, name: str, radius_m: float, most: float
) -> None:
    added = read_response(RESPONSES / f"{body}_one.npz").without(read_response(RESPONSES / f"{body}.npz"))
    angle = 2 * np.pi * np.arange(64) / 64
    antennas = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    kappa = 2 * added.wavenumber[4:17]
    echo = added.seen_from(antennas, "V").T[4:17]
    local = np.abs(np.exp(1j * angle) - radius_m)
    free = np.exp(-1j * kappa[:, None] * (local - 1)) / local**2
    transfer = next(wall for wall in WALLS if wall.name == name)
    columns = transfer.table(kappa, radius_m)[..., :: ANGLES // 64] * free
    remaining = 0.0
    for f in range(len(kappa)):
        # The prior keeps weak patterns small, as in a reading: an amplitude counts like a residual of 1 %.
        x, y = columns[:, f].T, echo[f]
        scale = np.linalg.norm(y) / np.linalg.norm(x)
        held = np.linalg.solve(
            x.conj().T @ x + 64 * (0.1 / scale) ** 2 * np.var(y) * np.eye(x.shape[1]), x.conj().T @ y
        )
        remaining += float((np.abs(y - x @ held) ** 2).sum())
    assert remaining < most * (np.abs(echo) ** 2).sum()
