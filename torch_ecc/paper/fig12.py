"""Fig. 12 (b) to (d): automatic alignment of a probe with a substrate in three steps."""

from __future__ import annotations

from torch_ecc.commands.servo import draw_three_steps
from torch_ecc.commands.servo_job import ServoJob, prepare_parts, run_alignment, setting
from torch_ecc.commands.servo_pictures import draw_errors
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table, counter
from torch_ecc.paper.servo_trials import error_cells

EXPECTED = 260  # frames, for the progress only
LIMIT_PX, LIMIT_DEG = 0.1, 0.02
REMARKS = (
    "The paper shows pictures of its workstation and gives no numbers: the limits are this project's own.",
    "Noise of 2 grey levels, uneven light, velocities off by 0.05 um/s rms, the probe 5 um out of focus. Both parts "
    "are found by a search of the whole frame.",
)


def run(quick: bool, advance: Advance) -> Experiment:
    """One alignment on the simulated workstation; ``quick`` at half the resolution."""
    scale = 0.5 if quick else 1.0
    job = ServoJob.read(setting(scale))
    alignee, tick = prepare_parts(job), counter(EXPECTED, advance)
    found = run_alignment(job, alignee, lambda *_: tick())
    logs = [result.log for result in found.alignment.results]
    (off, deg, miss), nm = found.off, 1e3 * job.cell.mounts["substrate"].um_per_px
    titles = ["step 2: the substrate", "step 3: the probe"]
    rows = [
        (title, f"{len(log.time)}", f"{log.time[-1]:.2f}", *error_cells(log.error[0]), *error_cells(log.error[-1]))
        for title, log in zip(titles, logs, strict=False)
    ]
    header = ("step", "frames", "s", "x px", "y px", "theta deg", "x px, end", "y px, end", "theta deg, end")
    table = Table("Errors as measured, when each step begins and ends", header, rows)
    pictures = [
        Picture("fig12", draw_three_steps(job, alignee, found), "Template (green), tip (ring), landing point (cross)."),
        Picture("fig12_errors", draw_errors(logs, titles[: len(logs)], job.control.gain), "Errors as measured."),
    ]
    records = [
        Number("aligned", float(found.alignment.aligned), "", "higher", 1.0),
        Number("substrate, true error", off, "px", tolerance=LIMIT_PX),
        Number("substrate, true error in nm", nm * off, "nm"),
        Number("substrate, true error of theta", deg, "deg", tolerance=LIMIT_DEG),
        Number("tip off its landing point", miss, "px", tolerance=LIMIT_PX),
        Number("tip off its landing point in nm", nm * miss, "nm"),
    ]
    title, seed = "Fig. 12: automatic alignment of probe and substrate", job.cell.microscope.seed
    return Experiment("fig12", title, pictures, [table], records, REMARKS, seed)
