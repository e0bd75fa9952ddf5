"""Pictures of results: ``plot_track`` and ``plot_comparison``."""

from torch_ecc.plots.comparison import plot_comparison
from torch_ecc.plots.track import plot_track

__all__ = ["plot_comparison", "plot_track"]
