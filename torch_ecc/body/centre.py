"""Where a body turns: the point of it that stays where it is, and whether there is one (parasitic motion, Fig. 9).

A point x of a body that turns about a fixed centre c is at c + R(theta) a. Fitted are c and a; errors of theta count
with the arm a. What the templates' noise adds is the same in all frames and goes into a: only the frames' scatters.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.ambient import plain
from torch_ecc.core.pose import rotation

STEPS = 4
FEWEST = 4  # frames
TURNED = 5.0  # standard deviations of theta: with less nothing is known of the centre
FIXED = 3.0  # standard deviations of chi-square


class RotationCentre(NamedTuple):
    """``centre`` (2,) px in the frame and its ``covariance`` (2, 2), larger if it moves; ``chi2`` with ``freedom``;
    ``wander_px``: by how much, rms of x and y, the body moves beside turning about it, beyond its noise; whether the
    centre is ``fixed``, as far as noise can tell."""

    centre: Tensor
    covariance: Tensor
    chi2: float
    freedom: int
    wander_px: float
    fixed: bool

    @property
    def sigma(self) -> Tensor:
        """Standard deviations (2,) px."""
        return self.covariance.diagonal().sqrt()


@plain
@torch.no_grad()
def rotation_centre(pose: Tensor, covariance: Tensor, *, template_share: float = 0.5) -> RotationCentre:
    """The centre about which a body at poses (F, 3) with covariances (F, 3, 3) turns; frames that are not finite are
    left out.

    ``template_share``: of a covariance that is the template's noise, common to all frames: half, if frames are as noisy
    as the first one. ValueError for less than four frames, and for a body that does not turn.
    """
    if pose.dim() != 2 or pose.shape[1] != 3 or covariance.shape != (len(pose), 3, 3):
        shapes = f"{tuple(pose.shape)} and {tuple(covariance.shape)}"
        raise ValueError(f"rotation_centre: expected poses (F, 3) and covariances (F, 3, 3), got {shapes}")
    if not 0 <= template_share < 1:
        raise ValueError(f"rotation_centre: template_share must be from 0 to less than 1, got {template_share}")
    known = pose.isfinite().all(1) & covariance.isfinite().flatten(1).all(1)
    x, C = pose[known], covariance[known] * (1 - template_share)
    if len(x) < FEWEST:
        raise ValueError(f"rotation_centre: expected {FEWEST} frames or more, got {len(x)} that are known")
    turned, spread = float(x[:, 2].std()), float(C[:, 2, 2].mean().sqrt())
    if turned < TURNED * spread or turned == 0:
        raise ValueError(f"rotation_centre: the body must turn, got {turned:.2g} rad rms with a sigma of {spread:.2g}")
    return _fitted(x, C)


def _fitted(pose: Tensor, covariance: Tensor) -> RotationCentre:
    """Generalised least squares over c and a, whose arm says how much errors of theta count."""
    turn, one = rotation(pose[:, 2]), torch.eye(2, dtype=pose.dtype, device=pose.device).expand(len(pose), 2, 2)
    columns, arm = torch.cat((one, turn), 2), pose.new_zeros(2)
    for _ in range(STEPS):
        out = turn @ arm
        lever = torch.stack((-out[:, 1], out[:, 0]), -1)[..., None]
        share = torch.cat((one, lever), 2)
        precision = torch.linalg.inv(share @ covariance @ share.mT)
        pulled = columns.mT @ precision
        spread = torch.linalg.inv((pulled @ columns).sum(0))
        found = spread @ (pulled @ pose[:, :2, None]).sum(0)[:, 0]
        arm = found[2:]
    left = pose[:, :2] - (columns @ found)
    chi2, freedom = float((left[:, None] @ precision @ left[..., None]).sum()), 2 * len(pose) - 4
    noise = torch.linalg.inv(precision).diagonal(dim1=1, dim2=2).mean()
    wander = float((left.square().sum() / freedom - noise).clamp(min=0).sqrt())
    fixed = chi2 <= freedom + FIXED * (2 * freedom) ** 0.5
    grown = 1.0 if fixed else chi2 / freedom
    return RotationCentre(found[:2], grown * spread[:2, :2], chi2, freedom, 0.0 if fixed else wander, fixed)
