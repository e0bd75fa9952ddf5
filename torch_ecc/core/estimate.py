"""What an alignment returns: one record per frame, one per sequence, and what its status codes mean."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

from torch_ecc.core.ambient import plain

if TYPE_CHECKING:
    from pandas import DataFrame


class Status(IntEnum):
    """Outcome per template. The first two carry a new pose; the others keep the last good one."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    LOST = 2
    OUT_OF_VIEW = 3
    LOW_TEXTURE = 4
    DAMAGED = 5

    @staticmethod
    def describe(code: int) -> str:
        """A sentence for people."""
        return _SENTENCES[Status(int(code))]

    @staticmethod
    def good(status: Tensor) -> Tensor:
        """Which elements of a status tensor (or array) carry a new pose: bool, same shape."""
        return status <= int(Status.MAX_ITERATIONS)


class Origin(IntEnum):
    """How a pose was come by."""

    TRACKED = 0  # from the expected place, by iterating alone
    NEARBY = 1  # by a search around the expected place, or where others were found to have gone
    ANYWHERE = 2  # by a search of the whole frame


class Reason(IntEnum):
    """Why a pose is not to be trusted: NONE if, and only if, the status is CONVERGED. Every other one goes with one
    status: MOVING with MAX_ITERATIONS, UNSURE and NOISE with LOW_TEXTURE, those from COVERED to AMBIGUOUS and from
    TOO_FAR on with LOST; but BLURRED with LOST or, where sigma is too large, LOW_TEXTURE."""

    NONE = 0
    MOVING = 1
    COVERED = 2
    UNLIKE = 3
    INVERTED = 4
    FLAT = 5
    ELSEWHERE = 6
    AMBIGUOUS = 7
    OUT_OF_VIEW = 8
    UNSURE = 9
    NOISE = 10
    DAMAGED = 11
    TOO_FAR = 12
    SHARED = 13
    WAITING = 14
    DARK = 15
    CLIPPED = 16
    BLURRED = 17

    @property
    def word(self) -> str:
        """As tables have it: empty for NONE."""
        return self.name if self else ""

    @staticmethod
    def describe(code: int) -> str:
        """A sentence for people."""
        return _REASONS[Reason(int(code))]


_SENTENCES = {
    Status.CONVERGED: "The pose is good to the requested tolerance.",
    Status.MAX_ITERATIONS: "The pose was still moving by more than the tolerance when the iterations ran out.",
    Status.LOST: "The frame does not look like the template near the expected place; the last good pose is kept.",
    Status.OUT_OF_VIEW: "Too little of the template is in sight of the camera; the last good pose is kept.",
    Status.LOW_TEXTURE: "The template has too little texture to fix x, y and theta; choose another patch.",
    Status.DAMAGED: "The frame is damaged, or not like the first one; the last good pose is kept.",
}
_REASONS = {
    Reason.NONE: "Nothing speaks against the pose.",
    Reason.MOVING: "The pose was still moving by more than the tolerance when the iterations ran out.",
    Reason.COVERED: "Less than half of the template is believed: something covers it, or it is not there.",
    Reason.UNLIKE: "The frame does not look like the template where it was looked for: it is covered, or gone.",
    Reason.INVERTED: "The frame looks like the template's negative.",
    Reason.FLAT: "Next to no contrast is there: far out of focus, or covered whole.",
    Reason.ELSEWHERE: "It slid to another place, where the frame looks less like the template than usual.",
    Reason.AMBIGUOUS: "The best place found may be that of something else that looks like the template.",
    Reason.OUT_OF_VIEW: "Too little of the template lies inside the frame.",
    Reason.UNSURE: "Sigma is too large: too little texture is seen for the noise.",
    Reason.NOISE: "In some direction nothing but the template's own noise fixes x, y or theta.",
    Reason.DAMAGED: "The frame is damaged, or not like the first one.",
    Reason.TOO_FAR: "It was found farther from its last place than the largest step that was stated.",
    Reason.SHARED: "Another template of the tracker has come to the same place, and looks the same.",
    Reason.WAITING: "It is lost, and its turn to be searched for has not come yet.",
    Reason.DARK: "The frame is dark where it was last: light is missing.",
    Reason.CLIPPED: "The frame is clipped where it was last: there is too much light.",
    Reason.BLURRED: "Coarsely the frame looks like the template, but what is fine is gone: it is out of focus.",
}


