"""Fig. 7: dynamic tracking errors of ECC on the circles of Fig. 6, by the paper's method and by the joint estimate."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper.circles import Round, rounds
from torch_ecc.paper.result import Advance, Outcome, Picture, Record, Table
from torch_ecc.plots.style import COMPONENTS, letter, new_figure, styled

COLOURS = ("#0072b2", "#d55e00")
PAPER_UM = 0.2  # the paper's dynamic errors lie within +- this
ABOVE_KNOWN = 1.05  # joint estimate over what is left with clocks and angle known exactly
REMARKS = (
    "The paper's nearest points absorb whatever lies along the path: the angle between image and stage (on a circle "
    "about the rest position it moves points along it), the clocks, and real errors alike. What is across the path "
    "remains, and the ends of the groups. The joint estimate keeps every error and takes out clock, angle and zeros.",
    "What it leaves is the vibration of the lens on its column, which the sensors at the stage do not see, and their "
    "non-linearity: as much as exact knowledge of clock and angle leaves. The tracker's own error is below 1 nm.",
)


def run(quick: bool, advance: Advance) -> Outcome:
    """Errors of both circles, drawn as the paper's Fig. 7. ``quick``: the stage is twice as fast."""
    found = rounds(quick, advance)
    with styled():
        figure = draw(found)
    caption = (
        "Dynamic tracking errors for radii of (a) 8 um and (b) 12 um by the paper's method, with its range dotted; "
        "(c), (d) the same frames with clock, angle and zeros estimated at once, in nm."
    )
    title = "Fig. 7: dynamic tracking errors"
    return Outcome("fig7", title, [Picture("fig7", figure, caption)], [_table(found)], _records(found), REMARKS)


def _records(found: list[Round]) -> list[Record]:
    records = []
    for r in found:
        name, limit = f"fig7 {r.radius:g} um:", ABOVE_KNOWN
        ratio = float((r.joint.rms / r.known)[:2].max())
        records += [
            Record(
                f"{name} largest dynamic error by the paper's method", _largest(r), "um", "lower", PAPER_UM, PAPER_UM
            ),
            Record(f"{name} rms by the joint estimate", 1e3 * float(r.joint.rms[:2].max()), "nm"),
            Record(f"{name} that rms over what is left with everything known", ratio, "", tolerance=limit),
            Record(f"{name} rms of the tracker alone", 1e3 * float(r.tracker[:2].max()), "nm", tolerance=2.0),
        ]
    return records


def _largest(r: Round) -> float:
    return float(r.dynamic[:, :2].abs().nan_to_num().max())


def _table(found: list[Round]) -> Table:
    rows = []
    for r in found:
        for words, errors in (
            ("paper's method, largest", _sizes(r.dynamic, largest=True)),
            ("  rms", _sizes(r.dynamic)),
        ):
            rows.append((words, f"{r.radius:g}", *_cells(errors)))
        rows.append(("joint estimate, largest", f"{r.radius:g}", *_cells(_sizes(r.joint.errors, largest=True))))
        rows.append(("  rms", f"{r.radius:g}", *_cells(r.joint.rms)))
        known = {"  with clocks and angle known": r.known, "  of it the lens": r.lens, "  the tracker": r.tracker}
        rows += [(words, f"{r.radius:g}", *_cells(errors)) for words, errors in (known | {"  the CDS": r.cds}).items()]
    return Table("Errors", ("", "radius, um", "x, nm", "y, nm", "theta, urad"), rows)


def _sizes(errors: Tensor, *, largest: bool = False) -> Tensor:
    """rms or largest (3,) of errors (T, 3) with gaps."""
    good = errors[errors.isfinite().all(1)]
    return good.abs().amax(0) if largest else good.square().mean(0).sqrt()


def _cells(errors: Tensor) -> list[str]:
    """(3,) um, um, rad as nm, nm, urad."""
    scaled: list[float] = (errors * errors.new_tensor((1e3, 1e3, 1e6))).tolist()
    return [f"{value:.3g}" for value in scaled]


def draw(found: list[Round]) -> Figure:
    """The paper's (a) and (b) above, the joint estimate's errors of the same frames below."""
    figure = new_figure(11, 6)
    axes = figure.subplots(2, len(found), sharex="col", sharey="row", squeeze=False)
    for k, r in enumerate(found):
        time = r.track.time_s[r.portion]
        _draw(axes[0, k], time, r.dynamic, f"({'ab'[k]}) radius {r.radius:g} um, the paper's method")
        for limit in (-PAPER_UM, PAPER_UM):
            label = "the paper's range" if limit > 0 and k == 0 else None
            axes[0, k].axhline(limit, color="0.4", lw=0.9, ls=":", label=label)
        _draw(axes[1, k], time, 1e3 * r.joint.errors[r.portion], f"({'cd'[k]}) radius {r.radius:g} um, joint estimate")
        axes[1, k].set_xlabel("time (s)")
    axes[0, 0].set_ylabel("error (um)")
    axes[1, 0].set_ylabel("error (nm)")
    axes[0, 0].set_ylim(-1.45 * PAPER_UM, 1.45 * PAPER_UM)
    axes[0, 0].legend(ncols=3, loc="upper left")
    return figure


def _draw(axes: Axes, time: Tensor, errors: Tensor, title: str) -> None:
    for i in (0, 1):
        axes.plot(time, errors[:, i], color=COLOURS[i], lw=0.8, label=COMPONENTS[i])
    largest = torch.nan_to_num(errors[:, :2]).abs().max()
    axes.text(0.99, 0.02, f"largest {largest:.2g}", transform=axes.transAxes, ha="right", va="bottom", fontsize=8.5)
    letter(axes, title)
