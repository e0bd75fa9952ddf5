"""Figs. 8, 10 and 11 once more, with a rigid body of all patches in view beside the paper's single template."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torch_ecc.body.body import Body
from torch_ecc.core.estimate import Estimate
from torch_ecc.paper import fig8, fig10, fig11
from torch_ecc.paper.acquisition import Bench, simulated_once, tracker_of, zeroed
from torch_ecc.paper.errors import box, largest, rms
from torch_ecc.paper.result import Advance, Experiment, Number, Picture, Table
from torch_ecc.paper.steps import GAIN, Staircase, climbed, step_table
from torch_ecc.records.motion import dwell_errors
from torch_ecc.sim.scene.scene import Scene
from torch_ecc.track.tracker import Tracker

PATCH, FIELD = 61, 80  # px: side of the body's patches, and of the fields of the frame in whose middles they are
METHODS = ("ECC", "body")
SHARE = 0.1  # of the single template's errors, that the body's are to be within
REMARKS = (
    f"The body is all {PATCH} px patches of the frame, one in each field of {FIELD} px. Both see the same frames, and "
    "both tell the pose of the same point. Dwells last 1 s instead of 3 s.",
    "What the stage itself does within a dwell, creep, is in the boxes of all three, and most of the body's: it is as "
    "much as the CDS show. Less the truth, what the template's image really did, the methods' own errors are left.",
    "The absolute errors of a body are not as many times smaller as its scatter: edges along the pixel rows, blurred "
    "by 0.6 px only, are sampled alike in all patches.",
)


class BodyBench(Bench):
    """A bench whose camera shows the whole surface, and whose second method is a body."""

    def shown(self, scene: Scene) -> Scene:
        """All of it."""
        return scene

    def trackers(self, first: Tensor) -> dict[str, Callable[[Tensor], Estimate]]:
        """The single template, and the body, whose pose is that of the template's centre."""
        one, many = tracker_of(first), Tracker(first, fields(*first.shape), PATCH)
        body, number = Body(many), torch.zeros(1, dtype=torch.long)

        def whole(frame: Tensor) -> Estimate:
            estimate = many(frame)
            found = body(estimate)
            pose, covariance = found.at(one.start[0, :2])
            moved = {"pose": pose, "displacement": pose - one.start, "covariance": covariance, "status": found.status}
            whole_body: Estimate = estimate.at(number)._replace(**moved)
            return whole_body

        return {"ECC": one, "body": whole}


def fields(height: int, width: int) -> Tensor:
    """Centres (R, 2) of a body's patches in a frame."""
    rows, columns = (
        (torch.arange(n // FIELD, dtype=torch.float64) + 0.5) * FIELD + (n % FIELD) // 2 for n in (height, width)
    )
    return torch.cartesian_prod(rows, columns).flip(1)


@simulated_once
def staircase(quick: bool, advance: Advance) -> Staircase:
    """Dwells of 1 s, ``quick``: of 0.3 s and a smaller part of the sensor; simulated at the first call only."""
    return with_truth(climbed(lambda view, light: BodyBench(view, light, GAIN), 0.3 if quick else 1.0, quick, advance))


def with_truth(found: Staircase) -> Staircase:
    """The same with "truth" among the dwells: what the template's image has really done (in theta: its axes are the
    camera's)."""
    truth = zeroed(found.acquired.truth, float(found.windows_s[0, 1]) / 4)
    dwells = dwell_errors(truth, found.windows_s - found.alignment.offset_s)
    return found._replace(dwells=found.dwells | {"truth": dwells})


def run(quick: bool, advance: Advance) -> Experiment:
    """The three figures, and how much nearer to the sensors and to the truth the body is. ``quick``: dwells of 0.3 s
    and a quarter of the patches."""
    found = staircase(quick, advance)
    boxes = {name: fig10.errors_of(found, name) for name in ("CDS", *METHODS)}
    off = {name: (found.mean_deg(name) - found.mean_deg("CDS"))[1:] for name in METHODS}
    told = {name: figures(found, name) for name in boxes}
    header = list(told["body"])
    rows = [(name, *(f"{one[words]:.6f}" if words in one else "" for words in header)) for name, one in told.items()]
    records = [Number(f"body / {words}", value, "deg") for words, value in told["body"].items()]
    for k, words in enumerate(header):
        limit = SHARE if k == 2 and not quick else None  # what the stage did is no error
        share = told["body"][words] / told["ECC"][words]
        records.append(Number(f"body, over the template's / {words}", share, "", tolerance=limit))
    tables = [Table("theta, deg", ("", *header), rows), step_table("Absolute errors of theta, deg", off, first=1)]
    pictures = [
        Picture("fig8_body", fig8.draw(found, METHODS), "Fig. 8 with a body; the inset enlarges the highest step."),
        Picture("fig10_body", fig10.draw(boxes), "Fig. 10 with a body: mean errors of theta, each with its own scale."),
        Picture("fig11_body", fig11.draw(off), "Fig. 11 with a body: absolute errors of theta under uneven light."),
    ]
    return Experiment("body", "Figs. 8, 10 and 11 with a rigid body", pictures, tables, records, REMARKS)


def figures(found: Staircase, name: str) -> dict[str, float]:
    """What is said of a method, deg, by what it is."""
    steps, dwells, truth = fig10.errors_of(found, name), found.dwells[name], found.dwells["truth"]
    told = {"Fig. 10: rms": rms(torch.cat(steps)), "Fig. 10: end of the largest box": max(map(box, steps))}
    if name in METHODS:
        noise = (dwells.errors - truth.errors)[dwells.step >= 0, 2].rad2deg()
        true, sensed = ((found.mean_deg(name) - found.mean_deg(other))[1:] for other in ("truth", "CDS"))
        told |= {"rms, less the truth": rms(noise), "Fig. 11: largest": largest(sensed), "off the truth": largest(true)}
    return {words: float(value) for words, value in told.items()}
