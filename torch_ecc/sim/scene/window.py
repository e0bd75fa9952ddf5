"""A scene of which only the neighbourhood of its origin is drawn: long films of large frames in little time."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_ecc.sim.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Window:
    """``scene`` in boxes of ``size`` = (h, w) px around the pose of each frame; the rest of a frame stays dark.

    Inside the box a frame is the same as the whole scene's. A tracker that follows a template at the origin reads
    nothing else; one that loses it finds darkness, and says so.
    """

    scene: Scene
    size: tuple[int, int]

    def __post_init__(self) -> None:
        if len(self.size) != 2 or min(self.size) < 1:
            raise ValueError(f"Window: size must be (h, w) of at least 1 px, got {self.size}")

    def value(self, points: Tensor) -> Tensor:
        """(..., 2) -> (...), of the whole scene."""
        return self.scene.value(points)

    def gradient(self, points: Tensor) -> Tensor:
        """(..., 2) -> (..., 2), of the whole scene."""
        return self.scene.gradient(points)

    def render(self, poses: Tensor, size: tuple[int, int]) -> Tensor:
        """(B, 3) -> (B, 1, h, w) float32 on the poses' device."""
        frames = torch.zeros((len(poses), 1, *size), device=poses.device)
        for frame, pose in zip(frames, poses, strict=True):
            left, top = (
                min(max(round(at) - side // 2, 0), max(whole - side, 0))
                for at, side, whole in zip(pose[:2].tolist(), self.size[::-1], size[::-1], strict=True)
            )
            h, w = min(self.size[0], size[0]), min(self.size[1], size[1])
            corner = pose.new_tensor((left, top, 0.0))
            frame[:, top : top + h, left : left + w] = self.scene.render((pose - corner)[None], (h, w))[0]
        return frames
