"""The published forward model: rays, spheres of constant time of flight, transmission, Lambert, beam.

It stands beside the field method so that "as in the paper" is a row of every table, not a matter of memory.
Source: Oshim, Reed, Jayasuriya, Rahman, NeRF-enabled Analysis-Through-Synthesis for ISAR Imaging, equations 1
to 6.

What the paper leaves open, and what is chosen here:

* No pulse: r(2R/c) is an integral over the sphere of radius R alone, so the reflectivity must carry the
  ripple of the carrier. The measured samples are real RF (eq. 1 is a cosine), and the model is fitted to
  those, at four samples a period or more. Fitting the analytic signal instead cannot succeed on a full turn:
  seen from behind, the projection of a reflectivity runs backwards in range, the phase of an echo does not.
* The loss between synthesized and measured scans has no weight over frequency in the paper. A reflectivity
  that is constant over a few centimetres is seen a hundred times stronger than one with the carrier's
  ripple, though the pulse holds nothing of it; what lies outside of the pulse's band is therefore weighted
  down (`fit_paper.PaperSettings.outside`), without which the fit stays at the blank image.
* "2T" in r and "2T" again in L: their product is 4 T^2, the two-way transmission squared; the constant 4 goes
  into the scale of sigma, T^2 stays. T multiplies exp(-|sigma_k| |l_(k+1) - l_k|) over the bins before.
* The unit of sigma, on which T depends (-log T is only defined up to it): the scans are divided by their
  peak and lengths are metres, which makes a lone reflector some 80 per metre, ripple included. As printed it
  would hide itself (T^2 = 1 %); `opacity` takes that down to some 5 % of loss.
* L as printed is a vector (sigma times the line of sight). Following the related sonar work it is a
  Lambertian factor with n = -grad |sigma| / |grad |sigma||, d the ray, the gradient by central differences
  between neighbouring spheres and rays. It is |n . d|, not max(0, n . -d): with the ripple of the carrier in
  sigma, |sigma| rises and falls four times a wavelength, and the one-sided factor blanks half of each.
  It is never less than `lambert_floor`, because n has no direction where the gradient vanishes. A plain
  division by |grad| would give the faintest texture full strength: the fit then writes the carrier's ripple
  into n instead of into sigma, reaches a small loss, and shows nothing; hence `LEAST_GRADIENT`.
* dx on the sphere: the arc R dphi between neighbouring rays of a fan in the object's plane (the scene is two-
  dimensional). 1/R^4 is in eq. 2, but not in eq. 3, which is the one that is sampled: it is left out.
* b_T: 2^-(2 theta / width)^2 about the line to the middle of the scene, one-way power, width 90 degrees.
* The beam: rays up to half that width, but no further than the scene reaches; neighbours are a third of a
  wavelength apart at the middle of the scene.
* An antenna above the plane: rays start at its foot, spheres are centred on the antenna, and the quadratic of
  eq. 5 gives where they meet; spheres that do not reach the plane are left out.
* Outside of the imaged square sigma is zero.
* Between its four layers no activation is named: a leaky ReLU, because with a plain one noise leaves every
  unit dark at times, and the image is one constant for good.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tagid.geometry import Aperture, ImageGrid
from tagid.types import Floats

LEAST_GRADIENT = 1000.0
"""Gradient of |sigma|, 1/m^2, of which half counts as a surface; a reflector has 80 / m within 1 cm."""


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Where the rays of one view meet its spheres.

    Attributes:
        points: (rays, bins, 2) m, in the object's plane.
        depths: (rays, bins) l of eq. 4, m along the ray; 0 if a sphere does not reach the plane.
        weights: (rays, bins) beam directivity times arc length, m; 0 if there is no point of the scene.
        ray_step_rad: angle between neighbouring rays.
    """

    points: Floats
    depths: Floats
    weights: Floats
    ray_step_rad: float


