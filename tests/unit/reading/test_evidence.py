"""The log evidence of columns: against the dense formula, its slopes, the compiled loop against numpy, and
amplitudes that are smooth over frequency."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from reader_scenes import LAYOUTS, spectra_of

from tagid.reading import descent
from tagid.reading.arrangement import Arrangement
from tagid.reading.bounce import BOUNCE_M
from tagid.reading.columns import CLOSE_SD_M, PAST, REACH_M, Columns, Face, Model
from tagid.reading.compiled import Compiled
from tagid.reading.descent import BODY, CLUTTER, OVAL, TAG, Powers, _Numpy, descend, refined, variance
from tagid.reading.evidence import fit
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.odd import OddMap
from tagid.reading.smooth import DELAYS_M, SPREAD_M, gains, roots, smoothed
from tagid.reading.smooth import FREE as SHARES
from tagid.reading.smooth import log_evidence as smooth_evidence
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE
from tagid.reading.transfers.rod import RODS
from tagid.reading.transfers.shade import SHADES

EVEN = spectra_of("container-90", views=36)
SPECTRA = {
    "even": EVEN,
    "uneven": spectra_of("container-90", views=31, turns=0.8),
    "heights": replace(EVEN, height_m=np.where(np.arange(36) % 2, 0.12, 0.0), full_turn=False),
}
LAYOUT = Arrangement.of_layout(LAYOUTS[0].positions, LAYOUTS[0].heights)
FREE = Arrangement.points(np.array([0.04, 0.05j, -0.03 - 0.03j])).and_one(-0.09j)
MODELS = {
    "nothing": Model(BARE, None, False, 0),
    "round": Model(BARE, LAYOUT, False, 1),
    "body": Model(SHADES[1], None, True, 0, odd=1),
    "layout": Model(SHADES[1], LAYOUT, True, 0, odd=2),
    "late": Model(RODS[0], LAYOUT, False, 1),
    "free": Model(SHADES[1], FREE, True, 0),
    "plane": Model(SHADES[1], LAYOUT, True, 0, odd=1, levels=2),
    "lifted": Model(BARE, FREE, False, 0, odd=2, levels=2),
    "tall": Model(BARE, LAYOUT.raised(), False, 1, odd=1),
    "glued": Model(SHADES[1], LAYOUT.by_hand(), True, 0, odd=1),
    "glued at heights": Model(SHADES[1], LAYOUT.by_hand(), True, 0, odd=1, levels=2),
    "face": Model(SHADES[1], LAYOUT, True, 0, odd=2, faces=(None, (0.7, 0.3))),
    "hidden": Model(BARE, FREE, False, 0, odd=1, hidden=(1.0, 2.0)),
}
POWERS = (100.0, 0.3, 1e-3)


def somewhere(model: Model) -> np.ndarray:
    """Parameters of a model away from every symmetry."""
    x = 0.002 * np.cos(1.0 + 3 * np.arange(model.parameters))
    turns = 0 if model.tag is None else model.tag.turns
    x[model.head : model.head + turns] = 0.3 + np.arange(turns)
    if model.odd:
        x[-model.spot * model.odd :] = 0.09 * np.sin(2.0 + 2 * np.arange(model.spot * model.odd))
    return x


def compiled(spectra: Spectra, model: Model) -> Compiled:
    likelihood = Compiled.of(spectra, model)
    if likelihood is None:
        pytest.skip("no compiler was present at installation")
    return likelihood


@pytest.mark.parametrize("turn", SPECTRA)
@pytest.mark.parametrize("kind", MODELS)
def test_the_compiled_likelihood_is_that_of_numpy(turn: str, kind: str) -> None:
    spectra, model = SPECTRA[turn], MODELS[kind]
    x, some = somewhere(model), list(product(BODY, TAG, OVAL[1:2]))
    first, other = compiled(spectra, model), _Numpy(spectra, model)
    np.testing.assert_allclose(first.values(x, some, CLUTTER), other.values(x, some, CLUTTER), rtol=1e-9)
    for a, b in zip(first.expanded(x, POWERS, 1e-3), other.expanded(x, POWERS, 1e-3), strict=True):
        # What crowds has slopes by finite differences there.
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())


@pytest.mark.parametrize("faces", [((0.7, 0.3), PAST), (PAST, (0.7, 0.3)), (PAST, None)])
def test_a_density_does_not_depend_on_those_asked_before(faces: tuple[Face | None, ...]) -> None:
    """Prior powers are kept between models: odd scatterers differ in theirs by how they are seen."""
    spectra = SPECTRA["even"]
    for asked in [(None, None), (PAST, PAST), ((0.7, 0.3), (0.7, 0.3)), faces]:
        model = replace(MODELS["face"], faces=asked)
        x = somewhere(model)
        value = compiled(spectra, model).values(x, [POWERS], [1e-3])
        np.testing.assert_allclose(value, _Numpy(spectra, model).values(x, [POWERS], [1e-3]), rtol=1e-9)


SLOPED = ["body", "layout", "free", "glued", "glued at heights", "face", "hidden", "plane", "lifted", "tall"]


@pytest.mark.parametrize("turn", SPECTRA)
@pytest.mark.parametrize("kind", SLOPED)
def test_the_gradient_is_that_of_finite_differences(turn: str, kind: str) -> None:
    """Of numpy's, which that of the compiled loop equals."""
    model = MODELS[kind]
    likelihood, x = _Numpy(SPECTRA[turn], model), somewhere(model)
    value, gradient, hessian = likelihood.expanded(x, POWERS, 1e-3)
    steps = 1e-6 * np.eye(len(x))
    ends = [likelihood.values(x + step, [POWERS], [1e-3])[0, 0] for step in (0 * x, *steps, *-steps)]
    assert value == pytest.approx(ends[0], rel=1e-12)
    assert np.linalg.eigvalsh(hessian)[0] > -1e-9 * np.abs(hessian).max()
    slopes = np.subtract(ends[1 : len(x) + 1], ends[len(x) + 1 :]) / 2e-6
    # Patterns are linear between aspects: a view at a corner of a table has no slope there.
    np.testing.assert_allclose(gradient, slopes, rtol=1e-4, atol=1e-4 * np.abs(slopes).max())


