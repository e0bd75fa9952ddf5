"""Direct calls of torch.ops.torch_ecc.solve with arguments that no caller should give, each in a process of its own.

Run as a script, it prints what became of each as JSON: "answer", the error, or what has ended the process.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

import torch

from torch_ecc import prepare
from torch_ecc.core.native import engine as native

if sys.platform != "win32":  # where there is no fork either
    import resource

SECONDS, BYTES = 10, 2**33  # for each call
Arguments = dict[str, Any]
Change = Callable[[Arguments], None]


def valid() -> Arguments:
    """Three templates on two grids: one inside the frame, one across its border, one beyond it."""
    generator = torch.Generator().manual_seed(0)
    frame = 255 * torch.rand(1, 1, 150, 170, generator=generator)
    templates = torch.stack([frame[0, :, 10 + k : 110 + k, 20 : 20 + 103] for k in range(3)])
    reference = prepare(templates)
    pose = torch.tensor([[71.0, 59.5, 0.0], [140.0, 60.0, 0.1], [500.0, 60.0, 0.0]], dtype=torch.float64)
    tensors, widths, steps = reference.packed
    return {
        "image": frame,
        "pose": pose,
        "grids": tensors,
        "widths": widths,
        "steps": steps,
        "degree": 3,
        "max_iterations": 15,
        "tolerance": 1e-3,
        "criterion": 2,
    }


def put(name: str, value: Any) -> Change:
    """That argument instead."""
    return lambda arguments: arguments.update({name: value})


def to(name: str, change: Callable[[Any], Any]) -> Change:
    """That argument after a ``change``."""
    return lambda arguments: arguments.update({name: change(arguments[name])})


def grid(index: int, change: Callable[[torch.Tensor], torch.Tensor]) -> Change:
    """The tensor at ``index`` of grids after a ``change``: planes, weight, numbers of all pixels, then of fewer."""

    def apply(arguments: Arguments) -> None:
        arguments["grids"] = [change(v) if k == index else v for k, v in enumerate(arguments["grids"])]

    return apply


def filled(value: float, *places: int) -> Callable[[torch.Tensor], torch.Tensor]:
    """Numbers with ``value`` at ``places`` of their last dimension."""

    def change(tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.clone()
        tensor[..., list(places)] = value
        return tensor

    return change


WRONG: dict[str, Change] = {  # must be refused
    "image of float64": to("image", torch.Tensor.double),
    "image of int32": to("image", torch.Tensor.int),
    "image of complex64": to("image", lambda v: v.to(torch.complex64)),
    "image of bool": to("image", lambda v: v > 100),
    "image (h, w)": to("image", lambda v: v[0, 0]),
    "image (1, 1, 1, h, w)": to("image", lambda v: v[None]),
    "image of three channels": to("image", lambda v: v.expand(1, 3, -1, -1)),
    "two images for three templates": to("image", lambda v: v.expand(2, -1, -1, -1)),
    "no image": to("image", lambda v: v[:0]),
    "image without rows": to("image", lambda v: v[:, :, :0]),
    "image without columns": to("image", lambda v: v[..., :0]),
    "meta image": to("image", lambda v: v.to("meta")),
    "sparse image": to("image", torch.Tensor.to_sparse),
    "image of no strides": put("image", 3.0),
    "pose of float32": to("pose", torch.Tensor.float),
    "pose (3,)": to("pose", lambda v: v[0]),
    "pose without dimensions": put("pose", torch.tensor(1.0, dtype=torch.float64)),
    "pose (B, 2)": to("pose", lambda v: v[:, :2]),
    "pose (B, 3, 1)": to("pose", lambda v: v[..., None]),
    "more poses than templates": to("pose", lambda v: v.repeat(2, 1)),
    "fewer poses than templates": to("pose", lambda v: v[:1]),
    "meta pose": to("pose", lambda v: v.to("meta")),
    "no grid": put("grids", []),
    "half a grid": to("grids", lambda v: v[:2]),
    "one grid and a half": to("grids", lambda v: v[:5]),
    "three grids": lambda a: a.update(grids=a["grids"] + a["grids"][3:], widths=[103, 52, 52], steps=[1, 2, 2]),
    "grids in the wrong order": lambda a: a.update(grids=a["grids"][3:] + a["grids"][:3], widths=a["widths"][::-1]),
    "one width for two grids": to("widths", lambda v: v[:1]),
    "no step": put("steps", []),
    "width 0": put("widths", [0, 52]),
    "width -1": put("widths", [103, -1]),
    "width beyond the pitch": put("widths", [113, 52]),
    "width of 2^62": put("widths", [2**62, 52]),
    "step 0": put("steps", [1, 0]),
    "step -1": put("steps", [-1, 2]),
    "planes of int32": grid(0, torch.Tensor.int),
    "planes of float32": grid(3, torch.Tensor.float),
    "planes of three dimensions": grid(0, lambda v: v[:, 0]),
    "planes of six images": grid(0, lambda v: v[:, :6].contiguous()),
    "planes without rows": grid(0, lambda v: v[:, :, :0]),
    "planes with gaps": grid(0, lambda v: torch.stack((v, v), -1)[..., 0]),
    "planes of another pitch": grid(0, lambda v: torch.nn.functional.pad(v, (0, 3))),
    "planes of one template": grid(3, lambda v: v[:1]),
    "weight of float64": grid(1, torch.Tensor.double),
    "weight of other rows": grid(1, lambda v: torch.ones(3, 7, v.shape[-1])),
    "weight of another pitch": grid(4, lambda v: torch.ones(1, 1, v.shape[-1] + 16)),
    "weight without dimensions": grid(1, lambda v: torch.tensor(1.0)),
    "numbers of float32": grid(2, torch.Tensor.float),
    "too few numbers": grid(5, lambda v: v[:, :-1].contiguous()),
    "numbers of one template": grid(2, lambda v: v[:1]),
    "meta numbers": grid(2, lambda v: v.to("meta")),
    "criterion 1": put("criterion", 1),
    "criterion -3": put("criterion", -3),
    "criterion of 2^40 + 2": put("criterion", 2**40 + 2),
    "degree 2": put("degree", 2),
    "degree 7": put("degree", 7),
    "degree -1": put("degree", -1),
    "no iterations": put("max_iterations", 0),
    "iterations below 0": put("max_iterations", -5),
    "tolerance NaN": put("tolerance", math.nan),
    "tolerance of infinity": put("tolerance", math.inf),
    "tolerance below 0": put("tolerance", -1.0),
}
POSES = {"NaN": math.nan, "infinity": math.inf, "-infinity": -math.inf, "1e300": 1e300, "1e18": 1e18, "-1e9": -1e9}
ODD: dict[str, Change] = {  # may be answered or refused
    **{f"pose with {name} at {k}": to("pose", filled(value, k)) for k in range(3) for name, value in POSES.items()},
    **{f"image of {name}": to("image", lambda v, value=value: v * 0 + value) for name, value in POSES.items()},
    "image of one pixel": to("image", lambda v: v[..., :1, :1]),
    "image of one row": to("image", lambda v: v[..., :1, :]),
    "image of one column": to("image", lambda v: v[..., :1]),
    "image with gaps": to("image", lambda v: v[..., ::2, ::3]),
    "image turned": to("image", torch.Tensor.mT.__get__),
    "image of one repeated pixel": to("image", lambda v: v[..., :1, :1].expand(1, 1, 300, 400)),
    "image of very many rows": to("image", lambda v: v[..., :1, :].expand(1, 1, 2**40, -1)),
    "negative view": to("image", torch._neg_view),
    "image with a gradient": to("image", lambda v: v.requires_grad_()),
    "pose with a gradient": to("pose", lambda v: v.requires_grad_()),
    "pose with gaps": to("pose", lambda v: torch.stack((v, v), -1)[..., 0]),
    "no template": lambda a: a.update(pose=a["pose"][:0], grids=[v if v.shape[1] == 1 else v[:0] for v in a["grids"]]),
    "columns cut off": put("widths", [1, 1]),
    "coarse steps of 2^62": put("steps", [1, 2**62]),
    "coarse steps of 10^7": put("steps", [1, 10**7]),
    "steps of 2^62": put("steps", [2**62, 2**62]),
    "steps of 10^6": put("steps", [10**6, 10**6]),
    "iterations of 2^62": put("max_iterations", 2**62),
    "tolerance of 1e300": put("tolerance", 1e300),
    "weight of NaN": grid(1, lambda v: v * math.nan),
    "weight of infinity": grid(4, lambda v: v * math.inf),
    "weight below 0": grid(1, lambda v: -v),
    "weight of none": grid(1, lambda v: v * 0),
    **{f"numbers of {name}": grid(2, lambda v, value=value: v * 0 + value) for name, value in POSES.items()},
    **{f"corner at {name}": grid(2, filled(value, 0, 1)) for name, value in POSES.items()},
    **{f"coarse corner at {name}": grid(5, filled(value, 0, 1)) for name, value in POSES.items()},
    "no half": grid(2, filled(0.0, 2, 3)),
    "radius NaN": grid(2, filled(math.nan, 4)),
    "one row and a weight for it": lambda a: a.update(
        grids=[a["grids"][0][:, :, :1].contiguous(), *a["grids"][1:3]], widths=a["widths"][:1], steps=[1]
    ),
}


def outcome(change: Change) -> str:
    """Of a call in a child process, whose memory is as a valid call has left it."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(SECONDS)
        try:
            word = answer(change)
        except Exception as error:
            word = f"{type(error).__name__}: {error}"
        os.write(write, word.splitlines()[0][:300].encode())
        os._exit(0)
    os.close(write)
    said = os.read(read, 4096).decode()
    os.close(read)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return said if code == 0 else f"{signal.strsignal(-code)}" if code < 0 else f"exit {code}"


def answer(change: Change) -> str:
    """ "answer", if that is what comes."""
    arguments = dict(VALID)
    change(arguments)
    results = torch.ops.torch_ecc.solve(*arguments.values())
    right = {len(value) for value in results} == {len(arguments["pose"])}
    return "answer" if right else "an answer of the wrong shape"


if __name__ == "__main__":
    torch.set_num_threads(1)
    native.load()
    VALID = valid()
    torch.ops.torch_ecc.solve(*VALID.values())
    json.dump({name: outcome(change) for name, change in (WRONG | ODD).items()}, sys.stdout)
