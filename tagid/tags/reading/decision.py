"""When to say a name, and when to say that none is known: every threshold of the reader with its reason.

A wrong name costs more than a question, so each test can only take a name away.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, lgamma, log, pi, sqrt

from tagid.errors import UsageError
from tagid.tags.verdicts.verdict import Code, Verdict

PLACES_PER_METRE = 6500.0
"""Independent places that the search tries per metre of path of the outermost reflector (2 pi r over the
layout's symmetry), for all centres and range offsets together: fitted to the maxima of 720 searches of noise
alone, at 12, 36 and 100 views, of which layouts need 500 to 6000 places. Every pattern tried counts anew."""
SEARCH_GAIN_NATS = 3.0
"""What the best place near a further reflector gains over the reflector itself."""
GAIN_NATS, GAIN_SPREAD_NATS, GAIN_ERROR = 6.5, 1.2, 0.01
"""Mode and width of what one point more explains of a tag that is all there, and how both grow with the tag's
own energy."""
ODDS_ERROR, CLEAR_NATS = 0.02, 100.0
"""Share of the energy beyond CLEAR_NATS that the model may leave unexplained: it takes odds from every tag,
and is nothing beside what a stranger's tag leaves there."""
STRANGER_NATS, STRANGER_SLOPE, STRANGER_PLACES = 8.3, 1.6, 36600.0
"""Preference asked at a false-accept setting of 0.001 with the paper's four layouts enrolled, and how it
grows as the setting becomes one in e times as small; 36600 is those layouts' number of places."""
FEW_VIEWS, FEW_VIEWS_NATS = 36, 4.0
"""Under so many views a stranger's further reflector hides among sidelobes and aspects: down to half of them
the preference asked rises by so much. Both from 600 readings each of tags and of strangers' tags at 12 to 36
views and 0 to 5 dB, of seeds that no benchmark uses."""


@dataclass(frozen=True)
class DecisionSettings:
    """Thresholds of the decision.

    Attributes:
        false_accept: probability of naming what is no tag, or a tag that nobody enrolled; it sets how much
            energy over noise a tag needs, and how strong an echo must be to rule out another object.
        explained_share: least share of the energy above noise that the layout explains.
        gain_nats, gain_spread_nats, gain_share: one reflector more, all placed freely, may explain so many
            noise levels plus this share of the layout's energy beyond its uneven fit. Tags in noise gain 8 in
            the mean and 13 in one of a hundred; wobble of 3 % or hidden sectors add under 1 % of the energy,
            other tags leave 13 % or more.
        missing_share: a reflector weaker than this share of the strongest is missing; less
            `missing_deviations` of a measured amplitude, but never under `missing_least`.
        extra_share: an unexplained point stronger than this share of the layout's median counts as extra.
        displacement_m: RMS distance of freely fitted reflectors from the layout's, above which it is
            another layout; four standard deviations of a measured position are added. A quarter of the
            smallest distance that enrolment accepts.
        least_outward: reflectors that shine only through the object (-0.6 to -0.8) are none of the layout's.
        ambiguous_share: a runner-up within this share of the best's explained energy is as good, since
            wobble, aspect and focus leave errors of that size.
        ambiguous_nats: and so is one within this many noise levels: where the wrong layout led, in 1600 weak
            scenes, it led by 2.5 at most.
    """

    false_accept: float = 1e-3
    explained_share: float = 0.45
    gain_nats: float = 8.0
    gain_spread_nats: float = 5.0
    gain_share: float = 0.06
    missing_share: float = 0.65
    missing_deviations: float = 1.5
    missing_least: float = 0.4
    extra_share: float = 0.5
    displacement_m: float = 3e-3
    least_outward: float = -0.5
    ambiguous_share: float = 0.06
    ambiguous_nats: float = 5.0

    def __post_init__(self) -> None:
        if not 1e-9 <= self.false_accept <= 0.5:
            raise UsageError(
                f"the false-accept probability is {self.false_accept}",
                "Give 1e-9 to 0.5; the default is 0.001.",
            )


@dataclass(frozen=True)
class Evidence:
    """What the decision is taken from.

    Attributes:
        size: reflectors of the best layout.
        nats: its explained energy over the level of noise and clutter left.
        places: independent places that the search tried, all layouts together.
        share: its part of the energy above noise.
        weakest: weakest reflector's amplitude over the strongest's.
        missing, extra: reflectors missing from and beyond the layout.
        gain_nats: what one point more, all placed freely, explains beyond the layout, in noise levels.
        further_nats: the same beyond the layout with reflectors that may shine unevenly.
        odds_nats: log likelihood ratio of the layout over free points in any number.
        outward: -1..1, mean cosine of the angle between a reflector's outward side and the views in which it
            shines, less that of all views: 0 is seen from all sides.
        noise_nats: the layout's explained energy over the noise alone.
        displacement_m: RMS distance of freely fitted reflectors from the layout's places.
        displacement_sigma_m: standard deviation of one measured position.
        margin_share, margin_nats: the best's lead over the runner-up, of its energy and in noise levels.
        views: of one recording, as many as tell anything apart.
        scans: recordings of one object that the energies are sums of.
    """

    size: int
    nats: float
    places: float
    share: float
    weakest: float
    missing: int
    extra: int
    gain_nats: float
    further_nats: float
    odds_nats: float
    outward: float
    noise_nats: float
    displacement_m: float
    displacement_sigma_m: float
    margin_share: float
    margin_nats: float
    views: int
    scans: int = 1


def chance(nats: float, size: int, places: float, scans: int = 1) -> float:
    """Probability that noise alone, searched at so many places a scan, is explained so well by `size` points.

    At one place the energy is Gamma(K) distributed: Q(K, x) = exp(-x) sum_{j<K} x^j / j!.
    """
    if nats <= 0:
        return 1.0
    degrees = size * scans
    terms = [j * log(nats) - lgamma(j + 1) - nats for j in range(degrees)]
    largest = max(terms)
    tail = largest + log(sum(exp(t - largest) for t in terms)) + scans * log(places)
    return exp(min(tail, 0.0))


def nats_needed(size: int, places: float, false_accept: float) -> float:
    """The nats that noise alone, searched at so many places, reaches with probability `false_accept`.

    >>> round(chance(nats_needed(3, 36600.0, 1e-3), 3, 36600.0), 6)
    0.001
    """
    low, high = 0.0, 1e3
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if chance(middle, size, places) > false_accept else (low, middle)
    return high


def odds(e: Evidence) -> float:
    """Nats by which the scans prefer the layout to as many points, or fewer, that lie anywhere.

    Of 690 readings of tags of every kind none fell under 5; under 0 something else lies there.
    """
    return e.odds_nats + ODDS_ERROR * max(e.noise_nats - CLEAR_NATS * e.scans, 0.0)


def preference(e: Evidence) -> float:
    """Nats by which the scans prefer the layout to a stranger's tag of which it is a part.

    The odds against points anywhere, plus the likelihood ratio of what one point more would explain: of a tag
    that is all there, the largest of noise and of the model's own error (Gumbel); of a stranger's, a further
    reflector about as strong as the others, e = nats / K each, with the error of its amplitude.
    """
    each = max(e.noise_nats, 1e-9) / (e.size * e.scans)
    root = sqrt(e.scans)
    wide = (GAIN_SPREAD_NATS + GAIN_ERROR * each * e.size) * root
    usual = (GAIN_NATS + GAIN_ERROR * each * e.size) * e.scans
    off = max((e.gain_nats - usual) / wide, -2.0)
    own = -off - exp(-off) - log(wide)
    spread = sqrt(2 * each) * root
    short = (e.gain_nats - (each + SEARCH_GAIN_NATS) * e.scans) / spread
    other = -0.5 * min(short, 0.0) ** 2 - log(spread * sqrt(2 * pi))
    return odds(e) + own - other


def least_preference(e: Evidence, false_accept: float) -> float:
    """Nats of `preference` that are asked for: few strangers' tags reach them.

    More enrolled layouts have more places to match. tests/benchmarks/identification_null.py counts by how
    much tags and strangers' tags pass or miss it.
    """
    rarer = STRANGER_SLOPE * log(1e-3 / false_accept)
    enrolled = log(max(e.places, 1.0) / STRANGER_PLACES)
    few = min(max(FEW_VIEWS / e.views - 1, 0.0), 1.0)
    return STRANGER_NATS + rarer + enrolled + FEW_VIEWS_NATS * few


def decide(evidence: Evidence, settings: DecisionSettings) -> Verdict:
    """The verdict on reflectors without a body."""
    e, s = evidence, settings
    if chance(e.nats, e.size, e.places, e.scans) > s.false_accept:
        return Verdict("no_tag", Code.NO_ECHO, "nothing stands out of noise and clutter")
    if e.share < s.explained_share:
        return Verdict("unknown", Code.UNEXPLAINED, f"the nearest layout explains {e.share:.0%} of the echo")
    if e.missing:
        return Verdict("unknown", Code.MISSING, f"{e.missing} reflector(s) of the nearest layout are missing")
    by_chance = s.gain_nats * e.scans + s.gain_spread_nats * sqrt(e.scans)
    if e.further_nats > by_chance + s.gain_share * e.noise_nats:
        if e.extra:
            return Verdict("unknown", Code.EXTRA, f"{e.extra} strong reflector(s) beyond the nearest layout")
        more = e.further_nats / max(e.noise_nats, 1e-9)
        return Verdict(
            "unknown", Code.ELSEWHERE, f"points elsewhere explain {more:.0%} more than the nearest layout"
        )
    if e.displacement_m > s.displacement_m + 4 * e.displacement_sigma_m:
        return Verdict(
            "unknown",
            Code.DISPLACED,
            f"reflectors lie {e.displacement_m * 1e3:.1f} mm from the nearest layout's",
        )
    if e.outward < s.least_outward:
        return Verdict(
            "unknown", Code.HIDDEN, "the reflectors of the nearest layout are only seen through the object"
        )
    if odds(e) < 0:
        return Verdict(
            "unknown", Code.ELSEWHERE, "other places explain the echo better than the nearest layout's"
        )
    if preference(e) < least_preference(e, s.false_accept):
        return Verdict("unknown", Code.WEAK, "the echo is too weak to rule out that another object made it")
    if e.margin_share < s.ambiguous_share or e.margin_nats < s.ambiguous_nats:
        return Verdict("ambiguous", Code.AMBIGUOUS, "two layouts explain the echo almost equally well")
    return Verdict("identified")
