"""Tables of single reflectors against the evidence of the columns themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reader_scenes import spectra_of

from tagid.reading import search
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Columns, Model
from tagid.reading.descent import Powers, variance
from tagid.reading.evidence import log_evidence
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE
from tagid.reading.transfers.shade import SHADES
from tagid.reading.transfers.transfer import Transfer

POWERS = Powers(1e-3, body=3.0)
CENTRE = 0.002 + 0.001j
PAIR = (0.045, 0.0, 0.0), (0.045, np.pi / 2, 0.0)
RINGS = [((0.11, 0.0, 0.0),), ((0.09, 0.3, 0.0),)]


def exact(spectra: Spectra, transfer: Transfer, angles: np.ndarray) -> float:
    """Log evidence of alike reflectors at such angles of a ring, without tangents and unlike strength."""
    parts, body = [], int(transfer.body)
    for angle in angles:
        model = Model(transfer, Arrangement.ring(0.045, np.array([angle])), False, 0)
        x = np.array([CENTRE.real, CENTRE.imag, 0.0, 0.0])
        values = Columns.of(model, spectra, x, slopes=False).values
        parts.append(values[:, body:])
    columns = spectra.whiteners[0].apply(np.concatenate([values[:, :body], sum(parts)], axis=1))
    tag = [POWERS.tag * p for p in transfer.power]
    power = spectra.moving[:, None] * np.array(([POWERS.body] if transfer.body else []) + tag)
    lam = variance(spectra, model, POWERS.clutter)
    return float(log_evidence(columns, spectra.white[0], lam[None], power[None])[0])


@pytest.mark.parametrize("transfer", [BARE, SHADES[1]], ids=lambda transfer: transfer.name)
@pytest.mark.parametrize(("views", "turns", "nats"), [(36, 1.0, 3.0), (72, 1.0, 3.0), (36, 0.75, 0.6)])
def test_tables_give_the_evidence_of_the_columns(
    transfer: Transfer, views: int, turns: float, nats: float
) -> None:
    """Centring moves phases only: parallax and the room's share are off by some nats of some hundred.

    Of part of a turn they are exact but for the nearest pattern.
    """
    spectra = eight(spectra_of("container-90", views=views, turns=turns, offset_m=0.002))
    assert spectra.full_turn == (turns == 1)
    model = Model(transfer, None, transfer.body, 0)
    (table,) = search.tables(spectra, model, [CENTRE], [PAIR], POWERS)
    ((best,),) = search.turned(table, 1)
    expected = exact(spectra, transfer, best.angles[0] + np.array([0, np.pi / 2]))
    assert best.log == pytest.approx(expected, abs=nats)


def eight(spectra: Spectra) -> Spectra:
    """The frequencies that the tables hold."""
    kept = slice(0, search.held_in(len(spectra.kappa)))
    parts = {name: np.ascontiguousarray(getattr(spectra, name)[kept]) for name in ("data", "kappa", "moving")}
    return replace(spectra, **parts)


def both_ways(monkeypatch: pytest.MonkeyPatch, turns: float) -> tuple[search.Tables, search.Tables]:
    """Tables of two rings by the compiled loop and by numpy."""
    spectra = spectra_of("helmet-120", views=36, turns=turns)
    model = Model(SHADES[1], None, True, 1)
    (compiled,) = search.tables(spectra, model, [CENTRE], RINGS, POWERS)
    assert compiled.blocks.pair.size  # made before the loop is taken away
    monkeypatch.setattr(search, "_sets", None)
    search._turning.cache_clear()
    (numpy,) = search.tables(spectra, model, [CENTRE], RINGS, POWERS)
    return compiled, numpy


def test_the_compiled_tables_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled, numpy = both_ways(monkeypatch, 1.0)
    for first, other in (
        (compiled.right, numpy.right),
        (compiled.held, numpy.held),
        (compiled.blocks.pair, numpy.blocks.pair),
    ):
        np.testing.assert_allclose(first, other, rtol=0, atol=1e-5 * np.abs(other).max())


@pytest.mark.parametrize("turns", [1.0, 0.75])
def test_the_compiled_loop_scores_and_grows_the_sets_of_numpy(
    monkeypatch: pytest.MonkeyPatch, turns: float
) -> None:
    sets = np.array([[0, 40, 80], [3, 100, 140], [10, 60, 110]], dtype=np.int32)
    with monkeypatch.context() as patched:
        compiled, numpy = both_ways(patched, turns)
        scores = numpy.scores(sets)
        (ids, *_) = numpy.every(4)
        gap = np.abs(np.subtract.outer(np.arange(len(ids)), np.arange(len(ids))))
        gap = np.minimum(gap, len(ids) - gap)
        choice = search.Choice(ids, gap >= 2, gap >= 1)
        expected = numpy.grown(choice, 4, 2)
    assert compiled.scores(sets) == pytest.approx(scores, rel=1e-6)
    for _ in range(2):  # with pairs that are not known yet, and with known ones
        result = compiled.grown(choice, 4, 2)
        assert [item.tolist() for _, item in result] == [item.tolist() for _, item in expected]
        assert [log for log, _ in result] == pytest.approx([log for log, _ in expected], rel=1e-5)


def test_the_frequencies_that_are_left_out_tell_as_much_as_the_others() -> None:
    spectra = spectra_of("container-90", views=36)
    model = Model(BARE, None, False, 0)
    (table,), (without,) = (
        search.tables(item, model, [CENTRE], [PAIR], POWERS) for item in (spectra, eight(spectra))
    )
    assert table.share == 8 / 9 and without.share == 1
    ((best,),), ((other,),) = search.turned(table, 1), search.turned(without, 1)
    assert best.log - table.base == pytest.approx(9 / 8 * (other.log - without.base), rel=1e-6)


def test_groups_alone_score_as_they_do_together() -> None:
    spectra = spectra_of("helmet-120", views=36)
    (table,) = search.tables(spectra, Model(SHADES[1], None, True, 1), [0j], RINGS, POWERS)
    together = table.every()[1, [3, 50, 70]]
    alone = table.by_group[1]
    scores = alone.scores(alone.every()[:, [3, 50, 70]])
    assert scores == pytest.approx(table.scores(together[None]), rel=1e-6)


def test_free_reflectors_are_found_where_they_stand() -> None:
    spectra = spectra_of("container-90", views=72)
    (table,) = search.tables(spectra, Model(BARE, None, False, 0), [0j], [PAIR[:1]], POWERS)
    pairs = (item for item in search.free(table, np.deg2rad(24.0), 3, 1) if len(item.angles) == 2)
    pair = max(pairs, key=lambda item: item.log)
    apart = np.rad2deg(abs(np.angle(np.exp(1j * (pair.angles[1] - pair.angles[0])))))
    assert apart == pytest.approx(90, abs=6)
