"""Tags on bodies: the model's slopes, the places it finds, what it refuses, and the promise behind a name."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from any_evidence import ANY, SETTINGS

from tagid.capture import Capture
from tagid.config import load_config
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import ModelError, UsageError
from tagid.geometry import Aperture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.operate.words import bound_words
from tagid.operate.workplace import Workplace
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.reading import reader_settings
from tagid.pipeline.settings import ImagingSettings, TagPriors
from tagid.simulate import (
    Acquisition,
    Placement,
    parse_body,
    parse_reflector,
    scene_on_body,
    simulate_capture,
)
from tagid.simulate.noise import NoiseShape, draw_noise
from tagid.simulate.scene import Scene
from tagid.tags.bodies import reader
from tagid.tags.bodies.arrangement import difference_deg, gaps_deg, layout_gaps_deg, merged, resolution_deg
from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.calibration import Basis, Bound, Calibration, Scores, Stratum, largest
from tagid.tags.bodies.decide import BodyDecision
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.posing import Linear, descend
from tagid.tags.bodies.reflectors_fit import COMMON, FACING, Batch, Columns, Fitter, Priors, solve
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.ring import PairSearch, Ring
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.bodies.subtract import without_body
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.matcher import ReaderSettings, read_tag
from tagid.tags.sequential.looks import SPENT
from tagid.tags.verdicts.verdict import ADVICE, Code
from train.calibrate import one, replaced, strata
from train.population import draw

LAYOUTS = list(builtin_layouts().values())


def spectra_of(antenna: np.ndarray, views: int = 36) -> Spectra:
    """Empty spectra of a turn at 1 m."""
    kappa = 2 * 83.0 + np.linspace(-33, 33, 9)
    return Spectra(np.zeros((9, views), complex), kappa, antenna, np.zeros(views), 1.0, 1.0)


def turn(views: int = 36) -> np.ndarray:
    return np.exp(-2j * np.pi * np.arange(views) / views)


def pair_on(
    centre: complex,
    radius: float,
    angles: list[float],
    seed: int = 0,
    noise: float = 0.0,
    lean: tuple[float, ...] = (0.0, 0.0),
) -> Spectra:
    """A body of 30 with reflectors of 1 and a pattern of their own at every frequency."""
    rng = np.random.default_rng(seed)
    empty = spectra_of(turn())
    row = replace(batch_of(centre, radius, angles), lean=np.array([lean]))
    cols = Columns.of(empty, RoundBody(), row).values[0]
    amplitude = np.array([30.0, 1.0, 0.4, 0.1]) * np.exp(2j * np.pi * rng.uniform(size=(9, 4)))
    data = (amplitude[:, None] @ cols)[:, 0]
    data = data + noise * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape)) / np.sqrt(
        2
    )
    data -= data.mean(axis=1, keepdims=True)
    return replace(empty, data=data, noise=max(noise**2, 1e-9))


def batch_of(centre: complex, radius: float, angles: list[float]) -> Batch:
    k = len(angles)
    at = np.zeros((1, COMMON + k))
    at[0, :2] = at[0, 3:5] = centre.real, centre.imag
    at[0, COMMON:] = angles
    unit = np.eye(COMMON + k)
    moves = [unit[2], unit[0] + unit[3], unit[1] + unit[4], *unit[COMMON:]]
    one = np.ones(1)
    return Batch(
        at,
        np.full((1, k), radius),
        np.zeros((1, k)),
        np.ones((1, k)),
        np.zeros((1, k)),
        one * FACING.tilt,
        one * FACING.terms,
        np.array(moves)[None],
        one * -0.02,
        one * 0.02,
        one * 0,
    )


@pytest.mark.parametrize("lean", [(0.0, 0.0), (0.5, -0.4)])
def test_the_slopes_are_those_of_the_residual(lean: tuple[float, float]) -> None:
    """Kaufman's slope is exact where the model explains the data."""
    spectra = pair_on(0.004 - 0.002j, 0.045, [0.3, 1.9], lean=lean)
    fitter = Fitter(spectra, RoundBody(), Priors(), 1.0)
    exact = replace(batch_of(0.004 - 0.002j, 0.045, [0.3, 1.9]), lean=np.array([lean]))
    normal = fitter._linear(exact).normal[0]
    base = solve(spectra.data, Columns.of(spectra, RoundBody(), exact).values).rest
    step, slopes = 2e-5, []
    for move in exact.moves[0]:
        ahead = exact.moved(exact.at + step * move)
        rest = solve(spectra.data, Columns.of(spectra, RoundBody(), ahead).values).rest
        slopes.append(((rest - base)[0] / step).ravel())
    numeric = np.real(np.conj(slopes) @ np.transpose(slopes))
    size = np.sqrt(np.diag(numeric))
    assert (np.abs(normal - numeric) < 0.15 * np.outer(size, size)).all()


