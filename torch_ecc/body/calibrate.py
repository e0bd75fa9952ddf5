"""The camera from moves of a stage: its lens from the rigidity of a body, scale and axes from commanded positions.

Where a body of many patches is in every frame, the lens, the scale and the axes are unknowns of one least-squares
problem: patches must be where the lens shows those of a rigid body, and the body where it was sent. The noise of the
templates is common to all frames: of each patch it counts once, as an offset with a standard deviation of its own.

Which quantities the moves tell is seen from the singular values of the Jacobian, once all poses are eliminated and
every quantity is counted in a unit of what may be worth knowing: a direction that no singular value holds is one in
which they may be changed together without anything being seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ecc.body.fusion import AGREES, DISAGREES, USUAL_MEDIAN, fuse
from torch_ecc.body.layout import Layout, Response, wrapped
from torch_ecc.core.ambient import plain
from torch_ecc.core.estimate import Estimate, Status
from torch_ecc.core.pose import rotation
from torch_ecc.records import calibration as moves
from torch_ecc.records.calibration import Calibration, CalibrationFit
from torch_ecc.records.lens import Lens
from torch_ecc.track.tracker import Tracker

LENS = ("k1", "k2", "p1", "p2", "center_x", "center_y")
SCALE = ("f_x", "f_y", "axis_angle")
UNITS = {"k1": 0.01, "k2": 0.01, "p1": 0.01, "p2": 0.01, "center_x": 0.1, "center_y": 0.1}  # the center's in focals
LEAST_RELATIVE = 0.1  # of a scale, and of an angle in rad: known no better is not known
FAR_UM = 1e6  # of the offset between two origins: whatever it is
LEAST_SPREAD = 0.01  # of the longest moves: across them, less tells nothing to begin with
FAR_OFF = 0.05  # of the longest move: a commanded position so far off is told
TAKES_PART = 0.3  # of a direction of unit length
MOST = 60  # frames, evenly spread, that are compared
STEPS = 12
SETTLED = 1e-4  # standard deviations


class SelfCalibration(NamedTuple):
    """The ``calibration``, with scale, axis angle and lens, None if no move was commanded; the ``lens``, None if it was
    not asked for; the standard deviation of each quantity by its name, ``sigma``; what is left, rms: ``residual_px``
    of the patches' places, and ``residual_um`` of the commanded moves, NaN without; ``chi2`` and its degrees of
    ``freedom``; by how much every patch counted in the frames that were compared, ``weight`` (F, R)."""

    calibration: Calibration | None
    lens: Lens | None
    sigma: dict[str, float]
    residual_px: float
    residual_um: float
    chi2: float
    freedom: float
    weight: Tensor

    def __str__(self) -> str:
        values: dict[str, float] = {}
        if self.calibration is not None:
            values |= zip(SCALE, (*self.calibration.scales, self.calibration.axis_angle), strict=True)
        if self.lens is not None:
            values |= zip(LENS, (*self.lens.coefficients, *self.lens.center), strict=True)
        told = [f"{name} = {values[name]:.6g} +- {spread:.2g}" for name, spread in self.sigma.items()]
        return f"{', '.join(told)}; {self.residual_px:.4f} px rms are left"


@plain
@torch.no_grad()
def calibrate(
    moved: Tensor | Estimate,
    commanded_um: Tensor | None = None,
    *,
    tracker: Tracker | None = None,
    lens: Sequence[str] = LENS[:4],
) -> CalibrationFit | SelfCalibration:
    """The camera from moves.

    Of displacements (N, 2 or 3) px and ``commanded_um`` (N, 2): scale and axis angle, see ``CalibrationFit``. Of a
    Track (F, R, ...) of the patches of one rigid body by a ``tracker``: its lens, too, ``lens`` naming what is unknown
    of it, of k1, k2, p1, p2, center_x and center_y, which counts from the middle of the frame; without
    ``commanded_um`` (F, 2) the lens alone, because a rigid body was moved and turned. NaN where a position was not
    commanded, or means another point since the stage has turned.

    ValueError for what does not fit, and for moves that do not tell what is asked, with its names.
    """
    if isinstance(moved, Tensor):
        if commanded_um is None:
            raise ValueError("calibrate: displacements need commanded moves; a Track of a rigid body does not")
        return moves.calibrate(moved, commanded_um)
    if tracker is None:
        raise ValueError("calibrate: a Track needs its tracker=, which knows the patches")
    problem = _problem(moved, commanded_um, tracker, lens)
    return _solved(problem)


class _Problem(NamedTuple):
    """What is known: poses (F, R, 3) of patches, square roots (F, R, 3, 3) of their precisions, whether they were found
    (F, R), where they started (R, 3) and their response; commanded moves (F, 2); the middle and half diagonal of the
    frame; which quantities are ``asked`` for."""

    pose: Tensor
    root: Tensor
    good: Tensor
    start: Tensor
    response: Response
    commanded: Tensor
    middle: tuple[float, float]
    focal: float
    asked: tuple[str, ...]

    def lens(self, q: Tensor) -> Lens:
        """Of all quantities (P,) that are asked for."""
        value = dict(zip(self.asked, q.tolist(), strict=False))
        x, y = (m + value.get(f"center_{n}", 0.0) * self.focal for n, m in zip("xy", self.middle, strict=True))
        return Lens((x, y), self.focal, *(value.get(name, 0.0) for name in LENS[:4]))

    def layout(self, q: Tensor) -> Layout:
        """The patches as one body behind that lens."""
        return Layout.behind(self.lens(q), self.start, [range(len(self.start))], self.response)

    def sent(self, q: Tensor, body: Tensor, layout: Layout) -> Tensor:
        """By how much (F, 2) um bodies (F, 3) are not where they were sent."""
        value = dict(zip(self.asked, q.tolist(), strict=False))
        scale = q.new_tensor([value[name] for name in SCALE[:2]])
        shift = ((body - layout.start)[:, :2] * scale) @ rotation(q.new_tensor(value["axis_angle"])).mT
        return (self.commanded - shift - q[-2:]).nan_to_num(0.0)


def _problem(track: Estimate, commanded: Tensor | None, tracker: Tracker, lens: Sequence[str]) -> _Problem:
    """Checked. ValueError for what does not fit."""
    unknown = [name for name in lens if name not in LENS]
    if unknown:
        raise ValueError(f"calibrate: lens must name some of {', '.join(LENS)}, got {unknown[0]!r}")
    if track.pose.dim() != 3 or track.pose.shape[1:] != tracker.start.shape:
        expected = f"(F, {len(tracker.start)}, 3) as its tracker's"
        raise ValueError(f"calibrate: poses must be {expected}, got {tuple(track.pose.shape)}")
    if commanded is not None and commanded.shape != (len(track.pose), 2):
        raise ValueError(f"calibrate: commanded_um must be ({len(track.pose)}, 2), got {tuple(commanded.shape)}")
    if not lens and commanded is None:
        raise ValueError("calibrate: without commanded moves only a lens can be told, and none is asked for")
    some = torch.linspace(0, len(track.pose) - 1, min(MOST, len(track.pose))).round().long()
    pose, covariance = (v[some].double().cpu() for v in (track.pose, track.covariance))
    good = (track.status[some].cpu() == Status.CONVERGED) & covariance.isfinite().all(-1).all(-1)
    one = torch.eye(3, dtype=torch.float64)
    inverse = torch.linalg.inv(torch.where(good[..., None, None], covariance, one))
    h, w = tracker.frame_shape[-2:]
    response = Response(*(v.cpu() for v in Response.of(tracker.references[0])))
    asked = (*lens, *(() if commanded is None else SCALE))
    none = torch.full((len(some), 2), torch.nan, dtype=torch.float64)
    return _Problem(
        pose,
        torch.linalg.cholesky(inverse).mT,
        good,
        tracker.start.double().cpu(),
        response,
        none if commanded is None else commanded[some].double().cpu(),
        ((w - 1) / 2, (h - 1) / 2),
        math.hypot(w - 1, h - 1) / 2,
        asked,
    )


class _State(NamedTuple):
    """Quantities (P,), with the two offsets of commanded moves last if there are such; bodies (F, 3); weights (F, R);
    the standard deviation of commanded moves, um."""

    q: Tensor
    body: Tensor
    weight: Tensor
    stage_um: float


def _solved(problem: _Problem) -> SelfCalibration:
    state, frames = _begun(problem), 3 * len(problem.good)
    for k in range(STEPS):
        factor = _factor(problem, state)
        step, told = _step(problem, factor, state)
        state = state._replace(body=state.body + step[:frames].view(-1, 3), q=state.q + step[frames:])
        state = _weighed(problem, state)
        spread = torch.linalg.inv(factor[frames:-1, frames:-1]).square().sum(1).sqrt()
        if k > 3 and float((step[frames:] / spread).abs().max()) < SETTLED:
            break
    if told:
        raise ValueError(
            f"calibrate: these moves do not tell {', nor '.join(told)}: move far over the view, in more than one "
            f"direction, and turn; or ask for less{_not_obeyed(problem, state)}"
        )
    return _described(problem, state, spread)


def _not_obeyed(problem: _Problem, state: _State) -> str:
    """What is to be said of commanded moves."""
    _, sent = _residuals(problem, state.q, state.body, 1.0)
    if not sent.shape[1]:
        return ""
    way = problem.commanded.nan_to_num(0.0).norm(dim=1).max()
    off, number = sent.norm(dim=1).max(0)
    words = f"; commanded positions do not fit, number {int(number)} of those compared is off by {float(off):.3g} um"
    return words if off > FAR_OFF * way else ""


def _step(problem: _Problem, factor: Tensor, state: _State) -> tuple[Tensor, list[str]]:
    """The Gauss-Newton step of bodies and quantities, along what the moves tell, and what they do not tell, by names.
    (At first a lens may be hidden that is told as soon as there is one: a centre, by what is distorted around it.)"""
    frames = 3 * len(state.body)
    unit = [_unit(name, value) for name, value in zip(problem.asked, state.q.tolist(), strict=False)]
    unit += [FAR_UM * (1 + state.stage_um)] * (len(state.q) - len(problem.asked))
    scale = factor.new_tensor(unit)
    left, values, right = torch.linalg.svd(factor[frames:-1, frames:-1] * scale)
    held = values > 1.0
    step = scale * (right.mT @ torch.where(held, (left.mT @ factor[frames:-1, -1]) / values.clamp(min=1.0), 0.0))
    rest = factor[:frames, -1:] - factor[:frames, frames:-1] @ step[:, None]
    body = torch.linalg.solve_triangular(factor[:frames, :frames], rest, upper=True)[:, 0]
    told = []
    for direction in right[~held].tolist():
        together = [n for n, v in zip(problem.asked, direction, strict=False) if abs(v) > TAKES_PART]
        told.append(" with ".join(together))
    return torch.cat((body, step)), told


def _begun(problem: _Problem) -> _State:
    """No lens, bodies as they are then, and the scale from where they are."""
    layout = Layout.of(problem.start, [range(len(problem.start))])
    eye = torch.linalg.inv(problem.root.mT @ problem.root)
    body = fuse(problem.pose, eye, problem.good, layout).pose[:, 0]
    q = torch.zeros(len(problem.asked), dtype=torch.float64)
    stage = 1.0
    known = problem.commanded.isfinite().all(1)
    if SCALE[0] in problem.asked:
        px, um = (body - layout.start)[known, :2], problem.commanded[known]
        px, um, shift = px - px.mean(0), um - um.mean(0), (px.mean(0), um.mean(0))
        affine = (torch.linalg.pinv(px, rtol=LEAST_SPREAD) @ um).mT
        mirrored = bool(affine.det() < 0)
        turn, whole = affine[0, 1] - affine[1, 0], affine[0, 0] + affine[1, 1]
        if mirrored:
            turn, whole = -affine[0, 1] - affine[1, 0], affine[0, 0] - affine[1, 1]
        angle = torch.atan2(turn, whole)
        scale = (rotation(angle).mT @ affine).diagonal()
        typical = float(scale.abs().max().clamp(min=1e-12))
        scale = torch.where(scale.abs() < 1e-3 * typical, typical, scale)
        q[-3:] = torch.cat((scale, angle[None]))
        left = um - px @ affine.mT
        stage = max(float(left.square().mean().sqrt()), 1e-6 * typical)
        offset = shift[1] - (shift[0] * scale) @ rotation(angle).mT
        q = torch.cat((q, offset))
    return _State(q, body, problem.good.double(), stage)


def _residuals(problem: _Problem, q: Tensor, body: Tensor, stage_um: float) -> tuple[Tensor, Tensor]:
    """What is left of patches (F, R, 3), whitened, the templates' common noise taken in, and of commanded moves."""
    layout = problem.layout(q)
    there, _ = layout.predict(body[:, None].expand(-1, len(problem.start), 3))
    sent = problem.sent(q, body, layout) / stage_um if len(q) > len(problem.asked) else body[:, :0]
    return wrapped(problem.pose - there), sent


