"""What an object to be enrolled by its signature is compared with."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.enrolling.registry import RegistryContents
from tagid.pipeline.enrollment import propose_signature
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.layouts.layout import builtin_layouts

WAVENUMBERS = 2 * np.pi / 0.0385 * np.linspace(0.9, 1.1, 6)


def signature(name: str, changed: float, kind: SignatureKind = "object") -> Signature:
    """An echo of random harmonics, of which a share is that of another object."""
    mine, other = (
        np.random.default_rng(seed).standard_normal((6, 17, 2)) @ (1, 1j) for seed in (1, len(name))
    )
    echo = np.sqrt(1 - changed) * mine + np.sqrt(changed) * other
    return Signature(name, kind, WAVENUMBERS, echo, np.full(6, 1e-3), 0.08, 1.0)


def test_the_most_similar_object_is_shown_first_and_a_confusable_one_refused() -> None:
    enrolled = [signature("unlike-it", 1.0), signature("twin", 0.005), signature("cousin", 0.3)]
    proposal = propose_signature(RegistryContents(4, [], enrolled), signature("new", 0.0))
    assert [likeness.second for likeness in proposal.likenesses] == ["twin", "cousin", "unlike-it"]
    assert proposal.alike == ("twin",)
    assert proposal.conflict is not None and "confused with twin" in proposal.conflict.message
    apart = propose_signature(RegistryContents(4, [], enrolled[::2]), signature("new", 0.0))
    assert apart.conflict is None and apart.taken is None


@pytest.mark.parametrize("name", ["twin", "helmet-120"])
def test_a_name_of_an_object_or_a_layout_is_taken_but_one_of_a_body_is_not(name: str) -> None:
    bodies = [signature("can", 0.0, "body")]
    contents = RegistryContents(4, list(builtin_layouts().values()), [signature("twin", 0.5), *bodies])
    assert propose_signature(contents, signature(name, 0.0)).taken is not None
    assert propose_signature(contents, signature("can", 0.0)).taken is None
