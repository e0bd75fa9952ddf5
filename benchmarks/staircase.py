"""The staircase of Figs. 8 to 11 with a rigid body of all patches in view beside the paper's single template."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torch_ecc import Body, Estimate, Tracker
from torch_ecc.core.estimate import Track
from torch_ecc.paper import steps
from torch_ecc.paper.acquisition import NOISE, Bench, microscope, tracker_of
from torch_ecc.paper.result import Advance, counter
from torch_ecc.records.motion import Motion, dwell_errors
from torch_ecc.sim import GradientLight, LampDrift, Lights, Sequence, StageMotion, micrograph

SIZE, ACROSS, DOWN = 61, 8, 6  # px, and patches that a frame of 640 x 480 is filled with


class BodyBench(Bench):
    """A bench whose camera sees the whole surface, and whose second method is a body."""

    def _film(self, motion: StageMotion) -> Sequence:
        spread = (self.microscope.camera().blur_sigma ** 2 + 1 / 12) ** 0.5
        camera = self.microscope.camera(blur_sigma=0.0, light=self.light, gain=self.gain, noise_sigma=NOISE)
        scene = micrograph(sigma=spread)
        return self.microscope.film(scene, motion, start_s=0.2137, camera=camera, seed=self.seed)

    def _track(
        self, film: Sequence, seconds: dict[str, float], tick: Callable[[], None]
    ) -> tuple[dict[str, Track], Tensor]:
        first = film.batch(0, 1)[0, 0]
        h, w = first.shape
        one, many = tracker_of(first), Tracker(first, _fields(h, w), SIZE)
        body, middle = Body(many), one.start[0, :2]
        found: dict[str, list[Estimate]] = {"ECC": [], "body": []}
        for k in range(len(film)):
            frame = film.batch(k, k + 1)[0, 0]
            single = one(frame)
            found["ECC"].append(single)
            pose, covariance = body(many(frame)).at(middle)
            found["body"].append(single._replace(pose=pose, displacement=pose - one.start, covariance=covariance))
            tick()
        return {name: Track.stack(estimates) for name, estimates in found.items()}, first


def _fields(height: int, width: int) -> Tensor:
    x, y = (
        (torch.arange(n, dtype=torch.float64) + 0.5) * (w - 40) / n + 20 for n, w in ((ACROSS, width), (DOWN, height))
    )
    return torch.cartesian_prod(y, x).flip(1).round()


def climbed(dwell_s: float, advance: Advance) -> steps.Staircase:
    """The staircase with dwells of ``dwell_s``; "truth" among the dwells is what the template's image really did."""
    view, path = microscope(False, zoom=steps.ZOOM, view_um=steps.VIEW_UM), steps.command(dwell_s)
    frames = Bench(view).frames(path)
    light = Lights((GradientLight(), LampDrift(steps.LAMP, period=2.2 * frames)))
    acquired = BodyBench(view, light, steps.GAIN).acquire(path, counter(frames, advance))
    found = steps.compared(acquired, view, dwell_s)
    rest = acquired.truth.pose[acquired.truth.time_s < dwell_s / 4].mean(0)
    truth = Motion(acquired.truth.time_s, acquired.truth.pose - rest)
    found.dwells["truth"] = dwell_errors(truth, found.windows_s - found.alignment.offset_s)
    return found
