"""Shared pieces of the tests: devices, analytic scenes, the Cramer-Rao bound."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import settings

import torch_ecc  # noqa: F401 - ``blind`` is about all of it

settings.register_profile("untimed", parent=settings(), deadline=None)  # a busy machine is no failure
settings.load_profile("untimed")
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # the fused engine's kernels, before they are imported
torch.set_num_threads(1)  # small tensors: a second thread costs more than it brings


def pytest_collection_finish() -> None:
    """What has been imported by now stays: it need not be looked through for what may go."""
    gc.freeze()


def devices() -> list[str]:
    return ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


@pytest.fixture(params=devices())
def device(request: pytest.FixtureRequest) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(scope="session")
def data() -> Path:
    """The real sequences; TORCH_ECC_DATA may name the folder."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TORCH_ECC_DATA", default))
    if not (folder / "README.md").is_file():
        pytest.skip(f"real sequences are not at {folder}; TORCH_ECC_DATA names another place")
    return folder


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs leave a blank picture: drawing takes longer than the rest of a short one."""
    blank = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    for name in ("plots.plot_track", "commands.compare.plot_comparison"):
        monkeypatch.setattr(f"torch_ecc.{name}", lambda track, path, **_: path.write_bytes(blank))
    monkeypatch.setattr("torch_ecc.plots.body.plot_body", lambda path, *_: path.write_bytes(blank))


@pytest.fixture
def blind(monkeypatch: pytest.MonkeyPatch) -> None:
    """The host looks at nothing in the midst of a solve, as on an accelerator."""
    for name, module in list(sys.modules.items()):
        if name.startswith("torch_ecc.") and hasattr(module, "is_cpu"):
            monkeypatch.setattr(module, "is_cpu", lambda device: False)
