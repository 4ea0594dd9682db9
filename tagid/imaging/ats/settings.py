"""What a fit by analysis through synthesis takes and gives, whatever runs it.

Commands, benchmarks and both presets mean the same by a setting and by a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.heldout import Prediction
from tagid.imaging.lengths import finest_cell_m
from tagid.imaging.types import Image

if TYPE_CHECKING:
    from tagid.imaging.ats.problem import FieldShape, FieldWeights

Progress = Callable[[int, int, float], None]
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

PRESETS = ("field",)
ENGINES = ("auto", "native", "onnx", "torch")
CALIBRATIONS = ("axis", "wobble", "gain", "static")

_BOUNDS = {
    "steps": (0, 10**6), "views_per_step": (1, 10**6), "patience": (0, 10**6), "seed": (0, 2**32 - 1),
    "threads": (1, 1024), "adapt": (0, 10**6), "width": (1, 1024), "hidden": (0, 64), "levels": (1, 64),
    "features": (1, 64), "coarsest": (1, 1024), "wobble_harmonics": (0, 64), "aspect_harmonics": (0, 64),
    "learning_rate": (1e-9, 1e3), "network_rate": (1e-9, 1e3), "decay": (1e-9, 1e3), "l1": (0, 1e3),
    "noise_factor": (0, 1e6), "smoothness": (0, 1e6), "robust": (0, 1e6), "occlusion": (0, 1e3),
    "spreading": (0, 16), "beam_width_deg": (0, 360), "finest_m": (0, 1e4),
}  # fmt: skip
"""Least and greatest value of each setting: what no fit has a use for beyond, or cannot compute."""


@dataclass(frozen=True)
class AtsSettings:
    """Parameters of the fit.

    Attributes:
        preset: "field", this project's method.
        engine: "native" (numpy and the compiled kernels), "onnx", "torch", or "auto": the first of them that
            is there and can do what is asked.
        device: "cpu", or "cuda" (torch only).
        steps: optimisation steps at most; 0: 100, and 150 with so few views (`LEAST_HELD_OUT`) that the scans
            leave the scene ill determined and the fit converges slowly (100 leave a quarter more of unseen
            views).
        learning_rate: Adam's rate for the encoding; the network gets `network_rate` of it.
        network_rate: see there.
        decay: what is left of the rates after `steps` steps (exponential decay).
        l1: weight of the sparsity prior, as a fraction of the weight at which the image would be zero.
        noise_factor: the weight is never less than this times the standard deviation of A^H noise (where the
            noise is known), and never more than half of what gives a zero image.
        smoothness: weight of the neighbourhood prior sum |sigma_i - sigma_j|^2, relative to the weight of the
            data in one pixel.
        robust: residuals beyond this many standard deviations are weighed down (Huber); 0: never.
        calibrate: what is learned together with the scene, of `CALIBRATIONS`: the axis distance, the
            harmonics of the rotation's wobble, a gain of every scan, a static component that no turn changes.
        wobble_harmonics: harmonics of the angle error over a turn.
        aspect_harmonics: M; a point's reflectivity is a sum of exp(j m aspect), |m| <= M. 0: isotropic.
        occlusion: what lies behind bright points is dimmed: attenuation by a cell of the encoding (0.096
            wavelengths) that is as bright as the brightest, in nepers, two ways; 0: nothing hides behind
            anything. Of weaker cells it is less, as their power.
        spreading: an echo's amplitude falls with this power of the range: 2 for a point reflector in free
            space, 0 if the radar or an earlier step has made up for it.
        beam_width_deg: full -3 dB width of the antenna's one-way power pattern; 0: it sees all round.
        views_per_step: views of one step; a capture with more is used in interleaved subsets by turns. A
            scene that is not explained so gets more (`seeing_all`), unless `adapt` is 0.
        held_out: share of the views that the fit does not see, which tell when to stop; none under 18 views.
        patience: checks (every 10 steps of the second half) without a lower held-out residual before the fit
            stops; 0: never, which is the default since a noisy check stops some fits long before their end.
        adapt: try other priors where unseen views ask for it (`tagid.imaging.ats.adapt`); 0: never.
        width, hidden: units of a hidden layer, and hidden layers of the network.
        finest_m: edge of the finest cell of the encoding, m, never finer than the pixels; 0: from the
            wavelength (`tagid.imaging.lengths.CELL_WAVELENGTHS`).
        levels, features, coarsest: resolutions, features of each, cells a side of the coarsest.
        seed: of the initial weights; the same seed gives the same image on the same machine and engine.
        threads: of the engine. One is the default: the layers are so small that a second thread gains little
            where the cores are idle, and waits for its slice where they are not.
    """

    preset: str = "field"
    engine: str = "auto"
    device: str = "cpu"
    steps: int = 0
    learning_rate: float = 0.06
    network_rate: float = 1.0
    decay: float = 0.2
    l1: float = 0.03
    noise_factor: float = 3.0
    smoothness: float = 0.0
    robust: float = 0.0
    calibrate: tuple[str, ...] = ()
    wobble_harmonics: int = 4
    aspect_harmonics: int = 0
    occlusion: float = 0.0
    spreading: float = 0.0
    beam_width_deg: float = 0.0
    views_per_step: int = 12
    held_out: float = 0.04
    patience: int = 0
    adapt: int = 1
    width: int = 16
    hidden: int = 1
    finest_m: float = 0.0
    levels: int = 8
    features: int = 2
    coarsest: int = 8
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        for name, value, known in (("preset", self.preset, PRESETS), ("engine", self.engine, ENGINES)):
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
        if not 0 <= self.held_out <= 0.5:
            raise UsageError(f"held-out share is {self.held_out}", "Give 0 to 0.5.")

    def for_views(self, views: int) -> AtsSettings:
        """These settings with a number of steps where they leave it open."""
        steps = self.steps or (STEPS if views >= LEAST_HELD_OUT else STEPS_OF_FEW)
        return replace(self, steps=steps)

    def seeing_all(self, views: int) -> AtsSettings:
        """These settings with so many views a step that the fit sees each `PASSES` times."""
        needed = -(-PASSES * views // self.for_views(views).steps)
        return replace(self, views_per_step=max(self.views_per_step, min(needed, views)))

    def shape(self, grid: ImageGrid, wavelength_m: float) -> FieldShape:
        """Sizes of the field for a grid: the finest cell is `finest_m`, or a pixel where that is larger."""
        from tagid.imaging.ats.problem import FieldShape

        cell = self.finest_m or finest_cell_m(wavelength_m)
        finest = min(grid.pixels, max(self.coarsest, round(grid.extent / cell)))
        coarsest = min(self.coarsest, finest)
        series = np.geomspace(coarsest, finest, self.levels) if self.levels > 1 else np.array([finest])
        cells = tuple(int(n) for n in np.floor(series + 1e-9))
        return FieldShape(cells, self.features, self.width, self.hidden, 2 * self.aspect_harmonics + 1)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What was learned of the recording beside the scene.

    Attributes:
        axis_distance_m: distance to the rotation axis; None for free antenna positions.
        axis_offset_m: its difference from the one given.
        axis_sigma_m: its standard error, from the curvature of the fit; nan where it was not learned.
        wobble_rad: (harmonics,) complex w: the angle error over a turn is Re sum w_k exp(j k angle), k = 1..
        wobble_sigma_rad: (harmonics,) standard error of real and imaginary part.
        gain: (views,) of every scan that was fitted; its mean is 1.
        gain_sigma: (views,) its standard error.
        static: (bins,) complex component that no turn changes.
    """

    axis_distance_m: float | None
    axis_offset_m: float
    axis_sigma_m: float
    wobble_rad: NDArray[np.complex128]
    wobble_sigma_rad: NDArray[np.float64]
    gain: NDArray[np.float64]
    gain_sigma: NDArray[np.float64]
    static: NDArray[np.complex64]

    def facts(self, learned: tuple[str, ...]) -> dict[str, Any]:
        """What was learned, of `CALIBRATIONS`, as plain JSON values; empty if nothing was."""
        values: dict[str, Any] = {}
        if "axis" in learned and np.isfinite(self.axis_sigma_m):
            values["axis"] = {
                "distance_m": self.axis_distance_m,
                "offset_m": self.axis_offset_m,
                "sigma_m": self.axis_sigma_m,
            }
        if "wobble" in learned and np.isfinite(self.wobble_sigma_rad).all():
            values["wobble"] = [
                {
                    "harmonic": order,
                    "amplitude_deg": float(np.degrees(abs(w))),
                    "phase_deg": float(np.degrees(np.angle(w))),
                    "sigma_deg": float(np.degrees(sigma)),
                    "speed_percent": float(100 * order * abs(w)),
                }
                for order, (w, sigma) in enumerate(
                    zip(self.wobble_rad, self.wobble_sigma_rad, strict=True), start=1
                )
            ]
        if "gain" in learned and np.isfinite(self.gain_sigma).all():
            values["gain"] = {
                "scans": [round(float(g), 5) for g in self.gain],
                "sigma": [round(float(g), 5) for g in self.gain_sigma],
                "spread": float(self.gain.std()),
            }
        if "static" in learned:
            values["static"] = {"rms": float(np.sqrt((np.abs(self.static) ** 2).mean()))}
        return values


