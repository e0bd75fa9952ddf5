"""The image Jacobian L of eq. (13): from the velocities of a stage's axes to the change of a pose in the picture.

Frames of reference. The error is made in the picture, in px, px, rad (eq. 12), and nothing else is ever measured, so
nothing needs to be calibrated beforehand: an L that is only roughly right still leads to e = 0, see below.

Derivation. The axes x and y of the stage move the part's axis of rotation c, and theta turns the part about it. With
``Calibration`` C (um, um, rad per px, px, rad), the axis at r in the template's coordinates, and R of eq. (2),

    (dc, dtheta) = C^-1 (dx, dy, dphi),        t = c - R(theta) r,        dR/dtheta r = (d_y, -d_x)  for  d = R r,

so that with d = R(theta) r, the lever arm from the template's centre to the axis of rotation,

    L(theta) = | 1  0  -d_y |
               | 0  1   d_x |  C^-1.
               | 0  0   1   |

With a wrong L^ the closed loop is de/dt = -lambda L L^^+ e. It decays where the eigenvalues of L L^^+ have positive
real parts: a scale that is wrong by a factor s only changes lambda to lambda s, axes wrong by an angle a turn the path
(it decays for |a| < 90 deg with lambda cos a), and a wrong lever arm leaves the eigenvalues as they are, since its
column only adds to x and y what theta's own decay takes away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.records.calibration import Calibration

Jacobian: TypeAlias = Callable[[Tensor], Tensor]
"""Pose (3,) -> (3, n), px and rad per um and rad of the n axes."""

LARGEST_CONDITION = 1e6  # of L with columns of length one; beyond it L counts as singular


@dataclass(frozen=True)
class StageJacobian:
    """L of a stage with the axes x, y and theta, or, with ``rotary`` False, x and y only.

    ``calibration``: scale and angle of the axes, roughly; ``axis``: (x', y') px, where the axis of rotation lies in the
    template's coordinates, (0, 0) if unknown.
    """

    calibration: Calibration
    axis: tuple[float, float] = (0.0, 0.0)
    rotary: bool = True

    def __call__(self, pose: Tensor) -> Tensor:
        """Pose (3,) -> (3, 3 or 2)."""
        arm = rotation(pose[2]) @ pose.new_tensor(self.axis)
        lever = torch.eye(3, dtype=pose.dtype)
        lever[0, 2], lever[1, 2] = -arm[1], arm[0]
        whole: Tensor = lever @ torch.linalg.inv(self.calibration.matrix(pose))
        return whole if self.rotary else whole[:, :2]


def pseudo_inverse(L: Tensor) -> Tensor:
    """(L^T L)^-1 L^T (n, 3) of L (3, n). ValueError if L is singular."""
    still = [k for k, length in enumerate(L.norm(dim=0).tolist()) if length == 0]
    if still:
        raise ValueError(f"jacobian: L must not be singular, but axis {still[0]} moves nothing in the picture")
    if not condition(L) < LARGEST_CONDITION:
        rows = [[float(f"{v:.3g}") for v in row] for row in L.tolist()]
        raise ValueError(f"jacobian: L must have independent, finite columns, got a singular L = {rows}")
    columns = L.norm(dim=0)
    inverse: Tensor = torch.linalg.pinv(L / columns) / columns[:, None]  # um and rad differ by orders of magnitude
    return inverse


def condition(L: Tensor) -> float:
    """Condition number of L (3, n) with columns of length one; infinite if L^T L is singular."""
    if L.shape[1] > 3 or not bool(L.isfinite().all()) or bool((L.norm(dim=0) == 0).any()):
        return float("inf")
    values = torch.linalg.svdvals(L / L.norm(dim=0))
    return float(values[0] / values[-1]) if float(values[-1]) > 0 else float("inf")


def learn(L: Tensor, move: Tensor, seen: Tensor, weight: float) -> Tensor:
    """Broyden's rank-one update of L (3, n): make it explain more of the change ``seen`` (3,) after ``move`` (n,).

    Moves are measured in units in which the columns of L have equal length; ``weight`` 1 explains all of it.
    """
    unit = L.norm(dim=0).square()
    direction = unit * move / (unit * move * move).sum()
    return L + weight * torch.outer(seen - L @ move, direction)


def planned_move(jacobian: Jacobian, start: Tensor, desired: Tensor, pieces: int = 64) -> Tensor:
    """What the axes must do (n,) for a straight path from ``start`` to ``desired`` (3,): the integral of L^+ de."""
    way = desired - start
    middles = [(k + 0.5) / pieces for k in range(pieces)]
    return torch.stack([pseudo_inverse(jacobian(start + s * way)) @ way for s in middles]).mean(0)
