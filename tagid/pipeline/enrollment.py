"""An identity or a body that is ready to be enrolled, compared with everything enrolled before it is stored.

`tagid enroll` and the station show a proposal, ask for confirmation, and store it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from tagid.capture import Capture
from tagid.enrolling.averaging import UNKNOWN_SCATTER_M, LayoutEstimate, Sighting, average, trusted
from tagid.enrolling.enrollment import Basis, Outlook, enroll, outlook, undisturbed
from tagid.enrolling.registry import Key, Registry, RegistryContents, taken
from tagid.errors import DataError, LayoutConflictError, RegistryError, UsageError
from tagid.pipeline.identify import aspect_spectra, sight_reflectors
from tagid.pipeline.prepared import LoadSettings, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.tags.bodies.joint import CAPTURES, Joint, Named, enroll_signature
from tagid.tags.bodies.likeness import Likeness, compare
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.layouts.codebook import CENTRE_TOLERANCE_M, best_pairing
from tagid.tags.layouts.layout import Layout


@dataclass(frozen=True, eq=False)
class LayoutProposal:
    """A layout to enroll, perhaps with the signature of its object.

    Attributes:
        layout: new layout.
        signature: of the same object; None if there is none.
        outlook: the layout compared with its neighbours.
        taken: the error if the name is already enrolled.
        basis: of the comparison.
    """

    layout: Layout
    signature: Signature | None
    outlook: Outlook
    taken: RegistryError | None
    basis: Basis

    @property
    def conflict(self) -> LayoutConflictError | None:
        """The error if the layout could be confused with another."""
        return self.outlook.conflict()

    def store(self, registry: Registry, source: str, force: bool = False) -> tuple[LayoutProposal, int]:
        """Enroll it, after comparing it with the registry as it is now.

        With `force` it is stored despite a conflict, and replaces an entry of the same name; `source` is its
        origin, for the history. Returns the proposal compared again, and the new registry version.

        Raises LayoutConflictError, RegistryError.
        """
        signatures = () if self.signature is None else (self.signature,)
        compared, version = enroll(
            registry, self.layout, source, force=force, basis=self.basis, signatures=signatures
        )
        return replace(self, outlook=compared), version


@dataclass(frozen=True, eq=False)
class SignatureProposal:
    """A body, or an object whose reflectors are not visible, to enroll by its signature.

    Attributes:
        signature: new signature.
        likenesses: compared with those enrolled of the same kind, the most similar first.
        version: registry version that the comparison was made against.
        taken: the error if the name is already enrolled.
    """

    signature: Signature
    likenesses: tuple[Likeness, ...]
    version: int
    taken: RegistryError | None

    @property
    def alike(self) -> tuple[str, ...]:
        """Names of the entries that it could be taken for."""
        return tuple(pair.second for pair in self.likenesses if pair.alike)

    @property
    def conflict(self) -> LayoutConflictError | None:
        """The error if an object could be confused with another; similar bodies may be enrolled."""
        if self.signature.kind != "object" or not self.alike:
            return None
        return LayoutConflictError(
            f"object {self.signature.name} could be confused with {self.alike[0]}: "
            f"{self.likenesses[0].difference:.1%} of its angle-dependent echo distinguishes them",
            "Change its tag, remove the other, or override with `force`; nothing was stored.",
        )

    def store(self, registry: Registry, source: str, force: bool = False) -> int:
        """As `LayoutProposal.store`; returns the new registry version."""

        def compared() -> int | None:
            current = registry.version == self.version
            now = self if current else propose_signature(registry.contents(), self.signature)
            error = now.taken or now.conflict
            if error is not None and not force:
                raise error
            signatures = [self.signature]
            return registry.add_all([], source, replace=force, since=now.version, signatures=signatures)

        return undisturbed(compared)


def propose_layout(
    contents: RegistryContents,
    layout: Layout,
    measured: Measured | None,
    basis: Basis,
) -> LayoutProposal:
    """A layout, given or measured, compared with the enrolled ones.

    Raises UsageError if a reflector lies outside the largest object of the layout's kind.
    """
    outlook_of = outlook(layout, contents.layouts, basis, contents.version)
    error = taken(("layout", layout.name), _keys(contents))
    own = None
    if measured is not None and measured.joint is not None:
        own = replace(measured.joint.signature, name=layout.name, label=layout.label[:200])
    return LayoutProposal(layout, own, outlook_of, error, basis)


def propose_signature(contents: RegistryContents, signature: Signature) -> SignatureProposal:
    """A signature compared with those enrolled of the same kind."""
    kind, name = signature.kind, signature.name
    others = [other for other in contents.signatures if other.kind == kind and other.name != name]
    pairs = sorted((compare(signature, other) for other in others), key=lambda pair: pair.difference)
    return SignatureProposal(signature, tuple(pairs), contents.version, taken((kind, name), _keys(contents)))


def _keys(contents: RegistryContents) -> set[Key]:
    return {("layout", layout.name) for layout in contents.layouts} | {
        (signature.kind, signature.name) for signature in contents.signatures
    }


Remark = Callable[[str], None]
"""Called with what was just finished: the name of a capture, or "signature"."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A capture prepared for measurement.

    Attributes:
        name: of the capture, for messages.
        capture: with angles, one revolution.
    """

    name: str
    capture: Capture


@dataclass(frozen=True, eq=False)
class Sighted(Prepared):
    """A prepared capture with the strong reflectors that it shows."""

    sighting: Sighting


@dataclass(frozen=True, eq=False)
class Measured:
    """The result of measuring captures of an object.

    Attributes:
        estimate: its layout; None if the reflectors are not visible.
        joint: its signature; None if there is none.
        missing: why one of the two is missing; empty if none is.
        unmoved: remarks on captures between which the object was not moved.
    """

    estimate: LayoutEstimate | None
    joint: Joint | None
    missing: str = ""
    unmoved: tuple[str, ...] = ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """All remarks."""
        return (self.missing, *self.unmoved) if self.missing else self.unmoved


def prepare_files(paths: Sequence[Path], loading: LoadSettings) -> list[Prepared]:
    """Read captures of one object. Raises UsageError if one is given twice."""
    again = "Give captures of the object repositioned between them."
    if len({path.resolve() for path in paths}) < len(paths):
        raise UsageError("the same capture is given twice", again)
    known: dict[str, Path] = {}
    captures = []
    for path in paths:
        capture = load_capture(path, loading)
        twin = known.setdefault(capture.uuid, path)
        if twin != path:
            raise UsageError(f"{path} and {twin} are the same capture", again)
        captures.append(Prepared(str(path), capture))
    return captures


def sight(prepared: Prepared, imaging: ImagingSettings) -> Sighted:
    """The reflectors that a capture shows. Raises DataError as `sight_reflectors` does."""
    name, capture = prepared.name, prepared.capture
    return Sighted(name, capture, sight_reflectors(capture, name, imaging))


def measure(
    name: str,
    captures: Sequence[Sighted],
    imaging: ImagingSettings,
    progress: Remark = lambda what: None,
) -> Measured:
    """Positions and signature of a tagged object that was repositioned between its captures.

    Raises DataError, with both reasons, if neither positions nor a signature could be determined.
    """
    positions: DataError | None = None
    estimate: LayoutEstimate | None = None
    seen = [capture.sighting for capture in captures]
    try:
        estimate = average(seen, name, direction_known=imaging.direction_known)
    except DataError as error:
        positions = error
    unmoved = _unmoved(seen, estimate)
    if len(captures) < CAPTURES:
        if positions is not None:
            raise positions
        if doubt := _doubt(captures, imaging):
            raise DataError(
                f"{doubt}, and the places found are not those of reflectors",
                f"Give {CAPTURES} captures, the object moved and turned between them: it is enrolled by its "
                "signature.",
            )
        return Measured(estimate, None, f"no signature: it needs {CAPTURES} captures", unmoved)
    try:
        joint = signature(name, "object", captures, imaging, progress)
    except DataError as error:
        if positions is not None:
            raise DataError(
                f"{positions.message}; enrollment by signature: {error.message}", error.remedy
            ) from None
        return Measured(estimate, None, f"positions only, no signature: {error.message}", unmoved)
    if estimate is not None:
        doubt = trusted(seen, [placed.spectra for placed in joint.placed])
        if doubt:
            estimate, positions = None, DataError(doubt)
    if positions is not None:
        missing = (
            f"enrolled by its signature: positions of the reflectors cannot be seen ({positions.message})"
        )
        return Measured(None, joint, missing)
    return Measured(estimate, joint, unmoved=unmoved)


def _doubt(captures: Sequence[Sighted], imaging: ImagingSettings) -> str:
    """Why reflectors of few captures are not to be trusted; empty also where these cannot tell."""
    try:
        spectra = [aspect_spectra(capture.capture, imaging) for capture in captures]
    except DataError:  # free antenna positions, or fewer views than a signature needs
        return ""
    return trusted([capture.sighting for capture in captures], spectra)


def _unmoved(seen: Sequence[Sighting], estimate: LayoutEstimate | None) -> tuple[str, ...]:
    """Remarks on captures between which the object kept its place on the table.

    The rotation axis is then at the same place on the object, so that errors in centring and of the aspect do
    not average out. Places closer than twice `UNKNOWN_SCATTER_M` cannot be told apart.
    """
    if estimate is None:
        return ()
    axes = []
    for posed in seen:
        used = posed.mirrored() if posed.name in estimate.mirrored else posed
        # best_pairing turns a capture onto the layout: the axis, its origin, lands at the shift.
        pair = best_pairing(used.positions, estimate.layout.positions, 2 * CENTRE_TOLERANCE_M)
        axes.append(pair.shift_m)
    return tuple(
        f"{seen[j].name} and {seen[i].name} show the object at the same place: move and turn it between "
        "captures"
        for i in range(len(seen))
        for j in range(i)
        if float(np.linalg.norm(axes[i] - axes[j])) < 2 * UNKNOWN_SCATTER_M
    )


def signature(
    name: str,
    kind: SignatureKind,
    captures: Sequence[Prepared],
    imaging: ImagingSettings,
    progress: Remark = lambda what: None,
) -> Joint:
    """Signature of a body or object. Raises DataError if its captures do not confirm it."""
    spectra = []
    for capture in captures:
        try:
            spectra.append(Named(capture.name, aspect_spectra(capture.capture, imaging)))
        except DataError as error:
            raise DataError(f"{capture.name}: {error.message}", error.remedy) from None
        progress(capture.name)
    joint = enroll_signature(spectra, name, kind)
    progress("signature")
    return joint


def joint_data(joint: Joint | None) -> dict[str, Any] | None:
    """A joint estimate for scripts."""
    if joint is None:
        return None
    signature = joint.signature
    return {
        "kind": signature.kind,
        "name": signature.name,
        "radius_m": signature.radius_m,
        "harmonics": signature.order,
        "model_error": signature.model_error,
        "noise_share": signature.noise_share,
        "captures": [
            {
                "file": residual.name,
                "residual_over_noise": residual.energy / residual.expected,
                "unexplained": residual.share,
                "centre_m": list(placed.pose.centre_m),
                "rotation_deg": degrees(placed.pose.turn_rad) % 360,
            }
            for residual, placed in zip(joint.residuals, joint.placed, strict=True)
        ],
    }


def joint_words(joint: Joint) -> list[str]:
    """The same as text, one line per capture."""
    signature = joint.signature
    lines = [f"signature: radius {signature.radius_m * 1e3:.0f} mm, {signature.order} harmonics"]
    for residual, placed in zip(joint.residuals, joint.placed, strict=True):
        x, y = (value * 1e3 for value in placed.pose.centre_m)
        lines.append(
            f"  {Path(residual.name).name}: residual {residual.energy / residual.expected:.2f} times noise, "
            f"centre ({x:.1f}, {y:.1f}) mm, rotated {degrees(placed.pose.turn_rad) % 360:.0f} deg"
        )
    return lines
