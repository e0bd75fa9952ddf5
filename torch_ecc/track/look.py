"""A tracker's look at a frame: where its templates are, from where they are expected; on a GPU as one CUDA graph.

Nothing in a look depends on the host (``sampling.is_cpu``), and the state keeps its place in memory. So what the GPU
was asked to do in one frame it can do again in all others, at once, where the host would ask for some hundred things
one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_ecc.core import implicit
from torch_ecc.core.ambient import lasting
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.pose import ahead
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.settings import Settings
from torch_ecc.core.sight import filled
from torch_ecc.search.locate import image_pyramid
from torch_ecc.track.advance import Remembering, State
from torch_ecc.track.coarse import coarse_to_fine
from torch_ecc.track.shutter import Shutter

WARM = 3  # looks before the one that is recorded: constants are made, kernels compiled and loaded

# Start (R, 3), what was found, and which (R,) have blocks with more left than any noise leaves, None if none has.
Result = tuple[Tensor, Estimate, Tensor | None]


@dataclass
class Look:
    """Of a tracker that has these ``references``, finest level first, in this ``state``; ``moving``: whether each frame
    starts one step further; ``shown``: the frame's mask."""

    references: list[Reference]
    settings: Settings
    shutter: Shutter
    state: State
    moving: bool
    shown: Tensor | None
    graph: Graph | None = field(default=None, init=False)

    def __call__(self, image: Tensor, images: list[Tensor]) -> Result:
        """At an ``image`` (1 or R, 1, H, W), as ``core.frame.as_image`` has it; ``images`` holds it without gradients
        and grows to as many levels as there are."""
        if len(self.references) > 1 or not self.recordable(image):
            return self.made(image, images)
        if self.graph is None or not self.graph.fits(image):
            self.graph = Graph(
                lambda frame: self.made(frame, [frame]), image, [self.state["trust"], self.state["answered"]]
            )
        return self.graph(image)

    def recordable(self, image: Tensor) -> bool:
        """Whether there are CUDA graphs where it is, and nobody asks for more than values."""
        wanted = implicit.wanted(self.references[0], image, self.state["pose"])
        return has_graphs(image.device) and not wanted and not torch.compiler.is_compiling()

    def made(self, image: Tensor, images: list[Tensor]) -> Result:
        """Coarse to fine."""
        pose = self.state["pose"]
        start = there = ahead(pose, self.state["velocity"]) if self.moving else pose
        if len(self.references) > 1:
            image = filled(image.float(), self.shown)
            images[:] = image_pyramid(image.detach(), len(self.references))
            there = coarse_to_fine(self.references, images, start, self.settings.max_iterations)
        look = Remembering(self.state, image, self.settings)
        estimate = self.shutter.solve(look, self.references[0], there, self.state, self.settings.tolerance)
        return start, estimate, look.odd


def has_graphs(device: torch.device) -> bool:
    """Whether a device repeats what was recorded."""
    return device.type == "cuda" and torch.version.hip is None


class Graph:
    """A ``look`` at frames like an ``image``, recorded once and repeated. What it writes into, ``kept``, is as before
    when it was recorded."""

    @lasting
    def __init__(self, look: Callable[[Tensor], Result], image: Tensor, kept: list[Tensor]) -> None:
        self.image, before = image.clone(), [part.clone() for part in kept]
        self.repeat, self.result = recorded(lambda: look(self.image), image.device)
        for new, old in zip(kept, before, strict=True):
            new.copy_(old)

    def fits(self, image: Tensor) -> bool:
        """Whether an ``image`` is like the first one."""
        return image.shape == self.image.shape and image.dtype == self.image.dtype

    def __call__(self, image: Tensor) -> Result:
        """What it finds in another ``image``; the next call leaves it as it is."""
        with torch.no_grad():
            self.image.copy_(image, non_blocking=True)
            self.repeat()
            start, estimate, odd = self.result
            return start.clone(), each(torch.clone, estimate), None if odd is None else odd.clone()


def recorded(work: Callable[[], Result], device: torch.device) -> tuple[Callable[[], None], Result]:
    """What repeats ``work``, and the tensors that it then writes its results into."""
    with torch.cuda.device(device):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(WARM):
                work()
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = work()
    return graph.replay, result