def test_the_fit_finds_centre_radius_and_angles() -> None:
    spectra = pair_on(0.004 - 0.002j, 0.041, [0.3, 1.9], noise=0.05)
    start = batch_of(0.0035 - 0.0015j, 0.045, [0.35, 1.8])
    fitted, left = Fitter(spectra, RoundBody(), Priors(), 0.05**2).fitted(start, 10)
    assert abs(fitted.centres[0] - (0.004 - 0.002j)) < 1e-4
    # A pattern that is free at every frequency leaves the radius to its prior for some millimetres.
    assert fitted.radii[0, 0] + fitted.at[0, 2] == pytest.approx(0.041, abs=8e-3)
    assert np.allclose(fitted.angles[0], [0.3, 1.9], atol=0.02)
    assert left[0] < 1.2 * spectra.noise_energy


def test_the_body_alone_gives_its_centre() -> None:
    spectra = pair_on(-0.006 + 0.003j, 0.045, [0.3, 1.9])
    best = RoundBody().poses(spectra)[0]
    assert abs(best.pose.centre - (-0.006 + 0.003j)) < 1.5e-3
    assert best.left < 0.05 * spectra.energy


def test_ring_energies_are_least_squares() -> None:
    """The Gram matrix's energy of a set is that of the linear fit, up to its ridge."""
    centre = 0.004 - 0.002j
    spectra = pair_on(centre, 0.045, [0.0, np.pi / 2])
    echo = RoundBody().echo(spectra, np.array([centre]), np.zeros(1))[0]
    ring = Ring.of(spectra, echo, centre, 0.045, FACING, 48)
    sets, energies = ring.best(3, 5)[2]
    assert np.allclose(np.sort(ring.angles[sets[0]]), [0.0, np.pi / 2])
    row = batch_of(centre, 0.045, list(ring.angles[sets[0]]))
    left = Fitter(spectra, RoundBody(), Priors(), 1.0).left(row)[0]
    assert ring.energy - energies[0] == pytest.approx(left, abs=0.01 * ring.energy)


def test_pairs_about_many_centres_point_to_the_right_one() -> None:
    centre = 0.005 + 0.0j
    spectra = replace(pair_on(centre, 0.045, [0.0, np.pi / 2]))
    grid = np.array([0.0, 0.005, -0.005, 0.005j], dtype=complex)
    echoes = RoundBody().echo(spectra, grid, np.zeros(4))
    left, angles = PairSearch(spectra, 0.045, 36).left(grid, echoes)
    assert int(np.argmin(left)) == 1
    assert difference_deg(gaps_deg(angles[1]), np.array([90.0, 270.0])) <= 10.0


def test_arrangements_are_compared_by_their_gaps() -> None:
    pair = gaps_deg([0.2, 0.2 + np.pi / 2])
    assert difference_deg(pair, gaps_deg([3.0, 3.0 + np.pi / 2])) < 1e-9
    assert difference_deg(pair, gaps_deg([0.0, np.pi])) == pytest.approx(90.0)
    doubled = gaps_deg(np.deg2rad([0.0, 20.0, 180.0, 200.0]))
    assert difference_deg(merged(doubled, resolution_deg(0.035)), np.array([180.0, 180.0])) < 1e-9
    assert len(merged(doubled, resolution_deg(0.11))) == 4