@dataclass(frozen=True, eq=False)
class AtsResult:
    """What a fit gives.

    Attributes:
        image: complex reflectivity on the grid asked for.
        losses: loss of every step.
        calibration: what was learned beside the scene.
        unseen: (n,) numbers of the views that the fit did not see.
        prediction: what it predicts of them.
        seconds: of the whole fit, set-up included.
        field: the fitted field, to be evaluated at any resolution; None for blank data and where the linear
            solution took its place.
    """

    image: Image
    losses: tuple[float, ...]
    calibration: Calibration
    unseen: NDArray[np.integer]
    prediction: Prediction
    seconds: float
    field: FieldWeights | None = field(default=None, repr=False)

    @property
    def held_out(self) -> float:
        """Energy of the residual on the unseen views over their energy, one complex factor fitted; nan
        without any."""
        return self.prediction.residual

    def on(self, grid: ImageGrid) -> Image:
        """The same field on another grid; its mean over aspects where it has several channels."""
        if self.field is None:
            return Image(np.zeros((grid.pixels, grid.pixels), np.complex64), grid, self.image.settings)
        values = self.field.on(grid)
        return Image(values[len(values) // 2], grid, self.image.settings)


NOT_WORDS = ("preset", "seed", "engine", "device")
"""Settings with options of their own."""


def setting_names() -> list[str]:
    """Names that `parse_settings` takes."""
    return [f.name for f in fields(AtsSettings) if f.name not in NOT_WORDS]


def parse_settings(words: Iterable[str]) -> dict[str, Any]:
    """Arguments for `AtsSettings` of words KEY=VALUE, each of which may hold several after commas.

    Values of a list are joined by "+": `calibrate=axis+wobble`.

    Raises:
        UsageError: a name that does not exist, or a value of the wrong kind.
    """
    values: dict[str, Any] = {}
    defaults = AtsSettings()
    for part in (p.strip() for word in words for p in word.split(",")):
        if not part:
            continue
        name, equals, text = (t.strip() for t in part.partition("="))
        if not equals or name not in setting_names():
            raise UsageError(
                f"there is no ATS setting {part!r}", f"Give KEY=VALUE with {', '.join(setting_names())}."
            )
        values[name] = _value(name, text, getattr(defaults, name))
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
