"""What a fit by analysis through synthesis takes and gives, whatever runs it.

Commands, benchmarks and both presets mean the same by a setting and by a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from typing import Any

from tagid.errors import UsageError

StepProgress = Callable[[int, int, float], None]
"""Called after every step with (steps done, steps at most, loss)."""

LEAST_HELD_OUT = 18
"""Fewer views are all needed for the image."""
STEPS, STEPS_OF_FEW = 100, 150

PASSES = 10
"""Steps that see each view of a scene that the defaults do not explain. Where a few views hold most of the
energy, as the flashes of a box do, subsets of the views pull the field to and fro, and the steps end before
it has settled: of 20 objects at 360 views (seeds 5100 and 5101 of `held-out`) the dense prior with 12
views a step leaves 5 % more of the energy of unseen views than with 10 passes, and in 6 of them more than
backprojection, with 10 passes in none. 20 passes change nothing. Reflectors do not ask for it: their places
are read more accurately from a field that is still a little blurred (0.22 mm, with 10 passes 0.33 mm)."""

ENGINES = ("auto", "native", "onnx", "torch")
CALIBRATIONS = ("axis", "wobble", "gain", "static")

LEARNING_RATE, DECAY = 0.06, 0.2
"""Adam's rate, and what is left of it after all steps (exponential decay)."""
WOBBLE_HARMONICS = 4
"""Harmonics of the angle error over a turn that `calibrate=wobble` learns."""
LEVELS, FEATURES, COARSEST, WIDTH = 8, 2, 8, 16
"""Sizes of the field: resolutions of the encoding, features of each, cells a side of the coarsest, and units
of the hidden layer. The exported graph has these levels."""
THREADS = 1
"""Of an engine: the layers are so small that a second thread gains little where the cores are idle, and waits
for its slice where they are not."""


@dataclass(frozen=True)
class FieldPrior:
    """What a field assumes of the scene.

    Attributes:
        l1: weight of the sparsity prior, as a fraction of the weight at which the image would be zero.
        noise_factor: the weight is never less than this times the standard deviation of A^H noise (where the
            noise is known), and never more than half of what gives a zero image.
    """

    l1: float = 0.03
    noise_factor: float = 3.0


class Prior(StrEnum):
    """What a field assumes of the scene: the defaults, and a stronger and a weaker sparsity prior."""

    DEFAULT = "default"
    SPARSE = "sparse"
    DENSE = "dense"


FIELDS = {
    Prior.DEFAULT: FieldPrior(),
    Prior.SPARSE: FieldPrior(l1=0.1),
    Prior.DENSE: FieldPrior(l1=0.003, noise_factor=1.0),
}
"""How sparse each is."""

AUTO = "auto"
PRIORS = (AUTO, *(prior.value for prior in FIELDS))
"""Choices of `AtsSettings.prior`."""

_BOUNDS = {
    "steps": (0, 10**6), "seed": (0, 2**32 - 1), "robust": (0, 1e6), "spreading": (0, 16),
    "beam_width_deg": (0, 360),
}  # fmt: skip
"""Least and greatest value of each setting: what no fit has a use for beyond, or cannot compute."""


@dataclass(frozen=True)
class AtsSettings:
    """What a person chooses of the fit.

    Attributes:
        engine: "native" (numpy and the compiled kernels), "onnx", "torch", or "auto": the first of them that
            is there and can do what is asked.
        device: "cpu", or "cuda" (torch only).
        seed: of the initial weights; the same seed gives the same image on the same machine and engine.
        steps: optimisation steps; 0: 100, and 150 with so few views (`LEAST_HELD_OUT`) that the scans leave
            the scene ill determined and the fit converges slowly (100 leave a quarter more of unseen views).
        prior: of `PRIORS`: how sparse the scene is, or "auto": as unseen views ask for it
            (`tagid.imaging.ats.adapt`).
        calibrate: what is learned together with the scene, of `CALIBRATIONS`: the axis distance, the
            harmonics of the rotation's wobble, a gain of every scan, a static component that no turn changes.
        robust: residuals beyond this many standard deviations are weighed down (Huber); 0: never.
        spreading: an echo's amplitude falls with this power of the range: 2 for a point reflector in free
            space, 0 if the radar or an earlier step has made up for it.
        beam_width_deg: full -3 dB width of the antenna's one-way power pattern; 0: it sees all round.
    """

    engine: str = "auto"
    device: str = "cpu"
    seed: int = 0
    steps: int = 0
    prior: str = AUTO
    calibrate: tuple[str, ...] = ()
    robust: float = 0.0
    spreading: float = 0.0
    beam_width_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, value, known in (("engine", self.engine, ENGINES), ("prior", self.prior, PRIORS)):
            if value not in known:
                raise UsageError(f"there is no ATS {name} {value!r}", f"Use {', '.join(known)}.")
        for what in self.calibrate:
            if what not in CALIBRATIONS:
                raise UsageError(f"ATS cannot learn {what!r}", f"Use {', '.join(CALIBRATIONS)}.")
        if self.device != "cpu" and self.engine == "onnx":
            raise UsageError(f"`engine=onnx` does not run on {self.device}", "Use `engine=torch`.")
        for name, (low, high) in _BOUNDS.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"ATS setting {name} is {getattr(self, name)}", f"Give {low:g} to {high:g}.")

    @property
    def is_plain(self) -> bool:
        """Whether points alone explain the scans, at antenna positions that may be learned."""
        beside = set(self.calibrate) - {"axis", "wobble"}
        return not (beside or self.robust or self.spreading or self.beam_width_deg)


