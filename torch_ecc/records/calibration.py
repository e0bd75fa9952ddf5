"""Pixels to micrometres (eq. 3), and the angle between the camera's axes and the stage's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.core.pose import rotation
from torch_ecc.records.lens import Lens


@dataclass(frozen=True)
class Calibration:
    """Scale and orientation of the camera: a displacement d in px is R(axis_angle) diag(um_per_px) d in um.

    ``um_per_px``: one number or (f_x, f_y), eq. (3); a negative one says that this axis of the stage runs against the
    image's (stages usually count y upwards). ``axis_angle``: rad, from the camera's axes to the stage's, with the sign
    of theta in eq. (2). ``lens``: what it distorts is taken out first, for which it has to be known where in the frame
    a displacement has ended. Raises ValueError for a scale that is zero or not finite.
    """

    um_per_px: float | tuple[float, float]
    axis_angle: float = 0.0
    lens: Lens | None = None

    def __post_init__(self) -> None:
        if len(self.scales) != 2 or not all(math.isfinite(f) and f != 0 for f in self.scales):
            raise ValueError(f"um_per_px: expected one or two finite numbers other than 0, got {self.um_per_px!r}")
        if not math.isfinite(self.axis_angle):
            raise ValueError(f"axis_angle: expected a finite angle in rad, got {self.axis_angle!r}")

    @property
    def scales(self) -> tuple[float, ...]:
        """(f_x, f_y) in um per px."""
        f = self.um_per_px
        return (float(f), float(f)) if isinstance(f, int | float) else tuple(float(v) for v in f)

    def matrix(self, like: Tensor) -> Tensor:
        """(3, 3) of the dtype and device of ``like``: (px, px, rad) of the image to (um, um, rad) of the stage."""
        angle = torch.as_tensor(self.axis_angle, dtype=like.dtype, device=like.device)
        whole = torch.eye(3, dtype=like.dtype, device=like.device)
        whole[:2, :2] = rotation(angle) * like.new_tensor(self.scales)
        whole[2, 2] = math.copysign(1.0, math.prod(self.scales))  # a mirrored view turns the other way
        return whole

    def to_physical(self, displacement: Tensor, pose: Tensor | None = None) -> Tensor:
        """Displacements (..., 3) px, px, rad -> (..., 3) um, um, rad along the stage's axes (eq. 3). With a lens they
        must come with the ``pose`` (..., 3) that they have led to; ValueError without, and beyond the lens's range."""
        if self.lens is not None:
            end = self._known(pose)
            displacement = self.lens.undistort_pose(end) - self.lens.undistort_pose(end - displacement)
        return _product(displacement[..., None, :], self.matrix(displacement).mT)[..., 0, :]

    def _known(self, pose: Tensor | None) -> Tensor:
        if pose is None:
            raise ValueError("Calibration: with a lens the pose must be known, too, got a displacement alone")
        return pose

    def to_pixels(self, physical: Tensor) -> Tensor:
        """The inverse of ``to_physical``, as without a lens: (..., 3) um, um, rad -> (..., 3) px, px, rad."""
        return _product(physical[..., None, :], torch.linalg.inv(self.matrix(physical)).mT)[..., 0, :]

    def covariance(self, covariance: Tensor, pose: Tensor | None = None) -> Tensor:
        """Pose covariances (..., 3, 3) in px and rad -> in um and rad along the stage's axes; with a lens, at poses
        (..., 3)."""
        if self.lens is not None:
            covariance = self.lens.undistort_covariance(covariance, self._known(pose))
        whole = self.matrix(covariance)
        return _product(_product(whole, covariance), whole.mT)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """a b of (..., n, k) and (..., k, m): sums of products, which unlike a matmul no autocast rounds."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


class CalibrationFit(NamedTuple):
    """An estimated ``calibration``, the rms of what it leaves of the moves in um, and the standard deviations of
    f_x, f_y (um per px) and axis_angle (rad), (3,)."""

    calibration: Calibration
    residual_um: float
    sigma: Tensor


def calibrate(displacement: Tensor, commanded_um: Tensor) -> CalibrationFit:
    """Scale and axis angle from moves: measured (N, 2 or 3) px and commanded (N, 2) um -> CalibrationFit.

    Least squares over f_x, f_y and the angle (Gauss-Newton from the affine fit); an offset between the two origins is
    taken out. Raises ValueError for too few moves (3), moves along one line and shapes that do not match.
    """
    if displacement.dim() != 2 or displacement.shape[1] not in (2, 3) or commanded_um.shape != (len(displacement), 2):
        shapes = f"{tuple(displacement.shape)} and {tuple(commanded_um.shape)}"
        raise ValueError(f"calibrate: expected displacements (N, 2 or 3) and commanded moves (N, 2), got {shapes}")
    px, um = displacement[:, :2].double(), commanded_um.double()
    if not (px.isfinite().all() and um.isfinite().all()):
        raise ValueError("calibrate: displacements and commanded moves must be finite")
    px, um = px - px.mean(0), um - um.mean(0)
    spread = torch.linalg.svdvals(px)
    if len(px) < 3 or spread[-1] <= 1e-6 * spread[0]:
        raise ValueError(f"calibrate: moves must span the plane, got {len(px)} of them along one line or point")
    affine = torch.linalg.lstsq(px, um).solution.mT  # um = affine px
    angle = torch.atan2(affine[0, 1] - affine[1, 0], affine.trace())
    if affine.det() < 0:  # mirrored view: f_y < 0
        angle = torch.atan2(-affine[0, 1] - affine[1, 0], affine[0, 0] - affine[1, 1])
    scale = (rotation(angle).mT @ affine).diagonal()
    parameters = torch.cat((scale, angle[None]))
    for _ in range(20):
        jacobian, residual = _moves(parameters, px, um)
        parameters = parameters + torch.linalg.lstsq(jacobian, residual).solution[:, 0]
    jacobian, residual = _moves(parameters, px, um)
    variance = residual.square().sum() / max(2 * len(px) - 5, 1)  # three parameters and two origins
    sigma = (variance * torch.linalg.inv(jacobian.mT @ jacobian)).diagonal().sqrt()
    fx, fy, turn = parameters.tolist()
    return CalibrationFit(Calibration((fx, fy), turn), float(residual.square().mean().sqrt()), sigma)


def _moves(parameters: Tensor, px: Tensor, um: Tensor) -> tuple[Tensor, Tensor]:
    """Jacobian (2 N, 3) of the predicted moves and residual (2 N, 1) for f_x, f_y and the angle."""
    turn, quarter = rotation(parameters[2]), rotation(parameters[2] + math.pi / 2)
    scaled = px * parameters[:2]
    columns = (px[:, :1] * turn[:, 0], px[:, 1:] * turn[:, 1], scaled @ quarter.mT)
    return torch.stack(columns, -1).reshape(-1, 3), (um - scaled @ turn.mT).reshape(-1, 1)
