"""What the gradients of poses cost: python benchmarks/gradients.py [--backend native] [--turn RAD] [--out FILE.json]

Of templates in one frame, by what asks for gradients: the ``image``, the ``template``, then with what is prepared of
it, or ``both``. Forward is the call itself, with what backward needs of it; backward is what ``loss.backward()`` takes.
With ``--turn`` the frame shows them turned by so much, all of them in its middle. One thread; processor time, the least
of the rounds, in which both take turns.
"""

from __future__ import annotations

import math
import time
from itertools import product
from pathlib import Path

import click
import torch
from results import save, show
from scaling import SCENE, spread, stack
from torch import Tensor

import torch_ecc as te
from torch_ecc.core.reference import Reference
from torch_ecc.core.sampling import inside
from torch_ecc.paper.result import Number

COUNTS, SIZES = (1, 64), (31, 61, 121)
MIDDLE, FRAME = (320.0, 240.0), (480, 640)
ASKED = {"image": (True, False), "template": (False, True), "both": (True, True)}


def crops(frame: Tensor, centers: Tensor, size: int) -> Tensor:
    """(B, 1, size, size) of a frame (H, W)."""
    corners = (centers - size // 2).long().tolist()
    return torch.stack([frame[None, y : y + size, x : x + size] for x, y in corners])


class Work:
    """Templates of some ``size`` in a frame, and what asks for gradients."""

    def __init__(self, frames: Tensor, count: int, size: int, asked: str, backend: str, turn: float = 0.0) -> None:
        centers = spread(count, size + 20, (frames.shape[1], frames.shape[2])).round()
        if turn:
            centers = torch.tensor(MIDDLE).expand(count, 2)
            frames = SCENE.render(torch.tensor([[*MIDDLE, 0.0], [*MIDDLE, turn]], dtype=torch.float64), FRAME)[:, 0]
        self.image, self.template = frames[1].float()[None, None], crops(frames[0].float(), centers, size)
        self.start = torch.cat((centers, torch.full((count, 1), turn)), 1).double() + torch.tensor([0.3, -0.2, 0.0])
        self.by_image, self.by_template = ASKED[asked]
        self.backend, self.prepared = backend, te.prepare(self.template)
        assert bool(inside(self.prepared.warps(self.start), self.prepared.grid.box, frames.shape[1:]).all())

    def once(self) -> tuple[float, float]:
        """Seconds forward and backward."""
        image = self.image.detach().requires_grad_(self.by_image)
        template = self.template.detach().requires_grad_(self.by_template)
        begun = time.process_time()
        loss = te.align(self.reference(template), image, self.start, backend=self.backend).pose.sum()
        there = time.process_time()
        loss.backward()
        return there - begun, time.process_time() - there

    def reference(self, template: Tensor) -> Reference:
        """Of a ``template`` that asks for gradients prepared anew."""
        return te.prepare(template) if self.by_template else self.prepared

    def least(self, rounds: int, seconds: float) -> tuple[float, float]:
        """Of so many rounds, or as many as fit into so many ``seconds``."""
        end, least = time.monotonic() + seconds, (math.inf, math.inf)
        self.once()
        for _ in range(rounds):
            least = tuple(map(min, least, self.once()))  # type: ignore[assignment]
            if time.monotonic() > end:
                break
        return least


@click.command()
@click.option("--backend", type=click.Choice(["native", "torch"]), multiple=True, default=["native", "torch"])
@click.option("--rounds", default=200, show_default=True)
@click.option("--seconds", default=3.0, show_default=True, help="at most, for each row")
@click.option("--turn", default=0.0, show_default=True, help="of the templates, rad")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), help="the figures as JSON")
def main(backend: tuple[str, ...], rounds: int, seconds: float, turn: float, out: Path | None) -> None:
    """Times of forward and backward."""
    torch.set_num_threads(1)
    frames, figures, rows = stack(frames=2), [], []
    for engine, count, size, asked in product(backend, COUNTS, SIZES, ASKED):
        forward, back = Work(frames, count, size, asked, engine, turn).least(rounds, seconds)
        name = f"{engine}, {count} of {size} px, by {asked}{f', turned by {turn}' if turn else ''}"
        rows.append((name, f"{1e3 * forward:.3f}", f"{1e3 * back:.3f}", f"{back / forward:.2f}"))
        figures.append(Number(f"{name}: backward over forward", back / forward, "", "lower", 0.3))
    show("Gradients of poses", ("work", "forward, ms", "backward, ms", "backward over forward"), rows)
    if out:
        save(out, figures)


if __name__ == "__main__":
    main()
