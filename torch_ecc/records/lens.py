"""The lens: radial and tangential distortion as OpenCV describes it, of points and of the poses of patches.

With x = (u - c) / f of an undistorted pixel u, it is seen at c + f d(x),

    d(x) = x (1 + k1 r^2 + k2 r^4) + (2 p1 x y + p2 (r^2 + 2 x^2),  p1 (r^2 + 2 y^2) + 2 p2 x y).

A small patch is seen moved to there, and deformed by the slope of d: turned, scaled and sheared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torch_ecc.core.pose import from_matrix

NEWTON = 8  # steps at most: they double the digits, and only near the fold more than four are needed
SETTLED = 1e-12  # of the focal length
DIRECTIONS, RADII = 24, 120  # in which the fold is looked for
NEAREST, FARTHEST = 1e-3, 1e3  # focal lengths


@dataclass(frozen=True)
class Lens:
    """Distortion with the ``center`` (x, y) px and ``focal`` length px, one or (x, y), of a camera matrix.

    Where there is no camera matrix any ``focal`` will do, as half the frame's diagonal: then k1 is the share by which
    the corner is moved. Raises ValueError for what is not finite, and for a focal length that is not positive.
    """

    center: tuple[float, float]
    focal: float | tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        if len(self.center) != 2 or not all(map(math.isfinite, self.center)):
            raise ValueError(f"Lens: center must be (x, y), finite numbers in px, got {self.center!r}")
        if len(self.focals) != 2 or not all(0 < f < math.inf for f in self.focals):
            raise ValueError(f"Lens: focal must be one or two lengths > 0 in px, got {self.focal!r}")
        if not all(map(math.isfinite, self.coefficients)):
            raise ValueError(f"Lens: k1, k2, p1 and p2 must be finite, got {self.coefficients}")

    @property
    def focals(self) -> tuple[float, float]:
        """(f_x, f_y) px."""
        f = self.focal
        return (float(f), float(f)) if isinstance(f, int | float) else (float(f[0]), float(f[1]))

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """(k1, k2, p1, p2)."""
        return self.k1, self.k2, self.p1, self.p2

    @staticmethod
    def from_opencv(camera_matrix: Tensor, coefficients: Tensor | Sequence[float]) -> Lens:
        """Of what cv2.calibrateCamera gives: a camera matrix (3, 3) and k1, k2, p1, p2 and zeros. ValueError for skew
        and for further coefficients that are not zero."""
        matrix = torch.as_tensor(camera_matrix, dtype=torch.float64)
        rest = torch.as_tensor(coefficients, dtype=torch.float64).flatten().tolist()
        if matrix.shape != (3, 3) or matrix[0, 1] != 0 or matrix[1, 0] != 0:
            raise ValueError(f"Lens: camera_matrix must be (3, 3) without skew, got {matrix.tolist()}")
        if not 4 <= len(rest) <= 14 or any(rest[4:]):
            raise ValueError(f"Lens: coefficients must be k1, k2, p1, p2 and no others but zero, got {rest}")
        fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Lens((cx, cy), (fx, fy), *rest[:4])

    def to_opencv(self) -> tuple[Tensor, Tensor]:
        """Camera matrix (3, 3) and coefficients (4,), float64."""
        (fx, fy), (cx, cy) = self.focals, self.center
        matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        return matrix, torch.tensor(self.coefficients, dtype=torch.float64)

    def distort(self, points: Tensor) -> Tensor:
        """Where undistorted points (..., 2) px are seen: (..., 2) px."""
        x, focal, center = self._normal(points)
        return center + focal * self._seen(x)

    def undistort(self, points: Tensor) -> Tensor:
        """Where points seen at (..., 2) px would be without the lens: (..., 2) px, exact to rounding.

        ValueError for points beyond ``range_px``, where the lens shows two points at one place.
        """
        self.check(points, "Lens")
        return self.straight(points)

    def straight(self, points: Tensor) -> Tensor:
        """``undistort`` without its check: what lies beyond the range comes out somewhere."""
        seen, focal, center = self._normal(points)
        x = seen
        for _ in range(NEWTON):
            off = self._seen(x) - seen
            slope = self._slope(x)
            a, b, c, d = slope.flatten(-2).unbind(-1)
            determinant = _determinant(slope)
            determinant = torch.where(determinant.abs() < 1e-6, 1e-6, determinant)
            step = torch.stack((d * off[..., 0] - b * off[..., 1], a * off[..., 1] - c * off[..., 0]), -1)
            x = x - step / determinant[..., None]
        return center + focal * x

    def slope(self, points: Tensor) -> Tensor:
        """How what is seen changes with undistorted points (..., 2): (..., 2, 2)."""
        x, focal, _ = self._normal(points)
        return self._slope(x) * (focal[:, None] / focal)

    def distort_pose(self, pose: Tensor) -> Tensor:
        """Poses (..., 3) px, px, rad as the lens shows them: moved, and turned as it turns what is there."""
        turn = _turn(self.slope(pose[..., :2]))[..., None]
        return torch.cat((self.distort(pose[..., :2]), pose[..., 2:] + turn), -1)

    def undistort_pose(self, pose: Tensor) -> Tensor:
        """Poses (..., 3) px, px, rad as they would be without the lens. ValueError beyond ``range_px``."""
        self.check(pose[..., :2], "Lens")
        return self.straight_pose(pose)

    def straight_pose(self, pose: Tensor) -> Tensor:
        """``undistort_pose`` without its check."""
        points = self.straight(pose[..., :2])
        return torch.cat((points, pose[..., 2:] - _turn(self.slope(points))[..., None]), -1)

    def undistort_covariance(self, covariance: Tensor, pose: Tensor) -> Tensor:
        """Covariances (..., 3, 3) of poses (..., 3) that are seen, as without the lens."""
        back = torch.zeros_like(covariance)
        back[..., :2, :2] = torch.linalg.inv(self.slope(self.straight(pose[..., :2])))
        back[..., 2, 2] = 1.0
        known = torch.where(covariance.isfinite(), covariance, 0.0)
        return back @ known @ back.mT + torch.where(covariance.isfinite(), 0.0, covariance)

    def turn_and_scale(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """By what a patch at undistorted points (..., 2) is seen turned, (...) rad with the sign of theta, and larger,
        (...)."""
        slope = self.slope(points)
        return _turn(slope), _determinant(slope).clamp(min=0).sqrt()

    @cached_property
    def range_px(self) -> float:
        """Up to how far from the centre what is seen belongs to one point only, px: beyond, the lens folds back."""
        angle = 2 * math.pi * torch.arange(DIRECTIONS, dtype=torch.float64) / DIRECTIONS
        around = torch.stack((angle.cos(), angle.sin()), -1)
        low, high = NEAREST, FARTHEST
        for _ in range(2):  # roughly, and then in the step where it folds
            r = torch.logspace(math.log10(low), math.log10(high), RADII, dtype=torch.float64)
            folded = (_determinant(self._slope(r[:, None, None] * around)) <= 0).any(1)
            if not bool(folded.any()):
                return math.inf
            first = int(folded.to(torch.int8).argmax())
            low, high = float(r[max(first - 1, 0)]), float(r[first])
        edge = self._seen(low * around) * around.new_tensor(self.focals)
        return float(torch.linalg.vector_norm(edge, dim=-1).min())

    def check(self, points: Tensor, where: str) -> None:
        """ValueError, which names ``where``, for points seen (..., 2) beyond ``range_px``."""
        if self.range_px == math.inf:
            return
        away = torch.linalg.vector_norm(points - points.new_tensor(self.center), dim=-1)
        if bool((away > self.range_px).any()):
            far = float(away.max())
            raise ValueError(
                f"{where}: the lens is one to one up to {self.range_px:.0f} px from its centre, "
                f"got a point at {far:.0f}"
            )

    def _normal(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        focal, center = points.new_tensor(self.focals), points.new_tensor(self.center)
        return (points - center) / focal, focal, center

    def _seen(self, x: Tensor) -> Tensor:
        u, v = x.unbind(-1)
        r2 = u * u + v * v
        radial = 1 + r2 * (self.k1 + r2 * self.k2)
        across = 2 * self.p1 * u * v + self.p2 * (r2 + 2 * u * u)
        down = self.p1 * (r2 + 2 * v * v) + 2 * self.p2 * u * v
        return torch.stack((u * radial + across, v * radial + down), -1)

    def _slope(self, x: Tensor) -> Tensor:
        u, v = x.unbind(-1)
        r2 = u * u + v * v
        radial, bend = 1 + r2 * (self.k1 + r2 * self.k2), 2 * (self.k1 + 2 * r2 * self.k2)
        mixed = bend * u * v + 2 * (self.p1 * u + self.p2 * v)
        across = radial + bend * u * u + 2 * self.p1 * v + 6 * self.p2 * u
        down = radial + bend * v * v + 6 * self.p1 * v + 2 * self.p2 * u
        slope: Tensor = torch.stack((across, mixed, mixed, down), -1).unflatten(-1, (2, 2))
        return slope


def _turn(slope: Tensor) -> Tensor:
    """The rotation (...) in (..., 2, 2), with the sign of theta."""
    angle: Tensor = from_matrix(torch.cat((slope, torch.zeros_like(slope[..., :1])), -1))[..., 2]
    return angle


def _determinant(slope: Tensor) -> Tensor:
    a, b, c, d = slope.flatten(-2).unbind(-1)
    determinant: Tensor = a * d - b * c
    return determinant