def positive_root(start: Floats, directions: Floats, radii: Floats) -> Floats:
    """Depths l at which rays start + l d meet spheres about the origin: the positive root of eq. 5.

    a = d.d, b = 2 x.d, c = x.x - R^2, l = (-b + sqrt(b^2 - 4ac)) / 2a.

    Args:
        start: (3,) origin of the rays relative to the spheres' centre, m.
        directions: (rays, 3), of any length.
        radii: (bins,) R, m.

    Returns:
        (rays, bins); nan where a ray misses a sphere or the root is not positive.
    """
    a = (directions**2).sum(axis=1)[:, None]
    b = 2 * (directions @ start)[:, None]
    c = float(start @ start) - radii[None] ** 2
    inside = b**2 - 4 * a * c
    root = (-b + np.sqrt(np.maximum(inside, 0))) / (2 * a)
    return np.where((inside >= 0) & (root > 0), root, np.nan)


def sample_view(
    aperture: Aperture, view: int, grid: ImageGrid, radii: Floats, ray_spacing_m: float, beam_width_rad: float
) -> RaySamples:
    """The points of one view: a fan of rays towards the scene, cut by spheres of radii (bins,), m."""
    antenna = aperture.positions[view]
    foot, height = antenna[:2], float(antenna[2])
    distance = max(float(np.hypot(*foot)), 1e-6)
    reach = grid.extent / np.sqrt(2)
    half = float(np.arcsin(min(1.0, reach / distance)))
    half = min(half, beam_width_rad / 2)
    rays = max(3, int(np.ceil(2 * half * distance / ray_spacing_m)))
    theta = (np.arange(rays) + 0.5) / rays * 2 * half - half
    bearing = np.arctan2(-foot[1], -foot[0]) + theta
    directions = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(rays)], axis=1)
    depths = np.nan_to_num(positive_root(np.array([0.0, 0.0, -height]), directions, radii))
    points = foot + depths[:, :, None] * directions[:, None, :2]
    inside = (np.abs(points) < grid.extent / 2).all(axis=2) & (depths > 0)
    step = 2 * half / rays
    beam = 2.0 ** -((2 * theta / beam_width_rad) ** 2)
    return RaySamples(points, depths, inside * beam[:, None] * depths * step, step)


def synthesize_profile(sigma: Any, samples: RaySamples, lambert_floor: float, opacity: float) -> Any:
    """r (bins,) complex of reflectivities sigma (rays, bins) complex at the points of one view.

    r_i = sum_j w_ij T_ij^(2 opacity) sigma_ij max(floor, |n_ij . d_j|), differentiable by sigma.
    """
    depths = torch.from_numpy(samples.depths.astype(np.float32))
    weights = torch.from_numpy(samples.weights.astype(np.float32))
    parts = torch.view_as_real(sigma * (weights > 0))
    magnitude = (parts.square().sum(-1) + 1e-8).sqrt()
    length = torch.diff(depths, dim=1, append=depths[:, -1:]).clamp_min(0)
    passed = torch.cumsum(magnitude * length, dim=1) - magnitude * length
    transmission = torch.exp(-2 * opacity * passed)
    lambert = _facing(magnitude, depths, samples.ray_step_rad).clamp_min(lambert_floor)
    return (weights * transmission * lambert * sigma).sum(dim=0)


def _facing(magnitude: Any, depths: Any, ray_step_rad: float) -> Any:
    """|n . d| (rays, bins): the share of the gradient of |sigma| that lies along the ray."""
    step = torch.diff(depths, dim=1).clamp_min(1e-4)
    inner = torch.diff(magnitude, dim=1) / step
    outward = ((torch.nn.functional.pad(inner, (1, 0)) + torch.nn.functional.pad(inner, (0, 1))) / 2).abs()
    sideways = torch.diff(magnitude, dim=0)
    across = torch.nn.functional.pad(sideways, (0, 0, 1, 0)) + torch.nn.functional.pad(sideways, (0, 0, 0, 1))
    across = across / 2 / (depths * ray_step_rad).clamp_min(1e-4)
    return outward / (outward.square() + across.square() + LEAST_GRADIENT**2).sqrt()
