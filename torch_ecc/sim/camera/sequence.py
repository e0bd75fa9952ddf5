"""A sequence: a scene, its poses and a camera. Frames are made when asked for; their truth is exact."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, transform
from torch_ecc.sim.camera.camera import Camera
from torch_ecc.sim.camera.motion import velocity
from torch_ecc.sim.scene.scene import Scene

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Sequence:
    """F frames of ``scene`` at ``poses`` (F, 3) px, px, rad, on the device of the poses.

    A frame depends on its index and on ``seed`` only: any order, batch or process gives the same frames. ``velocities``
    (F, 3) px, px, rad per frame time smear the exposure; without them they are central differences of the poses.
    """

    scene: Scene
    poses: Tensor
    camera: Camera = field(default_factory=Camera)
    seed: int = 0
    velocities: Tensor | None = None

    def __post_init__(self) -> None:
        if self.poses.dim() != 2 or self.poses.shape[1] != 3 or len(self.poses) == 0:
            raise ValueError(f"Sequence: poses must be (F, 3) with F >= 1, got {tuple(self.poses.shape)}")
        if not bool(self.poses.isfinite().all()):
            raise ValueError("Sequence: poses must be finite")
        if self.seed < 0:
            raise ValueError(f"Sequence: seed must be >= 0, got {self.seed}")
        if self.velocities is not None and self.velocities.shape != self.poses.shape:
            shapes = f"{tuple(self.poses.shape)}, got {tuple(self.velocities.shape)}"
            raise ValueError(f"Sequence: velocities must have the shape of the poses, {shapes}")

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[Tensor]:
        """Every frame, (1, h, w) each."""
        for batch in self.batches(1):
            yield batch[0]

    def batch(self, start: int, stop: int) -> Tensor:
        """Frames ``start`` <= i < ``stop``: (B, 1, h, w) uint8, uint16 or float32. IndexError outside the sequence."""
        if not 0 <= start < stop <= len(self):
            raise IndexError(f"Sequence: frames {start} to {stop} of {len(self)}")
        poses, velocities = self.poses[start:stop], None
        if self.camera.exposure > 0:
            velocities = (velocity(self.poses) if self.velocities is None else self.velocities)[start:stop]
        return self.camera.capture(self.scene, poses, velocities=velocities, seed=self.seed, first=start)

    def batches(self, size: int = 8) -> Iterator[Tensor]:
        """All frames in order, at most ``size`` at a time: (B, 1, h, w)."""
        for start in range(0, len(self), size):
            yield self.batch(start, min(start + size, len(self)))

    def truth(self, centers: Tensor) -> Tensor:
        """The poses of upright patches marked at ``centers`` (R, 2) px in frame 0, as a tracker should find them.

        (F, R, 3) px, px, rad; theta counts from frame 0 and is not wrapped.
        """
        centers = centers.to(self.poses)
        start = torch.cat((centers, torch.zeros_like(centers[:, :1])), 1)
        moved = compose(self.poses, inverse(self.poses[:1]).expand_as(self.poses))
        return compose(moved[:, None].expand(-1, len(start), -1), start.expand(len(self), -1, -1))

    def to(self, device: torch.device | str) -> Sequence:
        """The same sequence rendered on another device; float64 must exist there."""
        return _moved(self, device)


def check_inside(truth: Tensor, template: tuple[int, int], frame: tuple[int, int]) -> None:
    """ValueError if a template (h, w) leaves a frame (h, w) at any of its poses (F, R, 3)."""
    (h, w), (rows, columns) = template, frame
    half = truth.new_tensor(((w - 1) / 2, (h - 1) / 2))
    corners = transform(truth, half * truth.new_tensor(((-1, -1), (1, -1), (-1, 1), (1, 1))))
    far = corners.new_tensor((columns - 1, rows - 1))
    outside = ((corners < 0) | (corners > far)).flatten(2).any(2)
    if bool(outside.any()):
        frame_index, which = outside.nonzero()[0].tolist()
        x, y, theta = truth[frame_index, which].tolist()
        raise ValueError(
            f"template: the {h} x {w} px template {which} must stay inside the {rows} x {columns} px frame, "
            f"got x = {x:.1f} px, y = {y:.1f} px, theta = {theta:.3f} rad in frame {frame_index}"
        )


def _moved(item: T, device: torch.device | str) -> T:
    """A copy of nested dataclasses and tuples with every tensor on ``device``."""
    result: Any = item
    if isinstance(item, Tensor):
        result = item.to(device)
    elif isinstance(item, tuple):
        result = tuple(_moved(part, device) for part in item)
    elif is_dataclass(item) and not isinstance(item, type):
        result = replace(item, **{f.name: _moved(getattr(item, f.name), device) for f in fields(item)})
    return result  # type: ignore[no-any-return]
