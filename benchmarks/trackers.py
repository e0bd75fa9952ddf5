"""Every tracker of the comparison by name: torch_ecc's variants as the installed library offers them, and its peers."""

from __future__ import annotations

import torch
from adapters import Peer, ours
from rivals import rivals

from torch_ecc import Tracker
from torch_ecc.sim import PlaneWaves

SAMPLERS = ("bilinear", "bspline3", "bspline5")
CRITERIA = {
    "gain": {"illumination": "gain"},
    "quadratic": {"illumination": "quadratic"},
    "ecc_paper": {"criterion": "ecc_paper"},
    "ssd": {"criterion": "ssd"},
}


def backends() -> dict[str, str]:
    """The backends by name, and why the installed library refuses each of them ('' if it does not)."""
    frame = PlaneWaves.random().render(torch.tensor([[32.0, 32.0, 0.0]]), (64, 64))[0]
    found = {}
    for name in ("torch", "native"):
        try:
            Tracker(frame, [(32.0, 32.0)], 31, backend=name)(frame)
            found[name] = ""
        except (TypeError, ValueError, RuntimeError, OSError) as error:
            found[name] = str(error).splitlines()[0]
    return found


def options() -> dict[str, dict[str, str]]:
    """What is asked of a Tracker, by the backend's name; {"": {}} while the library has only one."""
    return {name: {"backend": name} for name, refused in backends().items() if not refused} or {"": {}}


def trackers() -> dict[str, Peer]:
    """All of them. torch_ecc starts from the previous pose like its peers; "default" is as shipped, with prediction.

    Samplers on each backend, criteria on the one that the library chooses itself.
    """
    mine = {}
    for backend, chosen in options().items():
        for name in SAMPLERS:
            title = ", ".join(filter(None, (f"torch_ecc {name}", backend)))
            mine[title] = Peer(ours(prediction="hold", interpolation=name, **chosen), "torch_ecc")
    for name, criterion in CRITERIA.items():
        mine[f"torch_ecc {name}"] = Peer(ours(prediction="hold", **criterion), "torch_ecc")
    return mine | {"torch_ecc default": Peer(ours(), "torch_ecc")} | rivals()