def _white(problem: _Problem, weight: Tensor, values: Tensor) -> Tensor:
    """Rows (F, R, 3, n) of patches in units of their noise. Half of a covariance is the frame's, half that of the
    template, the same in all F frames: with the mean over the frames that leaves I - 1 1^T / (F + 1) as precision."""
    rows = 2**0.5 * (problem.root @ values) * weight.sqrt()[..., None, None]
    count = weight.sum(0).clamp(min=1)[:, None, None]
    share = (1 - (1 - count / (count + 1)).sqrt()) / count
    return rows - weight.sqrt()[..., None, None] * share * (weight.sqrt()[..., None, None] * rows).sum(0)


def _factor(problem: _Problem, state: _State) -> Tensor:
    """The triangular factor of the whitened Jacobian by bodies (x, y, theta of each frame) and quantities, and of the
    residual, its last column."""
    q, body, stage = state.q, state.body, state.stage_um
    frames, count = problem.good.shape
    layout = problem.layout(q)
    _, slope = layout.predict(body[:, None].expand(-1, count, 3))
    slope = torch.cat((slope[..., :2], slope[..., 2:] * layout.reach), -1)
    left, sent = _residuals(problem, q, body, stage)
    by_q = [_difference(problem, state, i) for i in range(len(q))]
    patches = torch.zeros(frames, count, 3, 3 * frames + len(q) + 1, dtype=torch.float64)
    for f in range(frames):
        patches[f, :, :, 3 * f : 3 * f + 3] = slope[f]
    patches[..., 3 * frames : -1] = torch.stack([d[0] for d in by_q], -1)
    patches[..., -1] = left
    rows = [_white(problem, state.weight, patches).flatten(0, 2)]
    if sent.shape[1]:
        moved = torch.zeros(frames, 2, patches.shape[-1], dtype=torch.float64)
        angle = q[len(problem.asked) - 1]
        turn = rotation(angle) * q[len(problem.asked) - 3 : len(problem.asked) - 1] / stage
        known = problem.commanded.isfinite().all(1)
        for f in known.nonzero()[:, 0].tolist():
            moved[f, :, 3 * f : 3 * f + 2] = turn
        moved[..., 3 * frames : -1] = torch.stack([d[1] for d in by_q], -1)
        moved[..., -1] = sent
        rows.append(moved.flatten(0, 1))
    factor: Tensor = torch.linalg.qr(torch.cat(rows), mode="r").R
    return factor


