"""Sequences as torch datasets of (frame, pose), and their folders on disk.

A folder holds ``frames/000000.png`` ... (16-bit PNG for uint16, TIFF for float32), ``poses.csv`` (frame, x_px, y_px,
theta_rad) and ``metadata.json``, which is written last: without it a folder is unfinished and does not load.

Both datasets are safe with any number of workers, because a frame's noise depends on its index and the sequence's
seed alone::

    loader = torch.utils.data.DataLoader(SequenceDataset(sequence), batch_size=8, num_workers=2)
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torch_ecc.sim.camera.motion import table
from torch_ecc.sim.camera.sequence import Sequence

HEADER = ["frame", "x_px", "y_px", "theta_rad"]
SUFFIX = {8: "png", 16: "png", None: "tiff"}
BATCH = 4  # frames rendered at once while saving


class SequenceDataset(Dataset[tuple[Tensor, Tensor]]):
    """(frame (1, h, w), pose (3,)) by index, rendered when asked for."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        """IndexError outside 0 <= index < len."""
        return self.sequence.batch(index, index + 1)[0], self.sequence.poses[index]


class SavedSequence(Dataset[tuple[Tensor, Tensor]]):
    """(frame (1, h, w), pose (3,)) by index, read from a folder that ``save`` wrote; ``metadata`` as given there."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        path = self.folder / "metadata.json"
        if not path.is_file():
            raise ValueError(f"SavedSequence: {self.folder} is not a finished sequence: it has no metadata.json")
        self.metadata: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        self.poses = read_poses(self.folder / "poses.csv")
        if len(self.poses) != self.metadata["frames"]:
            raise ValueError(f"SavedSequence: {self.folder} has {len(self.poses)} poses of {self.metadata['frames']}")

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        """IndexError outside 0 <= index < len, ValueError for a frame that cannot be read."""
        if not 0 <= index < len(self):
            raise IndexError(f"SavedSequence: frame {index} of {len(self)}")
        path = self.folder / "frames" / f"{index:06d}.{SUFFIX[self.metadata['bits']]}"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError(f"SavedSequence: cannot read {path}")
        return torch.from_numpy(image)[None], self.poses[index]


def save(
    sequence: Sequence,
    folder: str | Path,
    *,
    metadata: dict[str, Any] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Write a sequence to a folder, which must not hold one yet. ValueError if it does.

    ``metadata`` (what JSON can hold) is kept beside the frame count, size, bits and seed; ``progress`` is called with
    the number of frames written so far.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"save: folder must be empty or new, got {folder}")
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    _write_poses(folder / "poses.csv", sequence.poses)
    camera, done = sequence.camera, 0
    for batch in sequence.batches(BATCH):
        for frame in batch.cpu():
            path = folder / "frames" / f"{done:06d}.{SUFFIX[camera.bits]}"
            if not cv2.imwrite(str(path), frame[0].numpy()):
                raise OSError(f"save: cannot write {path}")
            done += 1
        if progress is not None:
            progress(done)
    facts = {"frames": done, "size": list(camera.size), "bits": camera.bits, "seed": sequence.seed}
    text = json.dumps({**(metadata or {}), **facts}, indent=2)
    (folder / "metadata.json").write_text(text + "\n", encoding="utf-8")
    return folder


def read_poses(path: Path | str) -> Tensor:
    """A motion from a table with the columns x_px, y_px, theta_rad: (F, 3) float64. ValueError for anything else."""
    if not Path(path).is_file():
        raise ValueError(f"read_poses: no such file: {path}")
    with Path(path).open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames is None or not set(HEADER[1:]) <= set(reader.fieldnames):
            raise ValueError(
                f"read_poses: {path} must have the columns {', '.join(HEADER[1:])}, got {reader.fieldnames}"
            )
        rows = list(reader)
    try:
        return table([[float(row[name]) for name in HEADER[1:]] for row in rows])
    except (TypeError, ValueError) as error:
        raise ValueError(f"read_poses: {path}: {error}") from error


def _write_poses(path: Path, poses: Tensor) -> None:
    """Every digit of the truth: repr of a float64 reads back as the same number."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        writer.writerows([i, *map(repr, pose)] for i, pose in enumerate(poses.tolist()))
