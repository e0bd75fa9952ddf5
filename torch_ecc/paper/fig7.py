"""Fig. 7: dynamic tracking errors of ECC on the circles of Fig. 6, by the paper's method and by the joint estimate."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from torch_ecc.paper.circles import Round, rounds
from torch_ecc.paper.drawing import draw_range
from torch_ecc.paper.errors import largest, rms, valid
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table, cells
from torch_ecc.plots.style import COMPONENTS, letter, new_figure

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


def run(quick: bool, advance: Advance) -> Experiment:
    """Errors of both circles, drawn as the paper's Fig. 7. ``quick``: the stage is twice as fast."""
    found = rounds(quick, advance)
    caption = (
        "Dynamic tracking errors for radii of (a) 8 um and (b) 12 um by the paper's method, with its range dotted; "
        "(c), (d) the same frames with clock, angle and zeros estimated at once, in nm."
    )
    title, picture = "Fig. 7: dynamic tracking errors", Picture("fig7", draw(found), caption)
    return Experiment("fig7", title, [picture], [_table(found)], _records(found), REMARKS)


def _records(found: list[Round]) -> list[Number]:
    records = []
    for r in found:
        name, limit = f"fig7 {r.radius:g} um:", ABOVE_KNOWN
        most = float(largest(valid(r.dynamic))[:2].max())
        ratio = float((r.joint.rms / r.parts["known"])[:2].max())
        tracker = 1e3 * float(r.parts["tracker"][:2].max())
        records += [
            Number(f"{name} largest dynamic error by the paper's method", most, "um", "lower", PAPER_UM, PAPER_UM),
            Number(f"{name} rms by the joint estimate", 1e3 * float(r.joint.rms[:2].max()), "nm"),
            Number(f"{name} that rms over what is left with everything known", ratio, "", tolerance=limit),
            Number(f"{name} rms of the tracker alone", tracker, "nm", tolerance=2.0),
        ]
    return records


def _table(found: list[Round]) -> Table:
    rows = []
    for r in found:
        lines = (
            ("paper's method, largest", largest(valid(r.dynamic))),
            ("  rms", rms(valid(r.dynamic))),
            ("joint estimate, largest", largest(valid(r.joint.errors))),
            ("  rms", r.joint.rms),
            ("  with clocks and angle known", r.parts["known"]),
            ("  of it the lens", r.parts["lens"]),
            ("  the tracker", r.parts["tracker"]),
            ("  the CDS", r.parts["CDS"]),
        )
        nano = r.track.pose.new_tensor((1e3, 1e3, 1e6))  # nm, nm, urad
        rows += [(words, f"{r.radius:g}", *cells(nano * errors, ".3g")) for words, errors in lines]
    return Table("Errors", ("", "radius, um", "x, nm", "y, nm", "theta, urad"), rows)


def draw(found: list[Round]) -> Figure:
    """The paper's (a) and (b) above, the joint estimate's errors of the same frames below."""
    figure = new_figure(11, 6)
    axes = figure.subplots(2, len(found), sharex="col", sharey="row", squeeze=False)
    for k, r in enumerate(found):
        time = r.track.time_s[r.portion]
        _draw(axes[0, k], time, r.dynamic, f"({'ab'[k]}) radius {r.radius:g} um, the paper's method")
        draw_range(axes[0, k], PAPER_UM, "the paper's range" if k == 0 else None)
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
    most = largest(valid(errors))[:2].max()
    axes.text(0.99, 0.02, f"largest {most:.2g}", transform=axes.transAxes, ha="right", va="bottom", fontsize=8.5)
    axes.set_title(letter(title))
