"""What the setting `tags.false_accept` rests on: order statistics of a stated population.

The reader's evidence for a tag is one number, where every test of the decision is passed: on a body (`score`
in `bodies.decide`, the larger of those with a free pattern and beside a wall) or without one
(`PointReading.lead`). Of n calibration objects that carry no enrolled tag, a new one of the same population
is more convincing than all but k of them with probability (k + 1) / (n + 1) at most, whatever its
distribution: the conformal p-value (Vovk, Gammerman and Shafer 2005, chapter 2). It holds within a stratum of
views and SNR.

The bound of a name on a body is that of the whole answer, whichever way a name was found: objects named
without a body count in full, whatever their lead, beside those that are as convincing on one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib import resources
from math import ceil

import numpy as np

from tagid.errors import ModelError

FORMAT_VERSION = 5
DIGITS = 4
"""Decimals of the scores in the file, rounded up: a larger one promises less."""


@dataclass(frozen=True)
class Bound:
    """The promise behind a name.

    Attributes:
        p_value: bound on the probability that an object of the population is named as convincingly.
        false_accept: the setting.
        objects: null and foreign objects in this stratum.
        stratum: which one.
        population: what they are.
        otherwise: share of them that is named by other evidence, however strong this is.
    """

    p_value: float
    false_accept: float
    objects: int
    stratum: str
    population: str
    otherwise: float = 0.0

    @property
    def reachable(self) -> bool:
        """Whether the objects can bear out the setting at all: otherwise + 1 / (n + 1) <= false_accept."""
        return self.otherwise + 1 / (self.objects + 1) <= self.false_accept * (1 + 1e-9)

    @property
    def kept(self) -> bool:
        """Whether the p-value is within the setting."""
        return self.p_value <= self.false_accept * (1 + 1e-9)


class Basis(StrEnum):
    """By which model a layout is named."""

    BODY = "body"
    """On a body, with a free pattern or beside a wall of known waves."""
    BARE = "bare"
    """Without a body."""


@dataclass(frozen=True)
class Scores:
    """Leads that calibration objects reached by one model.

    Attributes:
        objects: how many there are.
        kept: the largest leads, largest first, and all that equal the last of them; objects that a test
            refuses have none.
        scored: how many objects have a lead, kept here or not; None where that was not counted.
    """

    objects: int = 0
    kept: tuple[float, ...] = ()
    scored: int | None = None

    def reached(self, score: float) -> int:
        """How many objects reach the score.

        Exact down to the smallest score kept. Below it, at most the number of objects with a score; all
        objects where that was not counted.
        """
        above = sum(1 for one in self.kept if one >= score)
        if self.kept and score < self.kept[-1]:
            above = self.objects if self.scored is None else self.scored
        return above

    def p_value(self, score: float, ways: int = 1) -> float:
        """(w k + 1) / (n + 1), at most 1, k the objects that reach the score, w the `ways` to a name."""
        return min((ways * self.reached(score) + 1) / (self.objects + 1), 1.0)

    @classmethod
    def of(cls, leads: Sequence[float | None], keep: int) -> Scores:
        """Of as many objects as leads, None for one that a test refuses."""
        told = [lead for lead in leads if lead is not None]
        return cls(len(leads), largest(told, keep), len(told))


@dataclass(frozen=True)
class Stratum:
    """Calibration objects recorded alike.

    Attributes:
        views_from, views_to: views, the first included and the second not.
        snr_from_db, snr_to_db: energy of what is not of the body over that of the noise, likewise.
        scores: by every kind of evidence that was calibrated.
    """

    views_from: int
    views_to: int
    snr_from_db: float
    snr_to_db: float
    scores: Mapping[Basis, Scores]

    @property
    def name(self) -> str:
        """For people."""
        views = f"{self.views_from} to {self.views_to - 1} views"
        if np.isinf(self.snr_from_db) and np.isinf(self.snr_to_db):
            return views
        return f"{views}, {self.snr_from_db:g} to {self.snr_to_db:g} dB"


@dataclass(frozen=True)
class Calibration:
    """Strata of one population.

    Attributes:
        population: what it is, in words.
        strata: those with scores of one kind of evidence do not overlap.
        seeds: [first, last) of the population's seeds, by kind of evidence.
        terms: most terms of the reflectors' free pattern with which layouts were read.
    """

    population: str
    strata: tuple[Stratum, ...]
    seeds: Mapping[Basis, tuple[tuple[int, int], ...]]
    terms: int = 5

    @classmethod
    @cache
    def shipped(cls) -> Calibration:
        """The package's own. Raises ModelError where the file is damaged."""
        text = (resources.files("tagid.tags.bodies") / "calibration.json").read_text("utf-8")
        return cls.from_json(text)

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """From what `to_json` wrote. Raises ModelError."""
        try:
            data = json.loads(text)
            if data["format_version"] != FORMAT_VERSION:
                raise ValueError(f"version {data['format_version']}")
            strata = tuple(
                Stratum(
                    int(one["views"][0]),
                    int(one["views"][1]),
                    _number(one["snr_db"][0], -np.inf),
                    _number(one["snr_db"][1], np.inf),
                    {
                        Basis(kind): Scores(
                            int(some["objects"]),
                            tuple(sorted((float(s) for s in some["kept"]), reverse=True)),
                            _count(some["scored"]),
                        )
                        for kind, some in one["scores"].items()
                    },
                )
                for one in data["strata"]
            )
            seeds = {
                Basis(kind): tuple((int(a), int(b)) for a, b in pairs)
                for kind, pairs in data["seeds"].items()
            }
            return cls(str(data["population"]), strata, seeds, int(data["terms"]))
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            raise ModelError(f"the reader's calibration is damaged: {error}", "Reinstall tagid.") from None

    def to_json(self) -> str:
        """Text of the file."""
        rows = [
            {
                "views": [one.views_from, one.views_to],
                "snr_db": [None if np.isinf(v) else v for v in (one.snr_from_db, one.snr_to_db)],
                "scores": {
                    kind.value: {"objects": some.objects, "kept": list(some.kept), "scored": some.scored}
                    for kind, some in one.scores.items()
                },
            }
            for one in self.strata
        ]
        data = {
            "format_version": FORMAT_VERSION,
            "population": self.population,
            "seeds": {kind.value: [list(pair) for pair in pairs] for kind, pairs in self.seeds.items()},
            "terms": self.terms,
            "strata": rows,
        }
        return json.dumps(data, indent=1) + "\n"

    def bound(
        self, score: float, views: int, snr_db: float, false_accept: float, kind: Basis = Basis.BODY
    ) -> Bound:
        """The promise for evidence of that strength; no objects where no stratum fits."""
        found = self._scores(kind, views, snr_db)
        if found is None:
            return Bound(1.0, false_accept, 0, f"{views} views, {snr_db:.0f} dB", self.population)
        name, some = found
        otherwise, ways = 0.0, len(Basis)
        if kind is Basis.BODY:
            bare = self._scores(Basis.BARE, views, snr_db)
            ways = 1
            otherwise = bare[1].reached(-np.inf) / (bare[1].objects + 1) if bare is not None else 0.0
        p_value = min(otherwise + some.p_value(score, ways), 1.0)
        return Bound(p_value, false_accept, some.objects, name, self.population, otherwise)

    def _scores(self, kind: Basis, views: int, snr_db: float) -> tuple[str, Scores] | None:
        """Name of the stratum of such recordings, and its scores."""
        for one in self.strata:
            inside = kind in one.scores and one.views_from <= views < one.views_to
            if inside and one.snr_from_db <= snr_db < one.snr_to_db:
                return one.name, one.scores[kind]
        return None


def _number(value: float | None, missing: float) -> float:
    return missing if value is None else float(value)


def _count(value: int | None) -> int | None:
    return None if value is None else int(value)


def largest(scores: Sequence[float], keep: int) -> tuple[float, ...]:
    """The largest scores, rounded up for the file, and all that equal the last of them."""
    rounded = sorted((ceil(score * 10**DIGITS) / 10**DIGITS for score in scores), reverse=True)
    return tuple(score for score in rounded if len(rounded) <= keep or score >= rounded[keep - 1])
