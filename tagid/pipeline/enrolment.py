"""An identity or a body that is ready to be enrolled, compared with everything enrolled before it is stored.

`tagid enroll` and the station show a proposal, ask for confirmation, and store it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from tagid.errors import LayoutConflictError, RegistryError

if TYPE_CHECKING:
    from tagid.enrolling.enrolment import Outlook
    from tagid.enrolling.registry import Key, Registry, RegistryContents
    from tagid.pipeline.measuring import Measured
    from tagid.tags.bodies.likeness import Likeness
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.layouts.layout import Layout


@dataclass(frozen=True, eq=False)
class LayoutProposal:
    """A layout to enrol, perhaps with the signature of its object.

    Attributes:
        layout: new layout.
        signature: of the same object; None if there is none.
        outlook: the layout compared with its neighbours.
        taken: the error if the name is already enrolled.
        direction_known: whether the direction of rotation is known.
        height_weight: see `tags.layouts.codebook.height_weight`; 0: heights do not distinguish layouts.
    """

    layout: Layout
    signature: Signature | None
    outlook: Outlook
    taken: RegistryError | None
    direction_known: bool
    height_weight: float = 0.0

    @property
    def conflict(self) -> LayoutConflictError | None:
        """The error if the layout could be confused with another."""
        return self.outlook.conflict()

    def store(self, registry: Registry, source: str, force: bool = False) -> StoredLayout:
        """Enrol it, after comparing it with the registry as it is now.

        Args:
            registry: where to store it.
            source: origin of the layout, for the history.
            force: store it despite a conflict, and replace an entry of the same name.

        Raises LayoutConflictError, RegistryError.
        """
        from tagid.enrolling.enrolment import enrol

        signatures = () if self.signature is None else (self.signature,)
        done = enrol(
            registry,
            self.layout,
            source,
            force=force,
            direction_known=self.direction_known,
            height_weight=self.height_weight,
            signatures=signatures,
        )
        return StoredLayout(replace(self, outlook=done.outlook), done.version)


@dataclass(frozen=True, eq=False)
class StoredLayout:
    """An enrolled layout.

    Attributes:
        proposal: as stored, compared with the registry at that moment.
        version: registry version after the change.
    """

    proposal: LayoutProposal
    version: int


@dataclass(frozen=True, eq=False)
class SignatureProposal:
    """A body, or an object whose reflectors are not visible, to enrol by its signature.

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
            f"{self.likenesses[0].left:.1%} of its angle-dependent echo distinguishes them",
            "Change its tag, remove the other, or override with `force`; nothing was stored.",
        )

    def store(self, registry: Registry, source: str, force: bool = False) -> int:
        """Enrol it, after comparing it with the registry as it is now; returns the new registry version.

        Args:
            registry: where to store it.
            source: origin of the signature, for the history.
            force: store it despite a conflict, and replace an entry of the same name.

        Raises LayoutConflictError, RegistryError.
        """
        from tagid.enrolling.enrolment import undisturbed

        def compared() -> int | None:
            current = registry.version == self.version
            now = self if current else propose_signature(registry.contents(), self.signature)
            error = now.taken or now.conflict
            if error is not None and not force:
                raise error
            one = [self.signature]
            return registry.add_all([], source, replace=force, since=now.version, signatures=one)

        return undisturbed(compared)


def propose_layout(
    contents: RegistryContents,
    layout: Layout,
    measured: Measured | None,
    direction_known: bool,
    height_weight: float = 0.0,
) -> LayoutProposal:
    """A layout compared with the enrolled ones.

    Args:
        contents: of the registry.
        layout: new layout.
        measured: the captures it was measured on; None for given positions.
        direction_known: whether the direction of rotation is known.
        height_weight: as of `LayoutProposal`.

    Raises UsageError if a reflector lies outside the largest object of the layout's kind.
    """
    from tagid.enrolling.enrolment import outlook
    from tagid.enrolling.registry import taken

    found = outlook(
        layout,
        contents.layouts,
        direction_known=direction_known,
        height_weight=height_weight,
        version=contents.version,
    )
    error = taken(("layout", layout.name), _keys(contents))
    own = None
    if measured is not None and measured.joint is not None:
        own = replace(measured.joint.signature, name=layout.name, label=layout.label[:200])
    return LayoutProposal(layout, own, found, error, direction_known, height_weight)


def propose_signature(contents: RegistryContents, signature: Signature) -> SignatureProposal:
    """A signature compared with those enrolled of the same kind."""
    from tagid.enrolling.registry import taken
    from tagid.tags.bodies.likeness import compare

    one = signature
    others = [other for other in contents.signatures if other.kind == one.kind and other.name != one.name]
    pairs = sorted((compare(one, other) for other in others), key=lambda pair: pair.left)
    error = taken((one.kind, one.name), _keys(contents))
    return SignatureProposal(one, tuple(pairs), contents.version, error)


def _keys(contents: RegistryContents) -> set[Key]:
    return {("layout", one.name) for one in contents.layouts} | {
        (one.kind, one.name) for one in contents.signatures
    }
