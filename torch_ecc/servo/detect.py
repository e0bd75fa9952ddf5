"""Find the template of a tracker anywhere in a frame: step 1 of an alignment, and the way back to a lost target."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ecc.core.estimate import Status
from torch_ecc.core.pose import unwrap
from torch_ecc.search.locate import locate
from torch_ecc.track.tracker import Tracker


def find(tracker: Tracker, frame: Tensor) -> None:
    """Search the whole ``frame`` at any angle for the first template of ``tracker``, which goes on from there.

    ValueError if it is not there, or could as well be somewhere else.
    """
    first = torch.zeros(1, dtype=torch.int64, device=tracker.pose.device)
    found = locate(tracker.references[0].select(first), frame)
    words = f"score {float(found.score[0]):.2f}, the next best place {float(found.runner_up_score[0]):.2f}"
    if not bool(Status.good(found.status[0])):
        raise ValueError(f"find: the template must be in the frame, nothing there looks like it ({words})")
    if bool(found.ambiguous[0]):
        raise ValueError(f"find: the template must be in the frame once, two places look like it ({words})")
    theta = unwrap(found.pose[:, 2:], tracker.pose[:1, 2:])
    tracker.pose = tracker.pose.index_copy(0, first, torch.cat((found.pose[:, :2], theta), 1))
    tracker.velocity = tracker.velocity.index_fill(0, first, 0.0)
