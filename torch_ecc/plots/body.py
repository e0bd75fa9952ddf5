"""body.png: the patches of each body with what their residuals are, enlarged, and the bodies' motions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from torch import Tensor

from torch_ecc.plots.save import save
from torch_ecc.plots.style import new_figure, styled

COLOURS = ("#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#e69f00", "#8c6d31", "#5e4fa2", "#444444")
LONGEST = 0.06  # of the picture's diagonal: nine of ten arrows at most
ROUND = (1, 2, 5)


class Bodies(Protocol):
    """What is drawn of G bodies and R patches in F frames, see ``BodyEstimate``."""

    @property
    def displacement(self) -> Tensor: ...
    @property
    def sigma(self) -> Tensor: ...
    @property
    def residual(self) -> Tensor: ...
    @property
    def used(self) -> Tensor: ...
    @property
    def ok(self) -> Tensor: ...


@styled()
def plot_body(
    path: Path, image: Tensor, places: Tensor, groups: Sequence[Sequence[int]], bodies: Bodies, time: Any = None
) -> Path:
    """Draw ``bodies`` into ``path``: the first frame, ``image`` (..., H, W), with each patch at ``places`` (R, 2) and
    an arrow along its residual where its body was farthest from its start; x, y, theta of every body beside it."""
    figure = new_figure(13.5, 6.2)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.35, 1))
    picture = figure.add_subplot(grid[:, 0])
    _draw_picture(picture, image, places, groups, bodies)
    clock = np.arange(len(bodies.displacement)) if time is None else np.asarray(time)
    values = bodies.displacement.cpu().numpy().copy()
    values[~bodies.ok.cpu().numpy()] = np.nan
    values[..., 2] = np.degrees(values[..., 2])
    for k, words in enumerate(("x (px)", "y (px)", "θ (deg)")):
        axes = figure.add_subplot(grid[k, 1])
        for g in range(len(groups)):
            axes.plot(clock, values[:, g, k], color=_colour(g), lw=1.2, label=f"body {g}, {len(groups[g])} patches")
        axes.set_ylabel(words)
    axes.set_xlabel("frame" if time is None else "time (s)")
    figure.axes[1].legend(ncols=2, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1))
    return save(figure, path, 130)


def _draw_picture(axes: Axes, image: Tensor, places: Tensor, groups: Sequence[Sequence[int]], bodies: Bodies) -> None:
    gray = image.cpu().float().reshape(-1, *image.shape[-2:]).mean(0).numpy()
    axes.imshow(gray, cmap="gray", vmin=np.percentile(gray, 1), vmax=np.percentile(gray, 99), alpha=0.6)
    at, residual, used = _where_farthest(places, groups, bodies)
    size = np.hypot(residual[:, 0], residual[:, 1])
    largest = float(np.nanpercentile(size[used], 90)) if bool(used.any()) else 0.0
    factor = _round(LONGEST * float(np.hypot(*gray.shape)) / largest) if largest > 0 else 1.0
    for g, group in enumerate(groups):
        mine = np.zeros(len(at), bool)
        mine[list(group)] = True
        for mark, some in (("o", mine & used), ("x", mine & ~used)):
            axes.plot(*at[some].T, mark, ms=4 if mark == "o" else 6, color=_colour(g), mfc="none")
        # Of those that do not agree the arrows may be as long as the picture is wide, and say nothing.
        to = factor * residual[mine & used]
        whole: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.0022, "headwidth": 4.5}
        axes.quiver(*at[mine & used].T, *to.T, color=_colour(g), minshaft=1.5, minlength=0.5, zorder=3, **whole)
    rms = float(np.sqrt(np.nanmean(np.square(size[used])) / 2)) if bool(used.any()) else np.nan
    words = f"Residuals where each body is farthest from its start, {factor:,.0f} times enlarged; rms {rms:.4f} px"
    axes.set_title(f"{words}\n{int(used.sum())} patches agree (o); x: does not, or was not found there", fontsize=10)
    axes.set(xlim=(-0.5, gray.shape[1] - 0.5), ylim=(gray.shape[0] - 0.5, -0.5), xticks=[], yticks=[])
    axes.grid(visible=False)


def _where_farthest(
    places: Tensor, groups: Sequence[Sequence[int]], bodies: Bodies
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Places (R, 2), residuals (R, 2) and what agrees (R,), of each patch in the frame where its body has gone most."""
    residual = np.full((len(places), 2), np.nan)
    used = np.zeros(len(places), bool)
    way = bodies.displacement.clone()
    way[..., 2] *= 100.0  # px that a turn moves what is as far away
    way[~bodies.ok] = 0.0
    for g, group in enumerate(groups):
        k = int(way[:, g].square().sum(-1).argmax())
        residual[list(group)] = bodies.residual[k, list(group), :2].cpu().numpy()
        used[list(group)] = bodies.used[k, list(group)].cpu().numpy()
    return places.cpu().numpy(), residual, used


def _round(factor: float) -> float:
    """The nearest of 1, 2, 5, 10, ... below."""
    power = 10.0 ** np.floor(np.log10(max(factor, 1.0)))
    return float(max(n * power for n in ROUND if n * power <= max(factor, 1.0)))


def _colour(g: int) -> str:
    return COLOURS[g % len(COLOURS)]