def _difference(problem: _Problem, state: _State, i: int) -> tuple[Tensor, Tensor]:
    """How predictions change with quantity ``i``, by central differences."""
    step = torch.zeros_like(state.q)
    name = problem.asked[i] if i < len(problem.asked) else ""
    step[i] = 1e-4 * (abs(float(state.q[i])) if name in SCALE[:2] else 1.0)
    low, high = (_residuals(problem, state.q + sign * step, state.body, state.stage_um) for sign in (-1, 1))
    return tuple((a - b) / (2 * step[i]) for a, b in zip(low, high, strict=True))  # type: ignore[return-value]


def _unit(name: str, value: float) -> float:
    """What is worth knowing of a quantity."""
    return UNITS.get(name, LEAST_RELATIVE * (1.0 if name == "axis_angle" else abs(value)))


def _weighed(problem: _Problem, state: _State) -> _State:
    """With patches that disagree left out, and commanded moves as good as they seem."""
    left, sent = _residuals(problem, state.q, state.body, 1.0)
    distance = (problem.root @ left[..., None]).square().sum((-2, -1))
    scale = (distance[problem.good].median() / USUAL_MEDIAN).clamp(min=1.0)
    share = ((DISAGREES - distance / scale) / (DISAGREES - AGREES)).clamp(0, 1).square()
    stage = state.stage_um
    if sent.shape[1]:
        known = int(problem.commanded.isfinite().all(1).sum())
        least = 1e-7 * float(state.q[len(problem.asked) - 3].abs())
        stage = max(float((sent.square().sum() / max(2 * known - 5, 1)).sqrt()), least)
    return state._replace(weight=problem.good * share, stage_um=stage)


