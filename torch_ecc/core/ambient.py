"""Torch's ambient state: what is computed here does not depend on where it is called from, nor does it change that.

A model around a tracker may run under autocast or in inference mode, a script may have set a default dtype or device.
Autocast and inference mode are kept out at the doors, with the decorators below; defaults count nowhere, since every
tensor is made with its own dtype and device.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

PIXELS_PER_THREAD = 2**20  # of templates, some 5 ms of work

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def _has_autocast(kind: str) -> bool:
    try:
        torch.is_autocast_enabled(kind)
    except RuntimeError:  # torch 2.4 knows none for mps
        return False
    return True


AUTOCAST = tuple(filter(_has_autocast, ("cpu", "cuda", "mps", "xpu")))  # devices that have one

_anywhere: Callable[[], bool] = torch._C._is_any_autocast_enabled  # one question for all: it is asked in every frame


def plain(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """``function`` as outside of any autocast: poses are float64 and pixels float32 whatever a model around them is."""

    @wraps(function)
    def protected(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if not _anywhere():
            return function(*args, **kwargs)
        with ExitStack() as stack:
            for kind in AUTOCAST:
                if torch.is_autocast_enabled(kind):
                    stack.enter_context(torch.autocast(kind, enabled=False))
            return function(*args, **kwargs)

    return protected


_below: Callable[[], AbstractContextManager[None]] = torch._C._AutoDispatchBelowAutograd


def unrecorded(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """``function`` of tensors whose gradients nobody asks for: torch does not look for any, which is a tenth of what
    small operations cost. Unlike those made in inference mode its results are ordinary tensors."""

    @wraps(function)
    def quick(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if torch.compiler.is_compiling():
            return function(*args, **kwargs)
        with _below():
            return function(*args, **kwargs)

    return quick


def ordinary(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """``plain``, for what is kept: ordinary tensors in inference mode too.

    A tensor made in inference mode cannot be written to outside of it, ever after.
    """

    @wraps(function)
    def kept(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        recording = torch.is_grad_enabled()  # which leaving inference mode would turn on
        with torch.inference_mode(False), torch.set_grad_enabled(recording):
            return function(*args, **kwargs)

    return plain(kept)


def lasting(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """``ordinary``, without gradients."""
    return plain(torch.inference_mode(False)(torch.no_grad()(function)))


_here = threading.local()  # ``threads`` outside of ``threads_for``, None there


def threads_of_caller() -> int:
    """As many as there are outside of ``threads_for``, for those that wait for each other asleep."""
    return getattr(_here, "threads", None) or torch.get_num_threads()


def repeated(body: Callable[..., tuple[Tensor, ...]], values: tuple[Tensor, ...], times: int) -> tuple[Tensor, ...]:
    """The ``values`` after so many times ``body``. To torch.compile that is a loop, which it compiles once."""
    if not torch.compiler.is_compiling() or torch.compiler.is_exporting():
        for _ in range(times):
            values = body(*values)
        return values
    from torch._higher_order_ops.while_loop import while_loop

    done = torch.zeros((), dtype=torch.int64, device="cpu")  # the host counts
    values = tuple(value.clone() for value in values)  # none may be another's view
    last: tuple[Tensor, ...] = while_loop(
        lambda done, *_: done < times, lambda done, *values: (done + 1, *body(*values)), (done, *values)
    )
    return last[1:]


def constant(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """``lasting``, made once for the same arguments, of which there are few, and for good: a CUDA graph reads it where
    it was; part of the graph that torch.compile makes."""
    cached: Callable[..., Result] = cache(lasting(function))

    @wraps(function)
    def made(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        return function(*args, **kwargs) if torch.compiler.is_compiling() else cached(*args, **kwargs)

    made.cache_clear = cached.cache_clear  # type: ignore[attr-defined]
    return made


class threads_for:  # noqa: N801 - a context, which a generator would make more slowly
    """As many of the caller's threads as templates of so many ``pixels`` are worth; one for most.

    Threads wait for each other at the end of every operation that they share, spinning: on a computer that also does
    something else, a tenth of a millisecond of work then takes as long as a time slice.
    """

    def __init__(self, pixels: int) -> None:
        self.pixels = pixels

    def __enter__(self) -> None:
        self.most, self.callers = torch.get_num_threads(), threads_of_caller()
        torch.set_num_threads(min(1 + self.pixels // PIXELS_PER_THREAD, self.most))
        _here.threads = self.callers

    def __exit__(self, *failure: object) -> None:
        torch.set_num_threads(self.most)
        _here.threads = None if self.callers == self.most else self.callers
