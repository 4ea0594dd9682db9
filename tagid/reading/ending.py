"""The calibration of early endings: order statistics of the largest score over a whole turn.

Of n calibration turns without an enrolled tag, the largest score of a new one reaches all but k of theirs
with probability (k + 1) / (n + 1) at most, whatever its distribution (conformal p-value; Vovk, Gammerman and
Shafer 2005, chapter 2). As the largest score over all looks is compared, the bound holds for the whole
procedure. It holds for the calibration's population, within its views per turn.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from math import inf

from tagid.errors import ModelError
from tagid.reading.calibration import Bound
from tagid.reading.looks import LOOKS, SPENT, Look, agreed

FORMAT_VERSION = 2


@dataclass(frozen=True)
class EndingCalibration:
    """Largest scores of whole turns without an enrolled tag.

    Attributes:
        population: what they are, in words.
        seeds: [first, last) numbers of the turns.
        looks: shares of a turn that were read.
        fewest_views: views per turn.
        turns: number of turns.
        scores: their largest scores where an early ending was possible at all, largest first.
    """

    population: str
    seeds: tuple[int, int]
    looks: tuple[float, ...]
    fewest_views: int
    turns: int
    scores: tuple[float, ...]

    @classmethod
    @cache
    def shipped(cls) -> EndingCalibration:
        """The package's own. Raises ModelError if the file is damaged."""
        return cls.from_json((resources.files("tagid.reading") / "ending.json").read_text("utf-8"))

    @classmethod
    def from_json(cls, text: str) -> EndingCalibration:
        """From the text of `to_json`. Raises ModelError."""
        try:
            data = json.loads(text)
            if data["format_version"] != FORMAT_VERSION:
                raise ValueError(f"version {data['format_version']}")
            first, last = data["seeds"]
            made = cls(
                str(data["population"]),
                (int(first), int(last)),
                tuple(float(share) for share in data["looks"]),
                int(data["fewest_views"]),
                int(data["turns"]),
                tuple(sorted((float(score) for score in data["scores"]), reverse=True)),
            )
            if made.looks != LOOKS:
                raise ValueError(f"looks at {made.looks} of a turn")
            return made
        except (ValueError, KeyError, TypeError) as error:
            raise ModelError(
                f"the calibration of early endings is damaged: {error}", "Reinstall tagid."
            ) from None

    @property
    def stratum(self) -> str:
        """The recordings that the calibration applies to, for people."""
        return f"{self.fewest_views} views per turn or more"

    def to_json(self) -> str:
        """Text of the file."""
        data = {
            "format_version": FORMAT_VERSION,
            "population": self.population,
            "seeds": list(self.seeds),
            "looks": list(self.looks),
            "fewest_views": self.fewest_views,
            "turns": self.turns,
            "scores": [round(score, 4) for score in self.scores],
        }
        return json.dumps(data, indent=1) + "\n"

    def reaches(self, false_accept: float) -> bool:
        """Whether there are enough turns to bear out any early ending at this setting."""
        return self._bound(1.0, false_accept, self.turns).reachable

    def bound(self, looks: Sequence[Look], false_accept: float) -> Bound:
        """The bound of ending after these looks; it has no objects where the calibration does not apply.

        Args:
            looks: so far, in the order of `LOOKS`.
            false_accept: of the whole scan; early endings may use the share `SPENT` of it.
        """
        _, score = agreed(looks)
        newest = looks[-1]
        if newest.views / newest.share < self.fewest_views:
            return self._bound(1.0, false_accept, 0)
        reached = sum(reached_score >= score for reached_score in self.scores)
        p_value = 1.0 if score == -inf else min((reached + 1) / (self.turns + 1), 1.0)
        return self._bound(p_value, false_accept, self.turns)

    def _bound(self, p_value: float, false_accept: float, turns: int) -> Bound:
        return Bound(p_value, SPENT * false_accept, turns, self.stratum, self.population)
