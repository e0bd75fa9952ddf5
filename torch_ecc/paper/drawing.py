"""What several of the paper's figures are drawn with: its box plots, the ranges that it states, two scales in one."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.cbook import boxplot_stats
from torch import Tensor

BOX: dict[str, Any] = {
    "boxprops": {"color": "#0033cc"},
    "whiskerprops": {"color": "black", "linestyle": "--"},
    "flierprops": {"marker": "+", "markeredgecolor": "#d62728", "markersize": 4, "alpha": 0.5},
    "medianprops": {"linestyle": "none"},
    "meanprops": {"color": "#d62728", "linestyle": "-", "linewidth": 1.5},
}


def draw_box(axes: Axes, x: int, values: Tensor) -> None:
    """Box of the quartiles, whiskers to the last value within 1.5 box heights, outliers, and the mean as the line."""
    statistics = boxplot_stats(values.numpy())
    axes.bxp(statistics, positions=[x], widths=0.5, showmeans=True, meanline=True, manage_ticks=False, **BOX)


def draw_range(axes: Axes, limit: float, label: str | None = None) -> None:
    """Dotted lines at +- a limit that the paper states."""
    axes.axhline(-limit, color="0.4", lw=0.9, ls=":")
    axes.axhline(limit, color="0.4", lw=0.9, ls=":", label=label)


def second_scale(axes: Axes) -> Axes:
    """A second vertical scale, on the right, for another unit."""
    other = axes.twinx()
    other.grid(visible=False)
    other.spines.right.set_visible(True)
    return other


def label_steps(axes: Axes, levels_deg: Tensor, **options: Any) -> None:
    """What was commanded (K,) in deg below each step 1, 2, ... K."""
    axes.set_xticks(range(1, len(levels_deg) + 1), [f"{level:.2f}" for level in levels_deg.tolist()], **options)