class Calibrated(Protocol):
    """What turns pixels into micrometres, such as ``Calibration``."""

    def to_physical(self, displacement: Tensor, pose: Tensor, /) -> Tensor: ...
    def covariance(self, covariance: Tensor, pose: Tensor, /) -> Tensor: ...


class Physical(NamedTuple):
    """Displacements (..., 3) in um, um, rad along the axes of a calibration, and their ``covariance`` (..., 3, 3)."""

    displacement: Tensor
    covariance: Tensor

    @property
    def x(self) -> Tensor:
        """(...) um."""
        return self.displacement[..., 0]

    @property
    def y(self) -> Tensor:
        """(...) um."""
        return self.displacement[..., 1]

    @property
    def theta_deg(self) -> Tensor:
        """(...) degrees."""
        return self.displacement[..., 2].rad2deg()

    @property
    def sigma(self) -> Tensor:
        """Standard deviations: (..., 3) um, um, rad."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()


class Estimate(NamedTuple):
    """Poses of R templates in one frame (or B pairs).

    ``pose`` (R, 3) px, px, rad; ``displacement`` (R, 3) pose minus the pose at start, theta unwrapped; ``score`` (R,)
    zero-mean normalised correlation in [-1, 1]; ``status`` (R,) int8, see Status; ``iterations`` (R,);
    ``covariance`` (R, 3, 3) of the pose, infinite on the diagonal where the status is a failure; ``residual_rms``
    (R,) in grey levels of the frame; ``origin`` (R,) int8, see Origin: a search's only where it gave the pose;
    ``coverage`` (R,) share of the template's weight in sight that the solve believed, in [0, 1]; ``reason`` (R,) int8,
    see Reason: what speaks against the pose.
    """

    pose: Tensor
    displacement: Tensor
    score: Tensor
    status: Tensor
    iterations: Tensor
    covariance: Tensor
    residual_rms: Tensor
    origin: Tensor
    coverage: Tensor
    reason: Tensor

    @property
    def sigma(self) -> Tensor:
        """Standard deviations of the pose: (R, 3) px, px, rad."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()

    @property
    def x(self) -> Tensor:
        """Where the centres are: (R,) px to the right."""
        return self.pose[..., 0]

    @property
    def y(self) -> Tensor:
        """Where the centres are: (R,) px down."""
        return self.pose[..., 1]

    @property
    def theta_deg(self) -> Tensor:
        """The rotations: (R,) degrees, with the sign of eq. 2."""
        return self.pose[..., 2].rad2deg()

    @property
    def ok(self) -> Tensor:
        """Which templates have a new pose, not the last good one: (R,) bool."""
        return Status.good(self.status)

    def to_um(self, calibration: Calibrated) -> Physical:
        """The displacements in um, um, rad along the calibration's axes (eq. 3); NaN where a template was not found."""
        moved, spread = (
            calibration.to_physical(self.displacement, self.pose),
            calibration.covariance(self.covariance, self.pose),
        )
        return Physical(torch.where(self.ok[..., None], moved, torch.nan), spread)

    def to_pandas(self) -> DataFrame:
        """A pandas.DataFrame of one row per template (and frame): the columns of track.csv and the other fields.

        ModuleNotFoundError, in words, where there is no pandas.
        """
        from torch_ecc.core.readable import to_frame

        return to_frame(self)

    def __repr__(self) -> str:
        from torch_ecc.core.readable import estimate_text, readable

        return estimate_text(self) if readable(self) else tuple.__repr__(self)

    def at(self, index: Tensor) -> Estimate:
        """The templates at ``index`` (n,)."""
        return Estimate(*(value[index] for value in self))

    def put(self, index: Tensor, part: Estimate) -> Estimate:
        """This record with the templates at ``index`` (n,) replaced by ``part`` (n, ...)."""
        return Estimate(*(value.index_copy(0, index, new) for value, new in zip(self, part, strict=True)))


class Track(Estimate):
    """The fields of Estimate stacked over F frames: (F, R, ...)."""

    def __repr__(self) -> str:
        from torch_ecc.core.readable import readable, track_text

        return track_text(self) if readable(self) else tuple.__repr__(self)

    @staticmethod
    @plain
    def stack(estimates: Sequence[Estimate]) -> Track:
        """One record of many; ``estimates`` must not be empty."""
        return Track(*(torch.stack(values) for values in zip(*estimates, strict=True)))
