"""The solver by cells against exact series of line sources, the population that is solved with it, and the
reader's sheet of metal against a solved box."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.constants import SPEED_OF_LIGHT
from tagid.fields.bessel import bessel
from tagid.fields.thin_shell import BoxShell, ShellField
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.reading.decision import decide
from tagid.reading.reader import contest
from tagid.reading.sheet import METAL_M, OBLIQUITIES
from tagid.simulate.multipole import Layer, Multipoles
from tagid.tags.layouts.layout import builtin_layouts
from train import population, volume, volume_objects
from train.volume import METAL, Cells, ellipse, metal, wall

F = np.linspace(2.8e9, 5.2e9, 9)
K = 2 * np.pi * F / SPEED_OF_LIGHT
NEAR_M = 0.3


def exact(*layers: Layer) -> np.ndarray:
    """(F,) S of a cylinder about z = 0 for a line antenna at NEAR_M."""
    reflected = Multipoles.of(K, layers).reflected
    n = np.arange(reflected.shape[1])
    wave = bessel(len(n) - 1, K * NEAR_M).h2
    return np.asarray((reflected * np.where(n == 0, 1, 2) * (wave / wave[:, :1]) ** 2).sum(axis=1))


def rod(radius_m: float, permittivity: complex, cell_m: float) -> Cells:
    return wall(ellipse(radius_m / 2, radius_m / 2), radius_m, permittivity, cell_m)


PLASTIC = wall(ellipse(0.03375, 0.03375), 2.5e-3, 2.5, 2.5e-3)
OIL = 2.5 - 0.12j


@pytest.mark.parametrize(
    ("cells", "layers", "most_db", "most_deg"),
    [
        (metal(ellipse(0.035, 0.035)), (Layer(0.035, METAL),), 0.01, 0.1),
        (Cells.of(np.zeros(1, complex), 5e-5, METAL), (Layer(5e-5, METAL),), 0.01, 0.1),
        (rod(0.030, 2.5, 2.4e-3), (Layer(0.030, 2.5),), 0.2, 4.0),
        (PLASTIC, (Layer(0.0325), Layer(0.035, 2.5)), 0.2, 1.0),
        (wall(ellipse(0.038, 0.038), 4e-3, 6.0, 1.35e-3), (Layer(0.036), Layer(0.040, 6.0)), 0.5, 3.0),
        (PLASTIC + rod(0.0325, OIL, 2.4e-3), (Layer(0.0325, OIL), Layer(0.035, 2.5)), 0.2, 3.0),
        (rod(0.020, 75 - 15j, 1.5e-3), (Layer(0.020, 75 - 15j),), 0.5, 1.5),
    ],
    ids=["can", "wire", "powder", "empty bottle", "ceramic cup", "bottle of oil", "water"],
)
def test_a_cylinder_is_that_of_the_exact_series(
    cells: Cells, layers: tuple[Layer, ...], most_db: float, most_deg: float
) -> None:
    ratio = volume.echo(cells, F, np.array([NEAR_M * np.exp(0.7j)]))[:, 0] / exact(*layers)
    assert np.abs(20 * np.log10(np.abs(ratio))).max() < most_db
    assert np.abs(np.angle(ratio, deg=True)).max() < most_deg


def test_a_speck_is_lit_and_seen_through_the_same_field() -> None:
    body, place = metal(volume.box(0.05, 0.03)), 0.045 + 0.041j
    antennas = 0.9 * np.exp(1j * np.linspace(0.1, 6.0, 12))
    speck = Cells.of(np.array([place]), 1e-3, 2.5)
    added = volume.echo(body + speck, F, antennas) - volume.echo(body, F, antennas)
    field = volume.lit(body, F, antennas, np.array([place]))[:, 0]
    ratio = added / (volume.echo(speck, F, antennas) * field**2)
    assert np.abs(ratio - 1)[np.abs(field) > 0.3].max() < 0.01


def test_only_the_place_of_the_antenna_in_the_object_s_frame_matters() -> None:
    target = volume_objects.target(7)
    cells, antenna, by, turn = target.body + target.tag, 0.5 * np.exp(0.4j), 0.02 - 0.01j, 2.0
    moved = antenna * np.exp(1j * turn) + by
    waves = [bessel(0, K * abs(at)).h2[:, 0] ** 2 for at in (antenna, moved)]
    here = volume.echo(cells, F, np.array([antenna]))[:, 0] * waves[0]
    there = volume.echo(cells.moved(by, turn), F, np.array([moved]))[:, 0] * waves[1]
    assert np.abs(here - there).max() < 1e-4 * np.abs(here).max()


def test_nothing_of_an_object_stands_in_another_part_of_it() -> None:
    for seed in range(360):
        target = volume_objects.target(seed)
        wires = np.concatenate([target.tag.centre_m, target.odd.centre_m])
        assert np.abs(wires[:, None] - target.body.centre_m).min(initial=1.0) > 2.5e-3, seed
        apart = np.abs(wires[:, None] - wires) + np.eye(len(wires))
        assert apart.min(initial=1.0) > 0.015, seed


def test_tags_are_those_that_the_truth_names_or_foreign_ones() -> None:
    rounds = len(volume_objects.BODIES), len(volume_objects.TAGS)
    for seed in range(2 * rounds[0] * rounds[1]):
        target, what = volume_objects.target(seed), volume_objects.TAGS[seed // rounds[0] % rounds[1]]
        assert (target.truth is not None) == (what == "enrolled")
        if target.truth:
            at = builtin_layouts()[target.truth].positions
            assert np.abs(target.tag.centre_m - at @ [1, 1j]).max() < 7e-3
        else:
            assert len(target.tag.centre_m) in ((0,) if what == "none" else (2, 3, 4))


def test_a_response_has_the_phase_of_the_way_to_the_reflector() -> None:
    place, antenna = 0.08 + 0.05j, 1.004 * np.exp(2.2j)
    single = volume_objects.solved("one", Cells.of(np.array([place]), 5e-5, METAL), 1.0, np.array([place]))
    assert single.reflectors_m.tolist() == [[place.real, place.imag]]
    centred = volume_objects.solved("centred", Cells.of(np.zeros(1, complex), 5e-5, METAL), 1.0)
    at = np.array([[antenna.real, antenna.imag, 0.0]])
    ratio = (single.seen_from(at) / centred.seen_from(at))[0]
    path = abs(antenna - place) - abs(antenna)
    assert np.abs(np.angle(ratio * np.exp(2j * single.wavenumber * path))).max() < 0.01
    assert np.abs(np.abs(ratio) - abs(antenna) / abs(antenna - place)).max() < 0.01


def test_a_seed_is_a_recording() -> None:
    first, again = volume_objects.draw(1), volume_objects.draw(1)
    assert np.array_equal(first.capture.samples, again.capture.samples)
    assert first.capture.views == first.views and first.capture.samples.std() > 0


@pytest.mark.parametrize("half_m", [(0.0286, 0.0173), (0.035, 0.035), (0.06, 0.045)])
def test_a_sheet_of_metal_returns_what_a_solved_box_does(half_m: tuple[float, float]) -> None:
    f, antenna = np.linspace(3.1e9, 4.8e9, 5), np.exp(2j * np.pi * np.arange(72) / 72)
    k = 2 * np.pi * f / SPEED_OF_LIGHT
    solved = volume.echo(metal(volume.box(*half_m)), f, antenna) * np.exp(-2j * k)[:, None]
    columns = ShellField.of(k, BoxShell(*half_m, METAL_M), 48).seen_from(antenna).echoes(OBLIQUITIES)
    remaining = [
        base - rows.T @ np.linalg.lstsq(rows.T, base, rcond=None)[0]
        for base, rows in zip(solved, columns, strict=True)
    ]
    moving = solved - solved.mean(axis=1, keepdims=True)
    assert (np.abs(remaining) ** 2).sum() < 1e-3 * (np.abs(moving) ** 2).sum()


def test_a_box_with_another_object_beside_it_is_no_tag() -> None:
    """With odd scatterers in the field of the box alone it was a pair on a filled vessel, by 10 nats."""
    specimen = population.draw(320237, views=12)
    assert (specimen.body, specimen.clutter, len(specimen.positions)) == ("box", "second", 0)
    scans = preprocess(specimen.capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    decision = decide(contest(scans, list(builtin_layouts().values())).run())
    assert decision.status == "no_tag" and "a box of metal" in decision.reason and decision.lead < -9
