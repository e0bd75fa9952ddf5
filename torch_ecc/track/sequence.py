"""A sequence of frames, some of which may be damaged, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from torch import Tensor

from torch_ecc.core.estimate import Estimate, Track
from torch_ecc.track.lookahead import Frames


class SequenceError(ValueError):
    """A frame of a sequence was refused; ``track`` holds the frames before it (None if it was the first)."""

    def __init__(self, message: str, track: Track | None) -> None:
        super().__init__(message)
        self.track = track


def tracked(
    track: Callable[[Tensor], Estimate],
    skip: Callable[[], Estimate],
    look_ahead: Callable[[Frames], None],
    frames: Iterable[Tensor | None],
    stop_at_damage: bool,
) -> Track:
    """What ``track`` says of each of the ``frames``, or ``skip`` of those that are damaged: see ``Tracker``."""
    estimates: list[Estimate] = []
    if isinstance(frames, Tensor | list | tuple):  # else they may be one tensor, filled again and again
        look_ahead(frames)
    try:
        for frame in frames:
            try:
                estimates.append(track(frame))  # type: ignore[arg-type]  # None is refused
            except ValueError:
                if stop_at_damage or not (frame is None or isinstance(frame, Tensor)):
                    raise
                estimates.append(skip())
    except ValueError as error:
        done = Track.stack(estimates) if estimates else None
        raise SequenceError(f"track_sequence: frame {len(estimates)}: {error}", done) from error
    if not estimates:
        raise ValueError("track_sequence: frames must hold at least one frame, got none")
    return Track.stack(estimates)
