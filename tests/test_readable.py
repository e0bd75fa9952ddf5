"""Records that read well: what is printed, the short names, tables for pandas, micrometres."""

from __future__ import annotations

import copy
import math
import pickle
import sys

import pytest
import torch
from torch.utils._pytree import tree_map

from torch_ecc import Calibration, Estimate, Origin, Status, Track

INFINITE = torch.diag(torch.full((3,), math.inf)).double()


def estimate(count: int = 3, shift: float = 0.0) -> Estimate:
    """Templates at (10 k, 20 k), turned by k degrees; the second one is lost."""
    k = torch.arange(count, dtype=torch.float64)
    pose = torch.stack((10 * k + shift, 20 * k, (k * math.pi / 180)), 1)
    covariance = torch.diag(torch.tensor([0.012, 0.0023, 1e-4]).double() ** 2).repeat(count, 1, 1)
    status = torch.zeros(count, dtype=torch.int8)
    if count > 1:
        status[1], covariance[1] = Status.LOST, INFINITE
    fields = {
        "pose": pose,
        "displacement": pose - pose[:1] + torch.tensor([shift, 0, 0]),
        "status": status,
        "iterations": torch.full((count,), 4),
        "covariance": covariance,
        "origin": torch.full((count,), int(Origin.NEARBY), dtype=torch.int8),
        "reason": torch.zeros(count, dtype=torch.int8),
    }
    return Estimate(**{name: fields.get(name, torch.full((count,), 0.5)) for name in Estimate._fields})


def track(frames: int = 5) -> Track:
    return Track.stack([estimate(shift=float(k)) for k in range(frames)])


def test_an_estimate_says_what_is_known_of_each_template():
    """Digits as far as sigma leaves them, degrees, and what the status means for the pose."""
    head, _, first, second, _ = str(estimate()).splitlines()
    assert head == "Estimate of 3 templates"
    assert first.split()[:7] == ["0", "0.000", "+-", "0.012", "0.0000", "+-", "0.0023"]
    assert first.split()[7:] == ["0.0000", "+-", "0.0057", "0.5000", "CONVERGED,", "found", "NEARBY"]
    assert second.split()[:3] == ["1", "10.0000", "+-"]
    assert second.endswith("LOST, the last good pose")
    assert repr(estimate()) == str(estimate())


def test_columns_stand_under_their_heads():
    """However long the numbers are: nothing is glued together, nothing ends in blanks."""
    lines = str(estimate(4)._replace(pose=1e4 * estimate(4).pose)).splitlines()[1:]
    for name in ("x (px)", "y (px)", "theta (deg)"):
        end = lines[0].index(name) + len(name)
        assert all(line[end - 1].isdigit() and line[end] == " " for line in lines[1:]), name
    assert all(line == line.rstrip() for line in lines)


def test_of_many_templates_the_first_and_the_last_are_listed():
    lines = str(estimate(1000)).splitlines()
    assert len(lines) == 23
    assert lines[12].strip() == "... and 980 more"
    assert lines[-1].split()[0] == "999"


def test_a_track_says_how_far_each_template_moved_and_what_was_lost():
    head, _, first, second, _ = str(track()).splitlines()
    assert head == "Track of 5 frames, 3 templates; displacements"
    assert first.split()[:5] == ["0", "5/5", "0.000", "to", "4.000"]
    assert second.split() == ["1", "0/5", "5", "LOST"]


OLD = pytest.mark.skipif(torch.__version__ < (2, 7), reason="torch maps over named tuples, but not over their heirs")


@pytest.mark.parametrize("record", [estimate(), pytest.param(track(), marks=OLD)])
def test_what_is_printed_belongs_to_records_only(record):
    """Maps over records put other things in the place of tensors; copies and pickles are what they were."""
    assert repr(tree_map(lambda value: tuple(value.shape), record)).startswith("((")
    meta = tree_map(lambda value: value.to("meta"), record)
    assert "meta" in repr(meta)
    for other in (copy.deepcopy(record), pickle.loads(pickle.dumps(record))):
        assert type(other) is type(record)
        assert repr(other) == repr(record)


def test_a_pose_that_carries_a_gradient_prints():
    e = estimate()
    assert str(e._replace(pose=e.pose.requires_grad_())) == str(e)


@pytest.mark.parametrize("record", [estimate(), track()])
def test_short_names(record):
    assert torch.equal(record.x, record.pose[..., 0])
    assert torch.equal(record.y, record.pose[..., 1])
    assert torch.allclose(record.theta_deg[..., 2], torch.tensor(2.0).double())
    assert record.ok[..., 1].logical_not().all()
    assert record.ok[..., 0].all()


def test_micrometres():
    calibration = Calibration((0.5, -0.25), 0.1)
    um, record = track().to_um(calibration), track()
    assert torch.allclose(um.displacement[:, 2], calibration.to_physical(record.displacement)[:, 2])
    assert um.displacement[:, 1].isnan().all()
    assert torch.equal(um.x, um.displacement[..., 0]) or um.x.isnan().any()
    assert torch.allclose(
        um.sigma[:, 0], calibration.covariance(record.covariance)[:, 0].diagonal(dim1=1, dim2=2).sqrt()
    )
    straight = track().to_um(Calibration(2.0))
    assert torch.allclose(straight.x[:, 0], 2 * record.displacement[:, 0, 0])
    assert torch.allclose(straight.theta_deg[:, 2], record.displacement[:, 2, 2].rad2deg())


def test_a_table_for_pandas():
    """One row per frame and template, the columns of track.csv, words for codes, and every field of one number."""
    pytest.importorskip("pandas")
    table = track().to_pandas()
    assert len(table) == 15
    assert table.loc[7, ["frame", "template"]].tolist() == [2, 1]
    row = table[(table.frame == 3) & (table.template == 2)].iloc[0]
    assert (row.x_px, row.y_px, row.dx_px) == (23.0, 40.0, 23.0)
    assert row.sigma_y_px == pytest.approx(0.0023, rel=1e-6)
    assert set(table.status) == {"CONVERGED", "LOST"}
    assert set(table.origin) == {"NEARBY"}
    scalars = set(Estimate._fields) - {"pose", "displacement", "covariance"}
    assert scalars <= set(table.columns)
    assert "frame" not in estimate().to_pandas().columns


def test_without_pandas_there_is_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match="to_pandas: pandas is not installed; pip install pandas"):
        track().to_pandas()
