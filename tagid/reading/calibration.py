"""What the setting `tags.false_accept` rests on: order statistics of a stated population.

The reader's evidence for a name is its lead (`decision`). Few objects without an enrolled tag look like an
enrolled one beside nothing, more of them like one beside a body: a lead without a body counts `BARE_WORTH`
times. Of n calibration objects that carry no enrolled tag, a new one of the same population is more
convincing than all but k of them with probability (k + 1) / (n + 1) at most, whatever its distribution: the
conformal p-value (Vovk, Gammerman and Shafer 2005, chapter 2). It holds within a stratum of views.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from math import ceil, floor, inf, log

from tagid.errors import ModelError
from tagid.reading.decision import SURE, Needed

FORMAT_VERSION = 6
BARE_WORTH = 5.0
"""Chosen on 530 objects that are not in the calibration: largest leads were 32 nats, without a body 0.5."""
KEPT = 60
"""Leads kept of each stratum: p-values up to 60 / n are exact."""
DIGITS = 2
"""Decimals of the leads in the file, rounded up: a larger one promises less."""


@dataclass(frozen=True)
class Bound:
    """The promise behind a name.

    Attributes:
        p_value: bound on the probability that an object of the population is named as convincingly.
        false_accept: the setting.
        objects: objects without an enrolled tag in this stratum.
        stratum: which one.
        population: what they are.
    """

    p_value: float
    false_accept: float
    objects: int
    stratum: str
    population: str

    @property
    def reachable(self) -> bool:
        """Whether the objects can bear out the setting at all: 1 / (n + 1) <= false_accept."""
        return 1 / (self.objects + 1) <= self.false_accept * (1 + 1e-9)

    @property
    def kept(self) -> bool:
        """Whether the p-value is within the setting."""
        return self.p_value <= self.false_accept * (1 + 1e-9)


@dataclass(frozen=True)
class Stratum:
    """Objects without an enrolled tag, recorded with about as many views.

    Attributes:
        views_from, views_to: views, the first included and the second not.
        objects: how many.
        leads: what their leads count (`worth`), the largest ones, largest first, nats.
    """

    views_from: int
    views_to: int
    objects: int
    leads: tuple[float, ...]

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.views_from} to {self.views_to - 1} views"

    def p_value(self, lead: float) -> float:
        """(k + 1) / (n + 1), k the objects that reach the lead: all of them below the smallest one kept."""
        reached = sum(score >= lead for score in self.leads)
        if self.leads and lead < self.leads[-1]:
            reached = self.objects
        return min((reached + 1) / (self.objects + 1), 1.0)

    def needed(self, false_accept: float) -> float:
        """The lead that fewer objects reach than the setting allows, nats; inf where they are too few.

        What the objects below those kept have is not known: no setting needs less than the smallest kept.
        """
        allowed = floor(false_accept * (1 + 1e-9) * (self.objects + 1)) - 1
        if allowed < 0:
            return inf
        return self.leads[min(allowed, len(self.leads) - 1)] + 10**-DIGITS if self.leads else -inf


@dataclass(frozen=True)
class Calibration:
    """Strata of one population.

    Attributes:
        population: what it is, in words.
        seeds: [first, last) of its seeds.
        strata: which do not overlap.
    """

    population: str
    seeds: tuple[tuple[int, int], ...]
    strata: tuple[Stratum, ...]

    @classmethod
    @cache
    def shipped(cls) -> Calibration:
        """The package's own. Raises ModelError where the file is damaged."""
        return cls.from_json((resources.files("tagid.reading") / "calibration.json").read_text("utf-8"))

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """From what `to_json` wrote. Raises ModelError."""
        try:
            data = json.loads(text)
            if data["format_version"] != FORMAT_VERSION:
                raise ValueError(f"version {data['format_version']}")
            strata = tuple(
                Stratum(
                    int(stratum["views"][0]),
                    int(stratum["views"][1]),
                    int(stratum["objects"]),
                    tuple(sorted((float(lead) for lead in stratum["leads"]), reverse=True)),
                )
                for stratum in data["strata"]
            )
            seeds = tuple((int(first), int(last)) for first, last in data["seeds"])
            return cls(str(data["population"]), seeds, strata)
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            raise ModelError(f"the reader's calibration is damaged: {error}", "Reinstall tagid.") from None

    def to_json(self) -> str:
        """Text of the file."""
        data = {
            "format_version": FORMAT_VERSION,
            "population": self.population,
            "seeds": [list(pair) for pair in self.seeds],
            "strata": [
                {
                    "views": [stratum.views_from, stratum.views_to],
                    "objects": stratum.objects,
                    "leads": list(stratum.leads),
                }
                for stratum in self.strata
            ],
        }
        return json.dumps(data, indent=1) + "\n"

    def needed(self, views: int, false_accept: float) -> Needed:
        """Leads from which a name keeps the setting, nats; inf where no objects bear it out.

        Where the hypotheses are complete it is ln(1 / false_accept), which is needed at least, and 6.9.
        """
        stratum, theory = self._stratum(views), max(log(1 / false_accept), SURE)
        least = inf if stratum is None else stratum.needed(false_accept)
        return Needed(max(least, theory), max(least / BARE_WORTH, theory))

    def bound(self, lead: float, views: int, false_accept: float) -> Bound:
        """The promise for what a lead counts (`worth`); no objects where no stratum fits."""
        stratum = self._stratum(views)
        if stratum is None:
            return Bound(1.0, false_accept, 0, f"{views} views", self.population)
        return Bound(stratum.p_value(lead), false_accept, stratum.objects, stratum.name, self.population)

    def covers(self, views: int) -> bool:
        """Whether objects recorded with so many views were read."""
        return self._stratum(views) is not None

    def _stratum(self, views: int) -> Stratum | None:
        inside = (stratum for stratum in self.strata if stratum.views_from <= views < stratum.views_to)
        return next(inside, None)


def worth(lead: float, bare: float) -> float:
    """What a lead, and that without a body, count together, nats.

    One without a body that names nothing, as it is below theory, counts no more than any.
    """
    return max(lead, BARE_WORTH * bare) if bare >= SURE else lead


def largest(leads: Sequence[float]) -> tuple[float, ...]:
    """The largest leads, largest first, rounded up for the file."""
    rounded = sorted((ceil(lead * 10**DIGITS) / 10**DIGITS for lead in leads), reverse=True)
    return tuple(rounded[:KEPT])
