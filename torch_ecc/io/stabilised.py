"""stabilised.mp4: the frames warped back onto the first one, for people to look at."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.core.pose import compose, inverse, matrix
from torch_ecc.io.canvas import Stretch
from torch_ecc.io.film import Film, FilmWriter, Picture
from torch_ecc.io.frames import Frame
from torch_ecc.io.records import Record


class StabilisedWriter(FilmWriter):
    """Context manager: ``write`` each frame with its record, and find stabilised.mp4 in ``out_dir``, in which
    ``template`` stays where and as it was at the start. 8 bits, cubic interpolation; ``fps`` as of ``OverlayWriter``.

    ``torch_ecc.stabilise`` gives the frames themselves, in their own depth.
    """

    def __init__(self, out_dir: str | Path, template: int, *, fps: float | None = None) -> None:
        super().__init__(Film(out_dir, "stabilised", fps))
        self._template = template
        self._stretch: Stretch | None = None
        self._last: Picture | None = None

    def write(self, frame: Frame, record: Record) -> None:
        """Have one frame warped and appended."""
        pose, moved = (value[self._template].detach().cpu() for value in (record.pose, record.displacement))
        self.film.add(partial(self._warped, frame, matrix(compose(pose, inverse(pose - moved)))[:2]))

    def go_on(self, poses: NDArray[np.float64], found: NDArray[np.bool_]) -> None:
        """After the pictures of the first F frames of an unfinished run, with ``poses`` (F, R, 3)."""
        self.film.go_on(len(poses))

    def _warped(self, frame: Frame, motion: Tensor) -> Picture:
        if frame.pixels is not None:
            picture = frame.picture()
            self._stretch = self._stretch or Stretch.of(picture)
            seen = self._stretch.apply(picture)
            flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
            self._last = np.asarray(cv2.warpAffine(seen, motion.numpy(), seen.shape[1::-1], flags=flags), np.uint8)
        if self._last is None:
            return np.zeros((480, 640, 3), np.uint8)
        return self._last
