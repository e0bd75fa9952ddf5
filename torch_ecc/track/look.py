"""A tracker's look at a frame: where its templates are, from where they are expected; on a GPU as one CUDA graph.

Nothing in a look depends on the host (``sampling.is_cpu``), and the state keeps its place in memory. So what the GPU
was asked to do in one frame it can do again in all others, at once, where the host would ask for some hundred things
one after the other. What is done again where blocks do not fit is three times as much: it is a graph of its own, for
those frames in which the host sees that some template needs it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_ecc.core import implicit
from torch_ecc.core.ambient import lasting
from torch_ecc.core.estimate import Estimate
from torch_ecc.core.native.engine import DEGREE, code_of
from torch_ecc.core.pose import ahead
from torch_ecc.core.reference import Reference, each
from torch_ecc.core.settings import Settings
from torch_ecc.core.sight import filled
from torch_ecc.search.locate import image_pyramid
from torch_ecc.track.advance import Remembering, State, remembered
from torch_ecc.track.coarse import coarse_to_fine
from torch_ecc.track.lookahead import Foreseen
from torch_ecc.track.shutter import Shutter

WARM = 3  # looks before the one that is recorded: constants are made, kernels compiled and loaded

# Start (R, 3), what was found, which (R,) have blocks with more left than any noise leaves, None if none has, and which
# must be solved again, None if all are that must be: those that are gone, if these are to be searched for first.
Result = tuple[Tensor, Estimate, Tensor | None, Tensor | None]


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
    graphs: dict[bool, Graph] = field(default_factory=dict, init=False)  # one, and another for what was put off

    def __call__(
        self, image: Tensor, images: list[Tensor], search_first: bool = False, seen: Foreseen | None = None
    ) -> Result:
        """At an ``image`` (1 or R, 1, H, W), as ``core.frame.as_image`` has it; ``images`` holds it without gradients
        and grows to as many levels as there are. ``search_first``: what is gone is only named, if nothing else knows
        where it may be. ``seen``: what is known of it already."""
        if seen is not None:
            step, estimate = seen
            return step.start, remembered(estimate, step.found, self.references[0], self.state), None, None
        alone = len(self.references) == 1 and self.shutter.line == 0
        if len(self.references) > 1 or not self.recordable(image):
            return self.made(image, images, False, search_first and alone)
        before = [part.clone() for part in self.kept]
        result = self.graph(image, put_off=self.shutter.line == 0)(image)
        if result[3] is not None and bool(result[3].any()):
            for part, was in zip(self.kept, before, strict=True):
                part.copy_(was)
            result = self.graph(image, put_off=False)(image)
        return *result[:3], None

    @property
    def own(self) -> bool:
        """Whether the criterion or the sampler is somebody's own, which may use autograd."""
        return code_of(self.references[0].criterion) is None or self.settings.interpolation not in DEGREE

    @property
    def kept(self) -> list[Tensor]:
        """What a look leaves for the next one."""
        return [self.state[name] for name in ("trust", "answered", "fixed", "lines")]

    def graph(self, image: Tensor, put_off: bool) -> Graph:
        """That for frames like an ``image``."""
        if put_off not in self.graphs or not self.graphs[put_off].fits(image):
            self.graphs[put_off] = Graph(lambda frame: self.made(frame, [frame], put_off), image, self.kept)
        return self.graphs[put_off]

    def recordable(self, image: Tensor) -> bool:
        """Whether there are CUDA graphs where it is, and nobody asks for more than values."""
        if not has_graphs(image.device) or torch.compiler.is_compiling():
            return False
        return not implicit.wanted(self.references[0], image, self.state["pose"])

    def made(self, image: Tensor, images: list[Tensor], *put_off: bool) -> Result:
        """Coarse to fine."""
        pose = self.state["pose"]
        start = there = ahead(pose, self.state["velocity"]) if self.moving else pose
        if len(self.references) > 1:
            image = filled(image.float(), self.shown)
            images[:] = image_pyramid(image.detach(), len(self.references))
            there = coarse_to_fine(self.references, images, start, self.settings.max_iterations)
        look = Remembering(self.state, image, self.settings, *put_off)
        estimate = self.shutter.solve(look, self.references[0], there, self.state, self.settings.tolerance)
        return start, estimate, look.odd, look.doubtful


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
            start, estimate, *which = self.result
            odd, doubtful = (None if some is None else some.clone() for some in which)
            return start.clone(), each(torch.clone, estimate), odd, doubtful


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