@dataclass(frozen=True)
class FitSettings(AtsSettings):
    """What one fit runs with: the settings, and what the prior and the number of views make of them.

    Attributes:
        l1, noise_factor: see `FieldPrior`.
        views_per_step: views of one step; a capture with more is used in interleaved subsets by turns. A
            scene that is not explained so gets more (`seeing_all`).
        held_out: share of the views that the fit does not see; none under `LEAST_HELD_OUT` views.
    """

    l1: float = FieldPrior.l1
    noise_factor: float = FieldPrior.noise_factor
    views_per_step: int = 12
    held_out: float = 0.04

    @classmethod
    def of(cls, settings: AtsSettings) -> FitSettings:
        """Those of a fit as the settings ask for it."""
        if isinstance(settings, FitSettings):
            return settings
        field = FIELDS[Prior.DEFAULT if settings.prior == AUTO else Prior(settings.prior)]
        return cls(**vars(settings), **asdict(field))

    def for_views(self, views: int) -> FitSettings:
        """The same with a number of steps where they leave it open."""
        return replace(self, steps=self.steps or (STEPS if views >= LEAST_HELD_OUT else STEPS_OF_FEW))

    def seeing_all(self, views: int) -> FitSettings:
        """The same with so many views a step that the fit sees each `PASSES` times."""
        needed = -(-PASSES * views // self.for_views(views).steps)
        return replace(self, views_per_step=max(self.views_per_step, min(needed, views)))

    def facts(self) -> dict[str, Any]:
        """All of them and what is fixed, as JSON values of an image's settings."""
        facts = {**asdict(self), **_FIXED, "preset": "field", "adapt": int(self.prior == AUTO)}
        del facts["prior"]  # an image says it where it is no field's
        facts["held_out_share"] = facts.pop("held_out")  # in an image that is how well it predicts
        return {**facts, "calibrate": list(self.calibrate)}


_FIXED: dict[str, float] = {
    "learning_rate": LEARNING_RATE, "network_rate": 1.0, "decay": DECAY, "smoothness": 0.0,
    "wobble_harmonics": WOBBLE_HARMONICS, "patience": 0, "width": WIDTH, "hidden": 1, "finest_m": 0.0,
    "levels": LEVELS, "features": FEATURES, "coarsest": COARSEST, "threads": THREADS,
}  # fmt: skip
"""What once was a setting, as an image's settings go on to say it; no command, benchmark or page used another
value."""

_SPARSITY = "Use prior=sparse (l1 0.1), prior=default (0.03) or prior=dense (0.003)."
_AUTOMATIC = "Leave it away: prior=auto shows what it was for."
_NOW = {
    "l1": _SPARSITY, "noise_factor": _SPARSITY, "smoothness": "Use prior=dense.",
    "patience": "Give steps=N to end a fit earlier.", "finest_m": "Give more or fewer `imaging.pixels`.",
    "held_out": "Leave it away: it is 0.04.", "views_per_step": "Leave it away: it follows the scene.",
    "aspect_harmonics": _AUTOMATIC, "occlusion": _AUTOMATIC,
}  # fmt: skip
"""What to do in the place of a setting that is gone."""

NOT_WORDS = ("seed", "engine", "device")
"""Settings with options of their own."""


def setting_names() -> list[str]:
    """Names that `parse_settings` takes."""
    return [f.name for f in fields(AtsSettings) if f.name not in NOT_WORDS]


def parse_settings(words: Iterable[str]) -> dict[str, Any]:
    """Arguments for `AtsSettings` of words KEY=VALUE, each of which may hold several after commas.

    Values of a list are joined by "+": `calibrate=axis+wobble`. `adapt=0` means `prior=default`. Raises
    UsageError: a name that does not exist, or a value of the wrong kind.
    """
    values: dict[str, Any] = {}
    for part in (p.strip() for word in words for p in word.split(",")):
        if not part:
            continue
        name, equals, text = (t.strip() for t in part.partition("="))
        if equals and name == "adapt":
            name, text = "prior", Prior.DEFAULT if _value(name, text, 1) == 0 else AUTO
        if equals and name in {*_FIXED, *_NOW}:
            remedy = _NOW.get(name, f"Leave it away: it is {_FIXED.get(name)}.")
            raise UsageError(f"ATS no longer has the setting {name}", remedy)
        if not equals or name not in setting_names():
            raise UsageError(
                f"there is no ATS setting {part!r}", f"Give KEY=VALUE with {', '.join(setting_names())}."
            )
        values[name] = _value(name, text, getattr(AtsSettings, name))
    return values


def parse_calibrate(text: str) -> tuple[str, ...]:
    """What is learned beside the scene, of `axis,wobble,gain,static`; commas or "+" between."""
    return tuple(dict.fromkeys(p.strip() for p in text.replace("+", ",").split(",") if p.strip()))


def _value(name: str, text: str, default: Any) -> Any:
    if isinstance(default, tuple):
        return parse_calibrate(text)
    kind = type(default)
    try:
        return kind(text)
    except ValueError:
        words = {int: "a whole number", float: "a number"}[kind]
        raise UsageError(f"ATS setting {name} is {text!r}, expected {words}", f"Give {words}.") from None