@pytest.mark.parametrize("kind", ["nothing", "layout", "free", "lifted"])
def test_the_compiled_descent_is_that_of_numpy(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spectra, model, powers = SPECTRA["even"], MODELS[kind], Powers(1e-2)
    x, here = descend(spectra, model, somewhere(model), powers, 3)
    monkeypatch.setattr(descent, "_likelihood", _Numpy)
    expected, there = descend(spectra, model, somewhere(model), powers, 3)
    np.testing.assert_allclose(x, expected, atol=1e-6)
    assert here.log == pytest.approx(there.log, abs=1e-4)
    np.testing.assert_allclose(here.gradient, there.gradient, atol=1e-4 * np.abs(there.gradient).max())


@pytest.mark.parametrize("kind", ["body", "plane"])
def test_an_odd_scatterer_stays_within_reach(kind: str) -> None:
    spectra, model = SPECTRA["even"], MODELS[kind]
    x = somewhere(model)
    x[len(x) - model.spot :][:2] = 0.8 * (REACH_M + 1e-3), 0.6 * (REACH_M + 1e-3)
    first, other = (way(spectra, model).expanded(x, POWERS, 1e-3) for way in (compiled, _Numpy))
    for a, b in zip(first, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())
    assert model.crowding(x).max() == pytest.approx(1e-3 / CLOSE_SD_M)
    end, _ = descend(spectra, model, x, Powers(1e-2), 20)
    assert np.hypot(*end[len(x) - model.spot :][:2]) < REACH_M + 2 * CLOSE_SD_M


@pytest.mark.parametrize("turn", SPECTRA)
def test_the_evidence_is_that_of_the_covariance(turn: str) -> None:
    spectra, model = SPECTRA[turn], MODELS["layout"]
    x, whitener = somewhere(model), SPECTRA[turn].whiteners[0]
    columns = whitener.apply(Columns.of(model, spectra, x).values)
    power, lam = model.power(spectra.moving, *POWERS), variance(spectra, model, 1e-2)
    expected = model.log_prior(x)[0]
    for f, data in enumerate(spectra.white[0]):
        covariance = np.diag(lam[f]) + (columns[f].T * power[f]) @ columns[f].conj()
        expected -= (data.conj() @ np.linalg.solve(covariance, data)).real + np.linalg.slogdet(covariance)[1]
    for way in (compiled, _Numpy):
        likelihood = way(spectra, model)
        assert likelihood.values(x, [POWERS], [1e-2])[0, 0] == pytest.approx(expected, rel=1e-9)
        assert likelihood.expanded(x, POWERS, 1e-2)[0] == pytest.approx(expected, rel=1e-9)


def test_models_of_other_columns_are_left_to_numpy() -> None:
    class Other(Model):
        pass

    assert Compiled.of(SPECTRA["even"], Other(BARE, None, False, 0)) is None
    assert Compiled.of(SPECTRA["even"], Model(BARE, None, False, 0, odd=40)) is None


def test_a_wave_between_reflectors_is_as_late_as_its_path_is_long() -> None:
    """By single scattering at each of two points: antenna, one, the other, antenna (Foldy 1945)."""
    spectra, positions = SPECTRA["even"], np.array([0.05 + 0.01j, -0.02 + 0.04j])
    expected = np.zeros(spectra.data.shape, dtype=complex)
    ranges = np.hypot(np.abs(spectra.antenna - positions[:, None]), spectra.height_m)
    apart = abs(positions[0] - positions[1])
    for f, kappa in enumerate(spectra.kappa):
        wavenumber = kappa / 2
        path = ranges[0] + apart + ranges[1] - 2 * spectra.distance_m
        loss = spectra.distance_m**2 / (ranges[0] * ranges[1]) * BOUNCE_M / apart
        expected[f] = loss * np.exp(-1j * wavenumber * path)
    tag = Arrangement.points(positions)
    model = Model(BARE, tag, False, 0)
    column = Columns.of(model, spectra, np.zeros(model.parameters)).values[:, len(BARE.power)]
    np.testing.assert_allclose(column, expected, rtol=2e-3)


@pytest.mark.parametrize("kind", ["layout", "glued", "glued at heights", "plane", "tall"])
def test_the_slopes_of_the_prior_are_those_of_finite_differences(kind: str) -> None:
    model, step = MODELS[kind], 1e-7
    x = somewhere(model)
    assert not model.crowding(x).any()
    _, slopes, precision = model.log_prior(x, slopes=True)
    ends = [[model.log_prior(x + way, slopes=True) for way in (u, -u)] for u in step * np.eye(len(x))]
    np.testing.assert_allclose([(a[0] - b[0]) / (2 * step) for a, b in ends], slopes, rtol=1e-5, atol=1e-3)
    if not model.shapes:
        bent = [(b[1] - a[1]) / (2 * step) for a, b in ends]
        np.testing.assert_allclose(bent, precision, rtol=1e-5, atol=1e-4 * np.abs(precision).max())


def test_a_tag_that_was_glued_by_hand_has_a_density_that_sums_to_one() -> None:
    tag = Arrangement.of_layout(LAYOUTS[0].positions[:2], None).by_hand()
    log, precision = tag.glue(2e-3, 50e-3)
    # Over the difference of the turns, any turn of both, the two stretches and the two lifts.
    apart = np.linspace(-0.5, 0.5, 4001)
    turned = np.exp(-0.5 * precision[1, 1] * apart**2).sum() * (apart[1] - apart[0]) * 2 * np.pi
    outward, upward = (2 * np.pi / np.sqrt(np.linalg.det(precision[i : i + 2, i : i + 2])) for i in (2, 4))
    assert np.exp(log) * turned * outward * upward == pytest.approx(1.0, rel=1e-6)


def test_a_flat_wall_is_found_as_a_face() -> None:
    empty = spectra_of("container-90", views=36)
    wall = Model(BARE, None, False, 0, odd=1, faces=((0.8, 0.2),))
    place = 0.05 * np.exp(0.8j)
    column = wall.at(empty, np.array([0.0, 0.0, place.real, place.imag]), slopes=False).values[:, 0]
    assert np.abs(column[0, np.abs(empty.direction - 0.8) > 1.0]).max() < 1e-3
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((2, *column.shape))
    data = 20 * column + (noise[0] + 1j * noise[1]) / np.sqrt(2)
    spectra = replace(empty, data=data - data.mean(axis=1, keepdims=True))
    nothing = refined(spectra, Model(BARE, None, False, 0), np.zeros(2), (None,))
    spot, face = OddMap(spectra).likeliest(nothing)[0]
    assert face is not None and face[0] == pytest.approx(0.8, abs=0.2)
    result = refined(spectra, nothing.model.and_odd(face), np.append(nothing.x, spot), (None,))
    # How far out it lies shows in the phases alone, and hardly: amplitudes are free at every frequency.
    assert np.angle(result.odd[0]) == pytest.approx(0.8, abs=0.1)
    point = refined(spectra, nothing.model.and_odd(), np.append(nothing.x, spot), (None,))
    assert result.log_z > point.log_z + 50


RNG = np.random.default_rng(3)
F, N, M, OWN = 5, 4, 7, slice(1, 3)
KAPPA = np.linspace(140.0, 190.0, F)
SOME = RNG.normal(size=(F, N, M, 2)) @ [1, 1j]
SEEN = RNG.normal(size=(F, M, 2)) @ [1, 1j]
LAM, SIZES = RNG.uniform(0.5, 2, (F, M)), RNG.uniform(0.1, 3, (F, N))


def dense(free: float, delay_m: float) -> float:
    offset = np.subtract.outer(KAPPA, KAPPA)
    kernel = np.exp(-0.5 * (SPREAD_M * offset) ** 2 - 1j * delay_m * offset)
    wide = np.zeros((F, M, N, F), dtype=complex)
    wide[np.arange(F), :, :, np.arange(F)] = np.swapaxes(SOME, 1, 2)
    covariance = np.diag(LAM.ravel()).astype(complex)
    for c in range(N):
        share = free if OWN.start <= c < OWN.stop else 1.0
        size = np.sqrt(SIZES[:, c])
        prior = np.outer(size, size) * ((1 - share) * kernel + share * np.eye(F))
        column = wide[:, :, c].reshape(F * M, F)
        covariance += column @ prior @ column.conj().T
    y = SEEN.ravel()
    return float(-(y.conj() @ np.linalg.solve(covariance, y)).real - np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize("free", [0.1, 0.3])
def test_the_evidence_is_that_of_all_frequencies_together(free: float) -> None:
    result = smooth_evidence(SOME, SEEN, LAM, SIZES, OWN, roots(KAPPA), free)
    np.testing.assert_allclose(result, [dense(free, delay) for delay in DELAYS_M], atol=1e-3)


def test_free_amplitudes_have_the_evidence_of_every_frequency_by_itself() -> None:
    alone = fit(SOME, SEEN, LAM, SIZES).log
    uncoupled = np.broadcast_to(np.eye(F), (1, F, F)).astype(complex)
    for root, free in ((roots(KAPPA), 1.0), (uncoupled, 0.3)):
        result = smooth_evidence(SOME, SEEN, LAM, SIZES, OWN, root, free)
        np.testing.assert_allclose(result, alone, atol=1e-9)


def test_a_tag_of_one_amplitude_gains_and_is_scored_at_the_delay_of_the_likeliest_of_its_kind() -> None:
    spectra = spectra_of("container-90", views=18, snr_db=5.0)
    model = Model(BARE, LAYOUT, False, 0)
    tagged = refined(spectra, model, np.zeros(model.parameters), (1e-2, None))
    assert gains(spectra, tagged, roots(spectra.kappa)).max() > 5
    phases = np.exp(1j * RNG.uniform(0, 2 * np.pi, (len(spectra.kappa), 1)))
    mixed = replace(spectra, data=spectra.data * phases)
    assert gains(mixed, tagged, roots(spectra.kappa)).max() < 0
    bare = refined(spectra, replace(model, tag=None), np.zeros(2), (1e-2, None))
    some = [Hypothesis(LAYOUTS[0], tagged, log) for log in (3.0, 2.0)] + [Hypothesis(None, bare, 1.0)]
    first, untagged, second = smoothed(spectra, some)
    assert first.log_z == pytest.approx(3.0 + gains(spectra, tagged, roots(spectra.kappa)).max())
    assert untagged.log_z == 1.0
    assert second.log_z == pytest.approx(2.0 - np.log(len(SHARES)))
