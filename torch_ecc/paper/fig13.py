"""Fig. 13: velocities while the substrate is servoed, decay of the error, what the controller may get wrong."""

from __future__ import annotations

import math
from typing import Any

from torch_ecc.commands.servo_pictures import draw_errors, draw_velocities
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table
from torch_ecc.paper.servo_trials import Single, single
from torch_ecc.servo.record import decay_rate

CLEAN: dict[str, Any] = {
    "camera": {"noise_sigma": 0.0, "bits": "float"},
    "substrate": {"x": {"step": 0.0}, "y": {"step": 0.0}},
    "start": {"substrate": [215.0, 270.0, 15.0]},
}
WRONG: dict[str, dict[str, Any]] = {
    "as it is": {},
    "scale 20 % too large, axes 5 deg off": {"belief": {"um_per_px": 0.33, "axis_angle_deg": 5.0}},
    "scale 20 % too small, axes -5 deg off": {"belief": {"um_per_px": 0.22, "axis_angle_deg": -5.0}},
    "axis of rotation unknown": {"belief": {"axis": [0.0, 0.0]}},
    "all three, learning (Broyden)": {
        "belief": {"um_per_px": 0.33, "axis_angle_deg": 5.0, "axis": [0.0, 0.0]},
        "control": {"learn": 0.3},
    },
    "camera 3 frames late, unknown": {"microscope": {"delay": 3}},
    "camera 3 frames late, known": {"microscope": {"delay": 3}, "control": {"delay": 3}},
}
GAIN, SCALE = 2.0, 0.5  # 1/s; px of the quick runs over those of the others
QUICK = ("as it is", "scale 20 % too large, axes 5 deg off")


def run(quick: bool, advance: Advance) -> Experiment:
    """A run without noise, and one for each wrong belief; ``quick``: only one of these, at half the resolution."""
    scale, names = (SCALE, QUICK) if quick else (1.0, tuple(WRONG))
    clean = single(scale, **_changes(CLEAN, scale))
    advance(1, 1 + len(names))
    runs = {}
    for number, name in enumerate(names, 2):
        runs[name] = single(scale, **_changes(WRONG[name], scale))
        advance(number, 1 + len(names))
    rates = decay_rate(clean.result.log.time, clean.result.log.error, largest=0.8, smallest=0.005)
    off = 100 * (rates / GAIN - 1).abs()
    usual = runs["as it is"]
    title = ["Substrate"]
    records = [
        Number(f"decay of {name}, off lambda, no noise", value, "%", tolerance=5.0)
        for name, value in zip(("x", "y", "theta"), off.tolist(), strict=True)
    ]
    every = [clean, *runs.values()]
    records += [
        Number("largest velocity over its limit", max(r.speed for r in every), "", tolerance=1.0 + 1e-9),
        Number("largest acceleration over its limit", max(r.acceleration for r in every), "", tolerance=1.0 + 1e-9),
        Number("runs aligned", float(sum(r.result.aligned for r in every)), "", "higher", float(len(every))),
        Number("last velocity over the largest", _last(usual), "", tolerance=0.01),
    ]
    return Experiment(
        "fig13",
        "Fig. 13: velocities of visual servoing",
        [
            Picture(
                "fig13", draw_velocities([usual.result.log], title), "Commanded velocities of the substrate's axes."
            ),
            Picture("fig13_decay", draw_errors([clean.result.log], ["Without noise"], GAIN), "Errors without noise."),
        ],
        [Table("What the controller believes", _HEADER, [_row(name, r) for name, r in runs.items()], _NOTE)],
        records,
        ["The paper shows the curves without numbers: they rise at once and fall to zero as exponentials, as here."],
    )


_HEADER = ("belief", "ending", "s", "x px", "y px", "theta deg")
_NOTE = "True errors at the end."


def _row(name: str, run: Single) -> tuple[str, ...]:
    x, y, theta = run.error.tolist()
    log = run.result.log
    return (
        name,
        run.result.ending.name,
        f"{float(log.time[-1]):.2f}",
        f"{x:.3f}",
        f"{y:.3f}",
        f"{math.degrees(theta):.4f}",
    )


def _last(run: Single) -> float:
    """Largest share that the velocity of any axis has of its largest one, in the frame before it is found aligned."""
    velocity = run.result.log.velocity.abs()
    return float((velocity[-2] / velocity.amax(0)).max())


def _changes(changes: dict[str, dict[str, Any]], scale: float) -> dict[str, dict[str, Any]]:
    """The same changes for pictures of another scale (lengths in px, and um per px), and lambda."""
    tables = {name: dict(table) for name, table in changes.items()}
    tables["control"] = {"gain": GAIN} | tables.get("control", {})
    if "start" in tables:
        x, y, deg = tables["start"]["substrate"]
        tables["start"]["substrate"] = [scale * x, scale * y, deg]
    if "um_per_px" in tables.get("belief", {}):
        tables["belief"]["um_per_px"] /= scale
    return tables
