"""Three distance sensors that look at two flat faces of a moving part: distances from its pose, and back.

Sensor i stands at s_i and looks along u_i; sensors 1 and 2 look at one face of the part, sensor 3 at another. A face
with normal n and distance c from the part's origin is the line (R n) . (P - t) = c, with R and t of the pose, so that
the distance along the axis of a sensor is::

    d_i = (c + R n . (t - s_i)) / (R n . u_i)

The other way round, every distance gives a point P_i = s_i + d_i u_i of a face. P_1 and P_2 lie on the same one, and
its direction turns with the part: theta is the anti-trigonometric atan2 of the cross and dot products of the face's
direction at theta = 0 and P_2 - P_1. Then R n_i . t = R n_i . P_i - c_i for i = 1, 3 are two linear equations for x, y.
That is exact for any mounting and any |theta| < 90 degrees.

Limits: with sensors 1 and 2 a baseline D apart (``place_um`` of 2 less that of 1) and square to the face
tan theta = (d_1 - d_2) / D; for small angles theta = (d_1 - d_2) / D, and noise sigma of the distances makes
sqrt(2) sigma / D of theta and sigma / sqrt(2) of the translation along the normal if its foot is midway.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sin
from typing import NamedTuple

import torch
from torch import Tensor

FREE = (0, 1, 2, 3, 4, 5, 9, 10)  # what known poses can tell of Mounting.numbers(): place, standoff, normal


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """Where three sensors and the two faces they look at are, in stage axes at the zero pose.

    The default has two sensors 30 mm apart that look at the y face and one at the x face.
    """

    place_um: tuple[float, float, float] = (-15000.0, 15000.0, 0.0)  # along the face, from its normal foot
    standoff_um: tuple[float, float, float] = (100.0, 100.0, 100.0)  # from the face
    tilt_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the sensor's axis against the normal
    normal_rad: tuple[float, float] = (pi / 2, 0.0)  # outward normals: of the face of sensors 1 and 2, and of 3
    face_um: tuple[float, float] = (25000.0, 25000.0)  # from the part's origin to the faces

    def __post_init__(self) -> None:
        if self.place_um[0] == self.place_um[1]:
            raise ValueError(f"Mounting: sensors 1 and 2 must stand apart, got place_um {self.place_um}")
        if abs(sin(self.normal_rad[0] - self.normal_rad[1])) < 1e-6:
            raise ValueError(f"Mounting: the two faces must not be parallel, got normal_rad {self.normal_rad}")
        if not max(abs(tilt) for tilt in self.tilt_rad) < pi / 4:
            raise ValueError(f"Mounting: tilt_rad must be below 45 degrees, got {self.tilt_rad}")

    def numbers(self) -> Tensor:
        """All 13 of them in the order of the fields, float64."""
        rows = (self.place_um, self.standoff_um, self.tilt_rad, self.normal_rad, self.face_um)
        return torch.tensor([value for row in rows for value in row], dtype=torch.float64)

    @classmethod
    def of(cls, numbers: Tensor) -> Mounting:
        """The inverse of ``numbers``."""
        n = numbers.tolist()
        return cls(
            place_um=tuple(n[:3]),
            standoff_um=tuple(n[3:6]),
            tilt_rad=tuple(n[6:9]),
            normal_rad=(n[9], n[10]),
            face_um=(n[11], n[12]),
        )

    def distance(self, pose: Tensor) -> Tensor:
        """Distances in um at poses in um, um, rad: (..., 3) -> (..., 3)."""
        _check_rows("distance: pose", pose)
        return distance(self.numbers().to(pose.device), pose.double())

    def pose(self, distance_um: Tensor) -> Tensor:
        """Poses in um, um, rad from distances in um: (..., 3) -> (..., 3), the exact inverse of ``distance``."""
        _check_rows("pose: distance_um", distance_um)
        return pose(self.numbers().to(distance_um.device), distance_um.double())


class MountingFit(NamedTuple):
    """An estimated ``mounting``, the covariance (8, 8) of place, standoff (um) and normal (rad), and the rms (3,) in um
    of what it leaves of each sensor's distances."""

    mounting: Mounting
    covariance: Tensor
    residual_um: Tensor


