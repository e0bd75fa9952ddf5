"""Fig. 8: steps of theta as ECC and the capacitive sensors (CDS) see them."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from torch_ecc.paper.acquisition import times
from torch_ecc.paper.result import Advance, Experiment, Number, Picture
from torch_ecc.paper.steps import HIGHEST, METHODS, Staircase, staircase, step_table
from torch_ecc.plots.style import new_figure

COLOURS = {"CDS": "#d55e00", "ECC": "#0072b2", "body": "#009e73"}
REMARKS = (
    "The stage turns less than commanded, and differently on the way back: hysteresis and compliance, which is why the "
    "sensors and not the commands are the reference.",
    "The zoom is at its minimum, as in the paper: a pixel is 0.79 um.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """The staircase, drawn as the paper's Fig. 8. ``quick``: dwells of 0.3 s instead of 3 s."""
    found = staircase(quick, advance)
    caption = (
        "Tracking results of ECC and CDS for the angular trajectory, 0.04 deg steps to 0.24 deg and back. The inset "
        "enlarges the highest step."
    )
    lost = sum(int((~track.pose.isfinite().all(1)).sum()) for track in found.tracks.values())
    highest = float(found.mean_deg("CDS").max())
    clock = 1e6 * abs(found.alignment.offset_s - found.acquired.offset_s)
    records = [
        Number("fig8 lost frames", float(lost), "", tolerance=0.0),
        Number("fig8 highest step by the CDS, 0.24 deg commanded", highest, "deg", "higher"),
        Number("fig8 clock offset by the joint estimate, error", clock, "us", tolerance=1000.0),
    ]
    means = {name: found.mean_deg(name) for name in ("CDS", *METHODS)}
    tables = [step_table("Mean theta of each step, deg", means), times({"staircase": found.acquired})]
    picture = Picture("fig8", draw(found), caption)
    return Experiment("fig8", "Fig. 8: angular trajectory", [picture], tables, records, REMARKS)


def draw(found: Staircase, methods: Sequence[str] = ("ECC",)) -> Figure:
    """theta over time on the sensors' clock, of the sensors and by ``methods``."""
    figure = new_figure(9, 4.6)
    axes = figure.subplots()
    inset = axes.inset_axes((0.4, 0.08, 0.24, 0.34))
    sensors, offset = found.sensors, found.alignment.offset_s
    curves = {"CDS": (sensors.time_s, sensors.pose[:, 2].rad2deg())}
    for name in methods:
        track = found.tracks[name]
        curves[name] = track.time_s + offset, track.pose[:, 2].rad2deg()
    for panel in (axes, inset):
        for name, curve in curves.items():
            panel.plot(*curve, color=COLOURS[name], lw=1.1 if name == "CDS" else 0.7, label=name)
    start, end = found.windows_s[HIGHEST].tolist()
    middle = float(found.mean_deg("CDS")[HIGHEST])
    inset.set(xlim=(start, end), ylim=(middle - 0.012, middle + 0.012))
    inset.tick_params(labelsize=7.5)
    axes.indicate_inset_zoom(inset, edgecolor="0.4")
    axes.set(xlabel="time (s)", ylabel=r"$\theta$ (deg)")
    axes.legend(loc="upper left")
    return figure
