"""Every tracker of the comparison by name: torch_ecc's variants as the installed library offers them, and its peers."""

from __future__ import annotations

import torch
from adapters import Peer, opencv_peers, ours

from torch_ecc import Tracker
from torch_ecc.sim import PlaneWaves

VARIANTS = {
    "bilinear": {"interpolation": "bilinear"},
    "bspline3": {"interpolation": "bspline3"},
    "bspline5": {"interpolation": "bspline5"},
    "bspline3, gain": {"illumination": "gain"},
    "bspline3, quadratic": {"illumination": "quadratic"},
    "bspline3, ecc_paper": {"criterion": "ecc_paper"},
    "bspline3, ssd": {"criterion": "ssd"},
}


def backends() -> dict[str, str]:
    """The backends of the installed library, and why each of the others is left out ('' if it is there)."""
    frame = PlaneWaves.random().render(torch.tensor([[32.0, 32.0, 0.0]]), (64, 64))[0]
    found = {}
    for name in ("torch", "native"):
        try:
            Tracker(frame, [(32.0, 32.0)], 31, backend=name)(frame)
            found[name] = ""
        except (TypeError, ValueError, RuntimeError, OSError) as error:
            found[name] = str(error).splitlines()[0]
    return found


def trackers() -> dict[str, Peer]:
    """All of them. torch_ecc starts from the previous pose like its peers; "default" is as shipped, with prediction."""
    usable = [name for name, refused in backends().items() if not refused]
    mine = {}
    for backend in usable or [""]:
        chosen = {"backend": backend} if backend else {}
        suffix = f", {backend}" if backend else ""
        for name, options in VARIANTS.items():
            mine[f"{name}{suffix}"] = Peer(ours(prediction="hold", **options, **chosen), "torch_ecc")
    mine["default"] = Peer(ours(), "torch_ecc")
    return mine | opencv_peers()
