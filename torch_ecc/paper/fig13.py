"""Fig. 13: velocities while the substrate is servoed, decay of the error, what the controller may get wrong."""

from __future__ import annotations

from typing import Any

from torch_ecc.commands.servo_pictures import draw_errors, draw_velocities
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table, counter
from torch_ecc.paper.servo_trials import Single, error_cells, single
from torch_ecc.servo.record import decay_rate

GAIN, SCALE = 2.0, 0.5  # 1/s; px of the quick runs over those of the others
REMARKS = ("The paper shows the curves without numbers: they rise at once and fall to zero as exponentials, as here.",)
QUICK = ("as it is", "scale 20 % too large, axes 5 deg off")


def clean(scale: float) -> dict[str, Any]:
    """Neither noise nor steps of the stage, which leaves a decay that can be measured."""
    return {
        "camera": {"noise_sigma": 0.0, "bits": "float"},
        "substrate": {"x": {"step": 0.0}, "y": {"step": 0.0}},
        "start": {"substrate": [scale * 215.0, scale * 270.0, 15.0]},
    }


def wrong(scale: float) -> dict[str, dict[str, Any]]:
    """What the controller may get wrong, by name; the first is right."""
    large, small = ({"um_per_px": um / scale, "axis_angle_deg": deg} for um, deg in ((0.33, 5.0), (0.22, -5.0)))
    return {
        "as it is": {},
        "scale 20 % too large, axes 5 deg off": {"belief": large},
        "scale 20 % too small, axes -5 deg off": {"belief": small},
        "axis of rotation unknown": {"belief": {"axis": [0.0, 0.0]}},
        "all three, learning (Broyden)": {"belief": large | {"axis": [0.0, 0.0]}, "control": {"learn": 0.3}},
        "camera 3 frames late, unknown": {"microscope": {"delay": 3}},
        "camera 3 frames late, known": {"microscope": {"delay": 3}, "control": {"delay": 3}},
    }


def run(quick: bool, advance: Advance) -> Experiment:
    """A run without noise, and one for each wrong belief; ``quick``: only one of these, at half the resolution."""
    scale = SCALE if quick else 1.0
    cases = {name: changes for name, changes in wrong(scale).items() if not quick or name in QUICK}
    every, tick = [], counter(1 + len(cases), advance)
    for changes in (clean(scale), *cases.values()):
        every.append(single(scale, **changes | {"control": {"gain": GAIN} | changes.get("control", {})}))
        tick()
    (still, *_), runs = every, dict(zip(cases, every[1:], strict=True))
    rates = decay_rate(still.result.log.time, still.result.log.error, largest=0.8, smallest=0.005)
    off = 100 * (rates / GAIN - 1).abs()
    usual = runs["as it is"]
    records = [
        Number(f"decay of {name}, off lambda, no noise", value, "%", tolerance=5.0)
        for name, value in zip(("x", "y", "theta"), off.tolist(), strict=True)
    ]
    records += [
        Number("largest velocity over its limit", max(r.speed for r in every), "", tolerance=1.0 + 1e-9),
        Number("largest acceleration over its limit", max(r.acceleration for r in every), "", tolerance=1.0 + 1e-9),
        Number("runs aligned", float(sum(r.result.aligned for r in every)), "", "higher", float(len(every))),
        Number("last velocity over the largest", _last(usual), "", tolerance=0.01),
    ]
    velocities = draw_velocities([usual.result.log], ["Substrate"])
    pictures = [
        Picture("fig13", velocities, "Commanded velocities of the substrate's axes."),
        Picture("fig13_decay", draw_errors([still.result.log], ["Without noise"], GAIN), "Errors without noise."),
    ]
    rows = [
        (name, r.result.ending.name, f"{float(r.result.log.time[-1]):.2f}", *error_cells(r.error))
        for name, r in runs.items()
    ]
    header = ("belief", "ending", "s", "x px", "y px", "theta deg")
    tables = [Table("What the controller believes", header, rows, "True errors at the end.")]
    return Experiment("fig13", "Fig. 13: velocities of visual servoing", pictures, tables, records, REMARKS)


def _last(run: Single) -> float:
    """Largest share that the velocity of any axis has of its largest one, in the frame before it is found aligned."""
    velocity = run.result.log.velocity.abs()
    return float((velocity[-2] / velocity.amax(0)).max())
