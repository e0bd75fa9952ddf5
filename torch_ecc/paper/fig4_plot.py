"""Picture of Fig. 4."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.cbook import boxplot_stats
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.plots.style import COMPONENTS, UNITS, letter, new_figure

ROWS = (("(a) ECC", "linear"), ("(b) SSD", "ref34"))
QUARTILE = 0.6745  # of a Gaussian, in standard deviations
LOOKS: dict[str, Any] = {
    "boxprops": {"color": "#0033cc"},
    "whiskerprops": {"color": "black", "linestyle": "--"},
    "flierprops": {"marker": "+", "markeredgecolor": "#d62728", "markersize": 4, "alpha": 0.5},
    "medianprops": {"linestyle": "none"},
    "meanprops": {"color": "#d62728", "linestyle": "-", "linewidth": 1.5},
}


def draw_boxes(
    errors: Mapping[str, Mapping[str, Tensor]], bounds: Mapping[str, Tensor], paper: tuple[float, float]
) -> Figure:
    """Errors (n, 3) px, px, deg by variance and method, bounds (3,) of the same units, the paper's box and maximum."""
    figure = new_figure(11, 6.4)
    grid = figure.subplots(2, 3, sharex=True, sharey="col")
    for row, (title, method) in zip(grid, ROWS, strict=True):
        for k, axes in enumerate(row):
            for x, (variance, by_method) in enumerate(errors.items(), 1):
                half = QUARTILE * float(bounds[variance][k])
                axes.fill_between((x - 0.45, x + 0.45), -half, half, color="#bdbdbd", lw=0, alpha=0.6)
                _box(axes, x, by_method[method][:, k])
            for y in (*paper, *(-limit for limit in paper)) if UNITS[k] == "px" else ():
                axes.axhline(y, color="#777777", ls=":", lw=1)
            names = [rf"$\sigma_{x}^2 = {variance}$" for x, variance in enumerate(errors, 1)]
            axes.set_xticks(range(1, len(names) + 1), names)
            axes.set_ylabel(f"{COMPONENTS[k]} error ({UNITS[k]})")
            letter(axes, f"{title}: {COMPONENTS[k]}")
    return figure


def _box(axes: Axes, x: int, values: Tensor) -> None:
    """Box of the quartiles, whiskers to the last value within 1.5 box heights, outliers, and the mean as the line."""
    statistics = boxplot_stats(values.numpy())
    axes.bxp(statistics, positions=[x], widths=0.5, showmeans=True, meanline=True, manage_ticks=False, **LOOKS)
