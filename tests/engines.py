"""The engines there are, and random problems that each of them must solve as the torch page does."""

from __future__ import annotations

import random
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torch_ecc import ECC, SSD, PaperECC, prepare
from torch_ecc.core import reference
from torch_ecc.core.native import engine as native
from torch_ecc.core.native import library
from torch_ecc.core.reference import Reference
from torch_ecc.sim.scene.scene import PlaneWaves

ENGINES = {"native": native}  # beside the page; each with ``takes`` and ``solve``
FRAME = (110, 130)
SCENE, OTHER = (PlaneWaves.random(seed=seed) for seed in (1, 9))
CRITERIA = [ECC("gain"), ECC("linear"), ECC("quadratic"), SSD(), PaperECC()]
SAMPLERS = ["bilinear", "bspline3", "bspline5"]

compiled = pytest.mark.skipif(library.load() is None, reason="no native engine: python -m torch_ecc.core.native.build")
BACKENDS = [pytest.param("native", marks=compiled), "torch"]


def edge(shape: tuple[int, int]) -> Tensor:
    """A straight edge that nothing fixes along itself, (1, 1, h, w)."""
    return (60 + 100 * torch.sigmoid(torch.arange(shape[1]) - shape[1] / 2)).expand(1, 1, *shape)


class Problem(NamedTuple):
    """Templates, images and starts of an alignment, drawn at random: what is on the template, what the frame shows and
    where, what of it counts, and what the poses speak of."""

    size: tuple[int, int] = (31, 40)
    count: int = 1
    shared: bool = False  # one image for all
    texture: str = "rich"  # or "edge", "noise"
    shown: str = "template"  # or "other", "blank", "tilted"
    place: str = "inside"  # or "border", "outside"
    mask: str = "none"  # or "one", "each"
    centred: bool = True
    enough: int = 1500
    dtype: torch.dtype = torch.uint8
    seed: int = 0

    @staticmethod
    def drawn(draw: random.Random) -> Problem:
        """Any of them."""
        choose = draw.choice
        return Problem(
            size=(draw.randint(11, 48), draw.randint(11, 48)),
            count=draw.randint(1, 3),
            shared=choose([False, True]),
            texture=choose(["rich", "rich", "rich", "edge", "noise"]),
            shown=choose(["template", "template", "tilted", "other", "blank"]),
            place=choose(["inside", "inside", "border", "border", "outside"]),
            mask=choose(["none", "none", "one", "each"]),
            centred=choose([False, True]),
            enough=choose([100, 1500]),
            dtype=choose([torch.uint8, torch.uint16, torch.float32]),
            seed=draw.randint(0, 999),
        )

    def made(self, criterion) -> tuple[Reference, Tensor, Tensor]:
        """Reference, image and start."""
        draw = Draw(self.seed)
        truth = self.truth(draw)
        templates, image = self.images(draw, truth)
        centre = None if self.centred else (draw(self.count, 2) - 0.5).float() * 7
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(reference, "ENOUGH", self.enough)
            prepared = prepare(templates, criterion=criterion, mask=self.weights(draw), centre=centre)
        start = truth + (draw(self.count, 3) - 0.5) * torch.tensor([2.0, 2.0, 0.04])
        return prepared, image, start

    def truth(self, draw: Draw) -> Tensor:
        """Poses (B, 3); around a side of the frame, or beyond it."""
        (height, width), n = FRAME, self.count
        truth = torch.stack((40 + draw(n) * 50, 40 + draw(n) * 30, (draw(n) - 0.5) * 6), -1)
        reach = {"inside": None, "border": (-0.5, 0.5), "outside": (0.8, 3.0)}[self.place]
        if reach:
            side = (draw(n) * 4).long()
            past = (reach[0] + (reach[1] - reach[0]) * draw(n)) * max(self.size)
            x, y = truth[:, 0], truth[:, 1]
            x = torch.where(side == 0, -past, torch.where(side == 1, width - 1 + past, x))
            y = torch.where(side == 2, -past, torch.where(side == 3, height - 1 + past, y))
            truth = torch.stack((x, y, truth[:, 2]), -1)
        return truth[:1].expand(n, 3) if self.shared else truth

    def images(self, draw: Draw, truth: Tensor) -> tuple[Tensor, Tensor]:
        """Templates (B, 1, h, w) and the image (1 or B, 1, H, W)."""
        (h, w), n, poses = self.size, self.count, truth[: 1 if self.shared else self.count]
        middle = torch.tensor([[(w - 1) / 2, (h - 1) / 2, 0.0]], dtype=torch.float64)
        templates = SCENE.render(middle, (h, w)).expand(n, 1, h, w)
        image = SCENE.render(poses, FRAME)
        if self.texture == "edge":
            templates, image = edge((h, w)).expand(n, 1, h, w), edge(FRAME).expand(len(poses), 1, *FRAME)
        if self.texture == "noise":
            templates, image = templates * 0 + 100, image * 0 + 100
        if self.shown == "other":
            image = OTHER.render(poses, FRAME)
        if self.shown == "blank":
            return self.stored(templates + 2 * draw.normal(n, 1, h, w)), self.stored(image * 0)
        if self.shown == "tilted":  # so much that the plain correlation is no match
            image = 0.3 * image + torch.arange(FRAME[1])
        return self.stored(templates + draw.normal(n, 1, h, w)), self.stored(image + 2 * draw.normal(*image.shape))

    def weights(self, draw: Draw) -> Tensor | None:
        """None, (h, w) or (B, h, w)."""
        if self.mask == "none":
            return None
        shape = self.size if self.mask == "one" else (self.count, *self.size)
        weight = (draw(*shape) > 0.2) * draw(*shape)
        weight[..., :3, :] = 1
        return weight

    def stored(self, image: Tensor) -> Tensor:
        """In the dtype that is asked for."""
        if self.dtype.is_floating_point:
            return image.to(self.dtype)
        scale, most = (1, 255) if self.dtype == torch.uint8 else (100, 65535)
        return (image * scale).round().clamp(0, most).to(self.dtype)


class Draw:
    """Random numbers of a seed."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def __call__(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, dtype=torch.float64)

    def normal(self, *shape: int) -> Tensor:
        """Of unit variance."""
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)