def test_spectra_keep_what_turns() -> None:
    spectra = Spectra.of(scans_of(draw(3, tagged=True).capture))
    assert np.abs(spectra.data.mean(axis=1)).max() < 1e-6 * np.abs(spectra.data).max()


@pytest.mark.parametrize(
    ("colour", "bins", "start_m", "seeds", "bound"),
    [
        # The window of a short recording lies on the object: the noise is told from outside the band,
        # and from the few bins before the object where these show more.
        (0.0, 100, 0.55, 150, 0.03),
        (0.5, 100, 0.55, 400, 0.03),
        # A little of a filter's noise shows over the pulse's band only.
        (0.13, 192, 0.12, 150, 0.08),
        # A long one has bins beside the object, whose spectrum is that of the noise.
        (0.0, 400, 0.2, 150, 0.03),
        (1.0, 400, 0.2, 150, 0.03),
    ],
)
def test_the_noise_is_that_of_the_recording(
    colour: float, bins: int, start_m: float, seeds: int, bound: float
) -> None:
    """Noise of known strength, white or that of a receiver's filter: what is expected is what is there."""
    step = SPEED_OF_LIGHT * 61.035e-12 / 2
    told = found = 0.0
    for seed in range(seeds):
        ranges = start_m + step * np.arange(bins)
        noise = draw_noise(NoiseShape(colour), ranges, 36, np.random.default_rng(seed))
        angles = np.arange(36) * np.pi / 18
        capture = Capture(noise.astype(np.float32), start_m, step, angles, axis_distance_m=1.0)
        spectra = Spectra.of(scans_of(capture))
        told, found = told + spectra.noise_energy, found + spectra.energy
    assert told == pytest.approx(found, rel=bound)


def scans_of(capture: Capture) -> BasebandScans:
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))


def cans(first: int, count: int, snr_db: float) -> list[tuple[str, Capture]]:
    """Tagged cans of the population, at 24 views or more and that SNR."""
    found = []
    for seed in range(first, first + 40 * count):
        specimen = draw(seed, tagged=True)
        if specimen.body == "can" and specimen.views in (24, 36) and specimen.snr_db == snr_db:
            found.append((str(specimen.truth), specimen.capture))
        if len(found) == count:
            break
    return found


def test_tags_on_cans_are_named_and_lie_where_they_were_measured() -> None:
    for truth, capture in cans(500, 3, 20.0):
        reading = read_tag(scans_of(capture), LAYOUTS, SETTINGS)
        assert (reading.status, reading.layout, reading.kind) == ("identified", truth, Kind.ROUND)
        assert reading.bound is not None and reading.bound.population == ANY.population
        layout = builtin_layouts()[truth]
        own = layout.placed(np.deg2rad(reading.rotation_deg), np.array(reading.centre_m))
        found = np.array([(r.x_m, r.y_m) for r in reading.reflectors])
        gap = np.linalg.norm(found[:, None] - own[None], axis=2).min(axis=1)
        # Near the layout's places, but not those: the apparent radius is not the nominal one.
        assert gap.max() < 0.02 and gap.min() > 1e-5


def test_an_untagged_can_has_no_tag_and_the_picture_loses_it() -> None:
    seed = next(s for s in range(400) if (d := draw(s)).body == "can" and d.reflectors == 0 and not d.clutter)
    capture = draw(seed).capture
    reading = read_tag(scans_of(capture), LAYOUTS, SETTINGS)
    assert reading.status in ("no_tag", "unknown")
    assert reading.layout is None
    assert reading.body is not None
    cleaned = without_body(capture, reading.body)

    def moving(one: Capture) -> float:
        return float(((one.samples - one.samples.mean(axis=0)) ** 2).sum())

    noise = float(np.median((np.diff(capture.samples, axis=0) / np.sqrt(2)) ** 2)) * capture.samples.size
    assert moving(cleaned) < max(0.2 * moving(capture), 3 * noise)