def calibrate_mounting(distance_um: Tensor, poses: Tensor, nominal: Mounting) -> MountingFit:
    """The mounting from distances (N, 3) at N known poses (N, 3) um, um, rad, starting from a drawing's ``nominal``.

    Gauss-Newton over the places along the faces, the standoffs and the normals of the faces. Tilts and the distances of
    the faces stay those of the drawing: within a nanopositioner's range they change distances by less than a sensor
    resolves. Clipped readings are for the caller to leave out. Raises ValueError for shapes that do not match, fewer
    than four poses and poses that do not move in x, y and theta.
    """
    if distance_um.dim() != 2 or distance_um.shape[-1] != 3 or distance_um.shape != poses.shape:
        shapes = f"{tuple(distance_um.shape)} and {tuple(poses.shape)}"
        raise ValueError(f"calibrate_mounting: distances and poses must both be (N, 3), got {shapes}")
    if not bool(distance_um.isfinite().all() and poses.isfinite().all()):
        raise ValueError("calibrate_mounting: distances and poses must be finite")
    poses, distance_um = poses.double(), distance_um.double()
    moves = (poses - poses.mean(0)) * poses.new_tensor((1.0, 1.0, 1e4))  # theta as um at the sensors
    spread = torch.linalg.svdvals(moves)
    if len(poses) < 4 or spread[-1] <= 1e-6 * spread[0]:
        raise ValueError(f"calibrate_mounting: {len(poses)} poses must be 4 or more that move in x, y and theta")
    free = torch.tensor(FREE, device=poses.device)
    numbers = nominal.numbers().to(poses.device)

    def predict(some: Tensor) -> Tensor:
        return distance(numbers.index_copy(0, free, some), poses)

    some = numbers[free]
    for _ in range(6):
        jacobian = torch.func.jacfwd(predict)(some).reshape(-1, len(FREE))
        scale = jacobian.norm(dim=0)
        residual = distance_um - predict(some)
        some = some + torch.linalg.lstsq(jacobian / scale, residual.reshape(-1, 1)).solution[:, 0] / scale
    residual = distance_um - predict(some)
    variance = residual.square().sum() / max(residual.numel() - len(FREE), 1)
    unit = jacobian / scale
    covariance = variance * torch.linalg.inv(unit.mT @ unit) / scale / scale[:, None]
    return MountingFit(Mounting.of(numbers.index_copy(0, free, some)), covariance, residual.square().mean(0).sqrt())


def distance(numbers: Tensor, pose: Tensor) -> Tensor:
    """Distances (..., 3) at poses (..., 3) for a mounting's numbers (13,)."""
    place, view, normal, face = _sensors(numbers)
    turned = _direction(normal - pose[..., 2:])  # R n
    reach = face + (turned * (pose[..., None, :2] - place)).sum(-1)
    return reach / (turned * view).sum(-1)


def pose(numbers: Tensor, distance_um: Tensor) -> Tensor:
    """Poses (..., 3) from distances (..., 3) for a mounting's numbers (13,)."""
    place, view, normal, face = _sensors(numbers)
    points = place + distance_um[..., None] * view
    along = points[..., 1, :] - points[..., 0, :]
    before = place[1] - place[0]
    before = before - (before @ _direction(normal[0])) * _direction(normal[0])  # of the face at theta = 0
    theta = torch.atan2(along[..., 0] * before[1] - along[..., 1] * before[0], along @ before)
    turned = _direction(normal[[0, 2]] - theta[..., None])
    right = (turned * points[..., [0, 2], :]).sum(-1) - face[[0, 2]]
    (a, b), (c, d) = (row.unbind(-1) for row in turned.unbind(-2))
    determinant = a * d - b * c
    x = (d * right[..., 0] - b * right[..., 1]) / determinant
    y = (a * right[..., 1] - c * right[..., 0]) / determinant
    return torch.stack((x, y, theta), -1)


def _sensors(numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Places (3, 2), directions of view (3, 2), normals (3,) and face distances (3,) of each sensor."""
    normal, face = numbers[9:11][[0, 0, 1]], numbers[11:13][[0, 0, 1]]
    out, along = _direction(normal), _direction(normal + pi / 2)
    place = (face + numbers[3:6])[:, None] * out + numbers[:3, None] * along
    return place, -_direction(normal + numbers[6:9]), normal, face


def _direction(angle: Tensor) -> Tensor:
    return torch.stack((angle.cos(), angle.sin()), -1)


def _check_rows(name: str, rows: Tensor) -> None:
    if rows.dim() < 1 or rows.shape[-1] != 3:
        raise ValueError(f"{name} must be (..., 3), got {tuple(rows.shape)}")
