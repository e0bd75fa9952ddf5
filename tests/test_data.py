"""Real sequences with known motion (see conftest.data); skipped where they are not."""

from __future__ import annotations

import json
import math

import cv2
import pytest
import torch

from torch_ecc import Status, Tracker
from torch_ecc.commands.track import Session, TrackJob


def image(path) -> torch.Tensor:
    return torch.from_numpy(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def truth(folder):
    return json.loads((folder / "truth.json").read_text())


def job(folder, tmp_path, **changes):
    settings = {"input": str(folder / "f*.png"), "reference": str(folder / "ref.png"), "out": str(tmp_path)}
    return TrackJob(**(settings | {"overlay": False} | changes))


def hinted(facts):
    x, y, w, h = facts["template_hint"]
    return {"centers": ((x + (w - 1) / 2, y + (h - 1) / 2),), "size": (h, w)}


def track(a_job: TrackJob):
    """The track of a whole run, through the files that it wrote."""
    import numpy as np

    outcome = Session(a_job).run()
    with np.load(outcome.folder / "track.npz") as found:
        return {
            name: torch.from_numpy(found[name]) for name in ("pose", "displacement", "status", "sigma") if name in found
        }


def test_mechanism_video(data, tmp_path):
    """The truth is another tracker's result, good to 0.03 px and 0.1 deg."""
    folder = data / "mechanism_video"
    facts = truth(folder)
    bodies = facts["bodies"].values()
    polygons = tuple(tuple(map(tuple, body["mask_polygon"])) for body in bodies)
    centers = tuple(tuple(body["centre_px"]) for body in bodies)
    found = track(job(folder, tmp_path, reference=None, centers=centers, polygons=polygons))
    assert found["status"].shape == (56, 3)
    assert (found["status"] == Status.CONVERGED).all()
    moves = [[[f["bodies"][b][k] for k in ("tx", "ty", "theta_deg")] for b in "012"] for f in facts["frames"]]
    expected = torch.tensor(moves[-55:], dtype=torch.float64) * torch.tensor([1, 1, -math.pi / 180])
    error = (found["displacement"][1:] - expected).abs()
    assert error[..., :2].max() < 0.06
    assert error[..., 2].max() < math.radians(0.15)


def test_pixel_shift_up_to_15_px_in_one_jump(data):
    folder = data / "pixel_shift"
    facts = truth(folder)
    reference = image(folder / "ref.png")
    for frame in facts["frames"]:
        estimate = Tracker(reference, hinted(facts)["centers"], 121)(image(folder / frame["file"]))
        assert estimate.status == Status.CONVERGED
        assert abs(float(estimate.displacement[0, 0]) - frame["tx"]) < 0.002
        assert abs(float(estimate.displacement[0, 1]) - frame["ty"]) < 0.002


def test_pyvale_rigid(data, tmp_path):
    folder = data / "pyvale_rigid"
    facts = truth(folder)
    found = track(job(folder, tmp_path, **hinted(facts)))
    expected = torch.tensor([[f["tx"], f["ty"]] for f in facts["frames"]], dtype=torch.float64)
    assert (found["status"] == Status.CONVERGED).all()
    assert (found["displacement"][:, 0, :2] - expected).abs().max() < 0.003


@pytest.mark.parametrize(
    ("center", "size", "limits"), [((70.0, 52.0), 49, (0.13, 0.05)), ((126.0, 126.0), 201, (0.13, 0.006))]
)
def test_rotation_full(data, tmp_path, center, size, limits):
    """20 deg a frame through a whole turn; the truth is good to 0.05-0.08 px and 0.005-0.03 deg."""
    folder = data / "rotation_full"
    facts = truth(folder)
    found = track(job(folder, tmp_path, centers=(center,), size=size))
    assert (found["status"] == Status.CONVERGED).all()
    middle = torch.tensor(facts["centre_px"], dtype=torch.float64)
    for frame, pose in zip(facts["frames"], found["pose"][:, 0], strict=True):
        angle = math.radians(frame["theta_deg"])
        turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]).double()
        expected = middle + turn @ (torch.tensor(center).double() - middle)
        assert (pose[:2] - expected).abs().max() < limits[0]
        assert abs(float(pose[2]) + angle) < math.radians(limits[1])
    assert float(found["pose"][-1, 0, 2]) == pytest.approx(2 * math.pi, abs=1e-3)


@pytest.mark.parametrize("medium", ["tiff16", "npy", "avi"])
@pytest.mark.usefixtures("undrawn")
def test_other_media_give_the_same(data, tmp_path, medium):
    import numpy as np

    folder = data / "mechanism_video"
    frames = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.glob("f*.png"))[:8]]
    path = tmp_path / {"tiff16": "v.tif", "npy": "v.npy", "avi": "v.avi"}[medium]
    if medium == "tiff16":
        cv2.imwritemulti(str(path), [f.astype(np.uint16) * 257 for f in frames])
    elif medium == "npy":
        np.save(path, np.stack(frames).astype(np.float32) / 255)
    else:
        video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, frames[0].shape[::-1])
        for frame in frames:
            video.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
        video.release()
    settings = {"reference": None, "centers": ((344.0, 212.0),), "size": 41}
    plain = track(job(folder, tmp_path / "a", **settings, frames="0:7"))["pose"]
    other = track(job(folder, tmp_path / "b", **settings, input=str(path)))["pose"]
    assert (plain - other)[..., :2].abs().max() < (0.1 if medium == "avi" else 1e-3)