@pytest.mark.parametrize("seed", [7, 11, 23, 31])
def test_unenrolled_objects_are_not_named(seed: int) -> None:
    reading = read_tag(scans_of(draw(seed).capture), LAYOUTS, SETTINGS)
    assert reading.status != "identified"
    assert reading.advice == ADVICE[reading.code] != ""
    assert reading.reason


@pytest.mark.parametrize("all_count", [True, False])
def test_more_signal_and_more_views_never_take_a_name_away(
    all_count: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same can at rising SNR and views: once named, named for good."""
    if all_count:
        # Where two reflectors of the best rival come to stand in one place, the next one is far behind, and
        # the lead jumps. Against the same rivals it does not.
        monkeypatch.setattr(reader, "can_stand", lambda *given: True)
    centre, angles = 0.004 - 0.003j, [0.4, 0.4 + np.pi / 2]
    rng = np.random.default_rng(5)
    for views in (24, 48):
        spectra = spectra_of(turn(views), views)
        row = batch_of(centre, 0.041, angles)
        cols = Columns.of(spectra, RoundBody(), row).values[0]
        weight = np.array([20.0, 1.0, 0.3, 0.1]) * np.exp(1j * np.array([0.0, 1.0, 2.0, 0.5]))
        echo = (np.tile(weight, (9, 1))[:, None] @ cols)[:, 0]
        # What no model holds: a share of the tag's echo that does not fall with the noise.
        wrong = centred(0.05 * (rng.standard_normal(echo.shape) + 1j * rng.standard_normal(echo.shape)))
        white = centred(rng.standard_normal(echo.shape) + 1j * rng.standard_normal(echo.shape)) / np.sqrt(2)
        leads = []
        for snr_db in (0.0, 10.0, 20.0, 40.0):
            noise = 10 ** (-snr_db / 20)
            noisy = replace(spectra, data=echo + wrong + noise * white, noise=noise**2)
            reading = read_on_body(noisy, LAYOUTS, RoundBody(), BodySettings())
            assert reading is not None and reading.layouts[0].layout == "container-90"
            leads.append(reading.lead)
        # More signal buys other arrangements more terms of their pattern, which takes a little of the lead.
        assert min(leads[1:]) > 6 * BodyDecision().lead
        if all_count:
            assert all(b > 0.8 * a for a, b in pairwise(leads[1:]))
        else:
            assert min(leads[1:]) > BodyDecision().clear_lead


def test_calibration_promises_no_more_than_it_counted() -> None:
    stratum = Stratum(12, 37, -np.inf, np.inf, {Basis.BODY: Scores(1999, (2.0, 1.0, 0.5))})
    known = Calibration("a test", (stratum,), {Basis.BODY: ((0, 2000),)})
    assert Calibration.from_json(known.to_json()) == known
    bound = known.bound(1.5, 36, 10.0, 1e-3)
    # One object is as convincing on a body.
    assert bound.p_value == pytest.approx(2 / 2000) and bound.reachable and bound.kept
    assert known.bound(0.7, 36, 10.0, 2e-3).kept and not known.bound(0.7, 36, 10.0, 1e-3).kept
    # Below the scores that were kept nothing is promised.
    assert known.bound(0.4, 36, 10.0, 1e-3).p_value == 1.0
    assert not known.bound(9.0, 36, 10.0, 1e-4).reachable
    assert known.bound(9.0, 100, 10.0, 1e-3).objects == 0
    assert known.bound(9.0, 36, 10.0, 1e-3, Basis.BARE).objects == 0
    with pytest.raises(ModelError):
        Calibration.from_json("{}")


def test_the_bound_is_that_of_the_whole_answer() -> None:
    """Drawn again from the same population, no more objects are named in any way than it promises."""
    rng = np.random.default_rng(9)
    free, wall, alone = rng.standard_normal((3, 20_000))
    # Few objects are named without a body at all, and those whatever the bound says.
    bare = np.where(alone > 3.3, alone, -np.inf)
    half = slice(0, 10_000)
    told = [None if lead == -np.inf else float(lead) for lead in bare[half]]
    either = np.maximum(free, wall)
    scores = {Basis.BODY: Scores.of(either[half].tolist(), 60), Basis.BARE: Scores.of(told, 60)}
    known = Calibration("a test", (Stratum(12, 37, -np.inf, np.inf, scores),), {})
    named = bare[10_000:] > -np.inf
    # The reader looks beside a wall where the free pattern is not named.
    for lead in (free, wall):
        bounds = [known.bound(one, 36, 10.0, 5e-3) for one in lead[10_000:]]
        assert bounds[0].otherwise == pytest.approx(sum(one is not None for one in told) / 10_001)
        named |= np.array([bound.kept for bound in bounds])
    assert 20 < named.sum() < 65
    assert not known.bound(9.0, 36, 10.0, bounds[0].otherwise).reachable


def test_the_p_value_is_never_below_that_of_all_scores() -> None:
    """Ties, refused objects, rounding and scores that were not kept: it is exact where it can be."""
    rng = np.random.default_rng(6)
    every = np.round(rng.standard_normal(60), 1)
    refused, keep = 40, 12
    kept = largest([float(s) for s in every], keep)
    assert len(kept) >= keep and kept[-1] > max(s for s in every if s < kept[-1])
    known, blind = Scores(100, kept, 60), Scores(100, kept)
    for score in np.linspace(-3, 3, 121).round(2):
        exact = (np.count_nonzero(every >= score) + 1) / (len(every) + refused + 1)
        one, other = known.p_value(float(score)), blind.p_value(float(score))
        assert exact <= one <= other
        assert (one == other == exact) if score >= kept[-1] else (one == 61 / 101 and other == 1.0)


def test_scores_of_the_file_are_rounded_up() -> None:
    assert largest([0.12341, 0.5, -0.00001], 9) == (0.5, 0.1235, 0.0)


def test_names_without_a_body_are_calibrated_apart() -> None:
    """The rest of the file stays; an object that a body takes the name from gives no evidence."""
    rows = [one(seed, bodies=False) for seed in (942301, 830657)]
    assert [row["bare"] == "refused" for row in rows] == [False, True] and "body" not in rows[0]
    drawn = strata(rows, [12, 24, 361])
    on_body = {Basis.BODY: Scores(9, (2.0,), 1)}
    old = tuple(replace(s, scores=on_body) for s in drawn)
    seeds = [830657, 942301]
    made = replaced(Calibration("a test", old, {Basis.BODY: ((0, 9),)}), drawn, seeds, Basis.BARE)
    assert made.seeds[Basis.BODY] == ((0, 9),)
    assert made.seeds[Basis.BARE] == ((830657, 830658), (942301, 942302))
    assert Calibration.from_json(made.to_json()) == made
    few, many = (one.scores for one in made.strata)
    assert few[Basis.BODY] == many[Basis.BODY] == on_body[Basis.BODY]
    assert (few[Basis.BARE].objects, few[Basis.BARE].scored) == (1, 1)
    assert many[Basis.BARE] == Scores(1, (), 0)
    assert made.bound(float(rows[0]["bare"]), 18, 0.0, 1e-3, Basis.BARE).p_value == 1.0
    finer = replaced(made, strata(rows, [12, 18, 24, 361]), seeds, Basis.BARE)
    assert [sorted(s.scores) for s in finer.strata] == [["body"], ["bare", "body"], ["bare"], ["bare"]]
    assert [(s.views_from, s.views_to) for s in finer.strata] == [(12, 24), (24, 361), (12, 18), (18, 24)]
    assert Calibration.from_json(finer.to_json()) == finer
    assert [finer.bound(9.0, 12, 0.0, 1e-3, kind).objects for kind in (Basis.BODY, Basis.BARE)] == [9, 1]
    assert [finer.bound(9.0, 18, 0.0, 1e-3, kind).objects for kind in (Basis.BODY, Basis.BARE)] == [9, 0]


def test_a_bound_is_stated_in_words() -> None:
    def words(p_value: float, objects: int) -> str:
        return bound_words(Bound(p_value, 1e-3, objects, "24 to 360 views", "boxes"))

    assert words(1 / 2000, 1999) == (
        "false accept at most 0.0005, from 1999 calibration objects (24 to 360 views): boxes"
    )
    assert "0.002 (0.001 is set)," in words(0.002, 1999)
    assert "0.01 (too few objects for 0.001)," in words(0.01, 99)
    assert words(1.0, 0) == "no bound on false accept: no calibration objects of 24 to 360 views"


def test_too_few_calibration_objects_refuse() -> None:
    scores = dict.fromkeys(Basis, Scores(10))
    few = Calibration("few", (Stratum(1, 1000, -np.inf, np.inf, scores),), {})
    settings = ReaderSettings(contest=ContestSettings(calibrated=few))
    _, capture = cans(500, 1, 20.0)[0]
    reading = read_tag(scans_of(capture), LAYOUTS, settings)
    assert (reading.status, reading.code) == ("unknown", Code.UNCALIBRATED)


def test_early_looks_leave_a_name_on_a_body_the_rest_of_the_setting() -> None:
    _, capture = cans(500, 1, 20.0)[0]
    prepared = PreparedCapture(capture, ImagingSettings())
    most, quarter = (identify(prepared, LAYOUTS, spent=spent).reading for spent in (SPENT, 0.75))
    assert most is not None and most.bound is not None and quarter is not None
    assert most.status == "identified"
    assert most.bound.false_accept == pytest.approx((1 - SPENT) * ImagingSettings().false_accept)
    # A quarter is less than the calibration objects can bear out.
    assert (quarter.status, quarter.code) == ("unknown", Code.UNCALIBRATED)


def test_the_default_priors_are_those_of_the_calibration() -> None:
    stored = Workplace(load_config({})).imaging()
    assert stored.priors == TagPriors()
    usual, made = ReaderSettings(), reader_settings(stored)
    assert made.search == usual.search
    assert made.contest.body == usual.contest.body and made.contest.decision == usual.contest.decision


def test_priors_are_set_by_the_user() -> None:
    values = {
        "tags.centre_sigma_m": 0.02,
        "tags.radius_sigma_m": 0.004,
        "tags.radius_inside_m": 0.01,
        "tags.radius_outside_m": 0.005,
        "tags.offset_range_m": 0.05,
    }
    made = reader_settings(Workplace(load_config(values)).imaging())
    assert made.contest.body.priors == Priors(0.02, 0.004, -0.01, 0.005)
    offsets = np.array(made.search.offsets_m)
    # The refinement goes one step beyond the outermost.
    assert offsets[-1] + np.diff(offsets)[-1] == pytest.approx(0.05) and np.diff(offsets).max() < 0.009


@pytest.mark.parametrize("name", [each.name for each in fields(TagPriors)])
@pytest.mark.parametrize("value", [-0.01, 0.06, np.nan])
def test_priors_have_bounds(name: str, value: float) -> None:
    with pytest.raises(UsageError, match=name):
        TagPriors(**{name: value})


def test_a_can_far_off_the_axis_is_named_by_who_expects_it_there() -> None:
    scene = scene_on_body("container-90", parse_body("can:35mm"), parse_reflector("octahedron"))
    acquisition = Acquisition(views=72, snr_db=20.0, placement=Placement((0.018, 0.0), 0.0))
    capture, _ = simulate_capture(scene, acquisition, seed=7)
    usual = identify(capture, LAYOUTS, ImagingSettings()).reading
    assert usual is not None and (usual.status, usual.code) == ("unknown", Code.OFF_CENTRE)
    told = ImagingSettings(priors=TagPriors(centre_sigma_m=0.02))
    reading = identify(capture, LAYOUTS, told).reading
    assert reading is not None and (reading.status, reading.layout) == ("identified", "container-90")
    assert abs(complex(*reading.centre_m) - 0.018) < 0.002
    assert "calibrated with the default priors" in reading.note


def test_the_range_offset_is_searched_as_far_as_it_is_stated() -> None:
    scene = Scene.of_points(builtin_layouts()["container-90"].positions)
    acquisition = Acquisition(views=36, snr_db=20.0, axis_distance_error_m=0.035)
    capture, _ = simulate_capture(scene, acquisition, seed=7)
    usual = identify(capture, LAYOUTS, ImagingSettings()).reading
    told = ImagingSettings(priors=TagPriors(offset_range_m=0.045))
    wider = identify(capture, LAYOUTS, told).reading
    assert usual is not None and abs(usual.offset_m) <= 0.024 + 1e-9
    assert wider is not None and wider.offset_m == pytest.approx(-0.035, abs=0.006)


def bare_pair(views: int) -> Capture:
    scene = Scene.of_points(builtin_layouts()["container-90"].positions)
    return simulate_capture(scene, Acquisition(views=views, snr_db=20.0), seed=7)[0]


@pytest.mark.parametrize(
    ("views", "false_accept", "code"),
    [
        (36, 1e-3, Code.NONE),
        (36, 1e-5, Code.UNCALIBRATED),
        (8, 1e-3, Code.NONE),
        (5, 1e-3, Code.UNCALIBRATED),
    ],
)
def test_names_without_a_body_are_kept_to_the_setting_as_well(
    views: int, false_accept: float, code: Code
) -> None:
    reading = identify(bare_pair(views), LAYOUTS, ImagingSettings(false_accept=false_accept)).reading
    assert reading is not None and reading.kind is Kind.BARE and reading.bound is not None
    assert reading.code is code and (reading.layout == "container-90") == (code is Code.NONE)
    assert reading.bound.objects == (
        0 if views < 6 else Calibration.shipped().bound(9.0, views, 20.0, false_accept, Basis.BARE).objects
    )
    assert reading.bound.kept == (code is Code.NONE)


def test_every_code_has_advice() -> None:
    assert set(ADVICE) == set(Code)
    assert all(ADVICE[code].endswith(".") for code in Code if code is not Code.NONE)


def test_free_positions_are_read_like_a_turntable() -> None:
    """The model needs the antenna's places alone."""
    truth, capture = cans(500, 1, 20.0)[0]
    scans = scans_of(capture)
    free = scans.with_aperture(Aperture(scans.aperture.positions))
    assert np.allclose(Spectra.of(free).data, Spectra.of(scans).data)
    assert truth in {layout.name for layout in LAYOUTS}


def test_a_layout_on_the_axis_has_no_gaps() -> None:
    """It can be enrolled, and is compared with arrangements around a body like any other."""
    middle = Layout("middle", np.array([[0.01, 0.0], [-0.01, 0.0]]))
    assert len(layout_gaps_deg(middle)) == 0
    assert np.allclose(layout_gaps_deg(builtin_layouts()["container-90"]), [90.0, 270.0])


def test_more_amplitudes_than_views_leave_nothing() -> None:
    """A turn of few views: those amplitudes that the views cannot tell are 0."""
    spectra = Spectra.of(scans_of(draw(3, views=6).capture))
    rng = np.random.default_rng(3)
    shape = (len(spectra.wavenumbers), 6, 8)
    columns = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    found = descend(spectra, lambda x: Linear(columns + x[0], np.ones((3, *shape), complex)), np.zeros(3))
    assert found.amplitudes.shape == (shape[0], 8) and np.isfinite(found.amplitudes).all()
    assert found.left < 1e-9 * spectra.energy
