"""Planar pose algebra on tensors (..., 3).

Conventions of the whole package, written here once:

* Pixel centres lie at integer coordinates, x points right, y points down.
* ``pose = (x, y, theta)`` in px, px, rad maps a template point x' (relative to the template's centre) to the frame::

      x =  cos(theta) x' + sin(theta) y' + t_x
      y = -sin(theta) x' + cos(theta) y' + t_y                                                   (paper, eq. 2)

  so a positive theta turns +x towards -y: counter-clockwise as seen on the screen. OpenCV, ViSP and kornia use the
  other sign; the converters below are the only place where that matters.
* Angles are plain numbers, never wrapped by this module: theta and theta + 2 pi are different poses of one track.
"""

from __future__ import annotations

from math import cos, isfinite, nan, pi, sin, tau
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_ecc.core.ambient import constant

if TYPE_CHECKING:
    from kornia.geometry.liegroup import Se2


def pose_dtype(device: torch.device | str) -> torch.dtype:
    """The dtype of poses on ``device``: float64 where the device has it (all but Apple's MPS)."""
    return torch.float32 if torch.device(device).type == "mps" else torch.float64


def rotation(theta: Tensor) -> Tensor:
    """Rotation block of eq. (2): (...) -> (..., 2, 2)."""
    c, s = theta.cos(), theta.sin()
    return torch.stack((c, s, -s, c), -1).view(*theta.shape, 2, 2)


def matrix(pose: Tensor) -> Tensor:
    """Homogeneous matrix W(p) of eq. (2): (..., 3) -> (..., 3, 3)."""
    top = torch.cat((rotation(pose[..., 2]), pose[..., :2, None]), -1)
    bottom = top.new_tensor((0.0, 0.0, 1.0)).expand(*top.shape[:-2], 1, 3)
    return torch.cat((top, bottom), -2)


def warp(x: float, y: float, theta: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The first two rows of W(p) of one pose as plain numbers, where torch would take a hundred times as long."""
    c, s = (cos(theta), sin(theta)) if isfinite(theta) else (nan, nan)
    return (c, s, x), (-s, c, y)


def from_matrix(matrix: Tensor) -> Tensor:
    """Pose of a rigid (..., 2 or 3, 3) matrix; theta in (-pi, pi]. A common scale of the rotation block is ignored."""
    if matrix.dim() < 2 or matrix.shape[-1] != 3 or matrix.shape[-2] not in (2, 3):
        raise ValueError(f"from_matrix: matrix must be (..., 2, 3) or (..., 3, 3), got {tuple(matrix.shape)}")
    s = matrix[..., 0, 1] - matrix[..., 1, 0]
    c = matrix[..., 0, 0] + matrix[..., 1, 1]
    return torch.stack((matrix[..., 0, 2], matrix[..., 1, 2], torch.atan2(s, c)), -1)


def transform(pose: Tensor, points: Tensor) -> Tensor:
    """Template points to frame points, eq. (2): (..., 3), (..., N, 2) -> (..., N, 2)."""
    return points @ rotation(pose[..., 2]).mT + pose[..., None, :2]


def compose(a: Tensor, b: Tensor) -> Tensor:
    """W(a) o W(b), first b and then a: (..., 3), (..., 3) -> (..., 3). Angles add, so turns are kept."""
    t = a[..., :2] + (rotation(a[..., 2]) @ b[..., :2, None])[..., 0]
    return torch.cat((t, a[..., 2:] + b[..., 2:]), -1)


def inverse(pose: Tensor) -> Tensor:
    """The pose of W(p)^-1: (..., 3) -> (..., 3)."""
    t = -(rotation(-pose[..., 2]) @ pose[..., :2, None])[..., 0]
    return torch.cat((t, -pose[..., 2:]), -1)


def retract(pose: Tensor, increment: Tensor) -> Tensor:
    """W(p) o W(dp)^-1, the inverse compositional update (eq. 10) in closed form: (..., 3), (..., 3) -> (..., 3)."""
    theta = pose[..., 2:] - increment[..., 2:]
    t = pose[..., :2] - (rotation(theta[..., 0]) @ increment[..., :2, None])[..., 0]
    return torch.cat((t, theta), -1)


def turn(theta: Tensor) -> Tensor:
    """Turns an increment of a pose with its body, x and y by theta of eq. (2): (...) -> (..., 3, 3)."""
    return _turned(theta.view(*theta.shape, 1, 1))


def ahead(pose: Tensor, step: Tensor) -> Tensor:
    """``pose`` = last + ``step`` after one more such step in the moving body's axes: (..., 3), (..., 3) -> (..., 3).

    W(pose) o W(last)^-1 o W(pose), exact for a constant turn about any point: the step turns by its own angle.
    """
    start, step = pose.reshape(-1, 3, 1), step.reshape(-1, 3, 1)
    return torch.baddbmm(start, _turned(step[:, 2:]), step).view(pose.shape)


def unwrap(theta: Tensor, reference: Tensor) -> Tensor:
    """``theta`` moved by whole turns to within half a turn of ``reference``; same shape, rad."""
    return theta - tau * torch.round((theta - reference) / tau)


def to_opencv(pose: Tensor, size: tuple[int, int]) -> Tensor:
    """2x3 warp of cv2.findTransformECC / cv2.warpAffine(WARP_INVERSE_MAP) for a template of ``size`` = (h, w).

    (..., 3) -> (..., 2, 3). OpenCV counts template pixels from the top-left one, and its angle is minus theta.
    """
    h, w = size
    corner = pose.new_tensor((-(w - 1) / 2, -(h - 1) / 2, 0.0))
    return matrix(compose(pose, corner.expand_as(pose)))[..., :2, :]


def from_opencv(warp: Tensor, size: tuple[int, int]) -> Tensor:
    """Pose of an OpenCV 2x3 Euclidean warp (template pixel -> frame pixel): (..., 2, 3) -> (..., 3)."""
    h, w = size
    corner = from_matrix(warp)
    centre = corner.new_tensor(((w - 1) / 2, (h - 1) / 2, 0.0))
    return compose(corner, centre.expand_as(corner))


def to_se2(pose: Tensor) -> Se2:
    """kornia's Se2 with the same matrix (its angle is minus theta): (B, 3) -> Se2 of batch B."""
    from kornia.geometry.liegroup import Se2, So2

    return Se2(So2(torch.polar(torch.ones_like(pose[..., 2]), -pose[..., 2])), pose[..., :2])


def from_se2(se2: Se2) -> Tensor:
    """Pose of a kornia Se2 of batch B: Se2 -> (B, 3); theta in (-pi, pi]."""
    return from_matrix(se2.matrix())


def _turned(theta: Tensor) -> Tensor:
    """``turn`` by (..., 1, 1): (..., 3, 3)."""
    phase, sign = _turn(theta.dtype, theta.device)
    return torch.addcmul(phase, theta, sign).sin()


@constant
def _turn(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """What ``turn`` takes the sine of at theta = 0, (3, 3), and the sign with which theta adds to it: one operation for
    cosine, sine, 0 and 1, all exact at 0."""
    phase = torch.diag(torch.full((3,), pi / 2, dtype=dtype, device=device))
    return phase, torch.tensor([[1, 1, 0], [-1, 1, 0], [0, 0, 0]], dtype=dtype, device=device)