def _described(problem: _Problem, state: _State, spread: Tensor) -> SelfCalibration:
    left, sent = _residuals(problem, state.q, state.body, 1.0)
    rows = _white(problem, state.weight, left[..., None])
    unknowns = 3 * len(state.body) + len(state.q)
    chi2, freedom = float(rows.square().sum()), float(3 * state.weight.sum() - unknowns)
    worse = max(chi2 / freedom, 1.0) ** 0.5 if freedom > 0 else 1.0
    sigma = {name: worse * float(s) for name, s in zip(problem.asked, spread, strict=False)}
    for name in ("center_x", "center_y"):
        if name in sigma:
            sigma[name] *= problem.focal
    lens = problem.lens(state.q) if any(name in LENS for name in problem.asked) else None
    calibration, residual_um = None, math.nan
    if SCALE[0] in problem.asked:
        value = dict(zip(problem.asked, state.q.tolist(), strict=False))
        calibration = Calibration((value["f_x"], value["f_y"]), value["axis_angle"], lens)
        residual_um = float(sent[problem.commanded.isfinite().all(1)].square().mean().sqrt())
    used = state.weight[..., None].expand(-1, -1, 2)
    rms = float((left[..., :2].square() * used).sum().div(used.sum()).sqrt())
    return SelfCalibration(calibration, lens, sigma, rms, residual_um, chi2, freedom, state.weight)
