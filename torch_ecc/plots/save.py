"""Figures to files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure


def save(figure: Figure, path: Path, dpi: int) -> Path:
    """Under another name first: what bears the final name is whole."""
    part = path.with_name(f"{path.name}.part")
    part.parent.mkdir(parents=True, exist_ok=True)
    part.unlink(missing_ok=True)  # a link that bears its name is not followed
    form = path.suffix.lstrip(".") or "png"
    quick: Any = {"pil_kwargs": {"compress_level": 3}} if form == "png" else {}
    try:
        figure.savefig(part, dpi=dpi, format=form, **quick)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    os.replace(part, path)
    return path
