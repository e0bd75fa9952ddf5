"""Sequences, their datasets and folders, and the configurations that make them."""

from __future__ import annotations

import json
import math
import tomllib
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from torch_ecc.core.pose import inverse, transform
from torch_ecc.sim import (
    Camera,
    PlaneWaves,
    SavedSequence,
    Sequence,
    SequenceDataset,
    check_inside,
    from_config,
    harmonic,
    micrograph,
    placed,
    save,
)
from torch_ecc.sim.camera.dataset import read_poses

CONFIGS = Path(__file__).parents[1] / "configs"
SIZE = (64, 80)


def sequence(bits: int | None = 8, frames: int = 6) -> Sequence:
    poses = placed(harmonic((5.0, 3.0, 0.2), frames), (40, 32))
    return Sequence(PlaneWaves.random(60, seed=1), poses, Camera(size=SIZE, bits=bits, noise_sigma=2.0), seed=9)


def test_any_batch_gives_the_same_frames():
    one = torch.stack(list(sequence()))
    assert one.shape == (6, 1, *SIZE)
    for size in (2, 4, 10):
        assert torch.equal(torch.cat(list(sequence().batches(size))), one)
    assert torch.equal(sequence().batch(3, 5), one[3:5])
    with pytest.raises(IndexError, match="frames 5 to 7 of 6"):
        sequence().batch(5, 7)


def test_an_exposed_sequence_is_the_same_in_any_batch():
    blurred = Sequence(PlaneWaves.random(20), sequence().poses, Camera(size=SIZE, exposure=0.8, exposure_steps=3))
    assert torch.equal(torch.cat(list(blurred.batches(1))), blurred.batch(0, 6))


def test_truth_follows_the_marked_points():
    """A patch marked at a point of frame 0 is where the scene under that point goes, turned by the turn since then."""
    s = sequence()
    centers = torch.tensor([[40.0, 30.0], [20.0, 15.0]])
    truth = s.truth(centers)
    assert truth.shape == (6, 2, 3)
    torch.testing.assert_close(truth[0], torch.cat((centers, torch.zeros(2, 1)), 1).double())
    in_scene = transform(inverse(s.poses[0]), centers.double())
    for k in range(6):
        torch.testing.assert_close(truth[k, :, :2], transform(s.poses[k], in_scene))
        torch.testing.assert_close(truth[k, :, 2], (s.poses[k, 2] - s.poses[0, 2]).expand(2))


def test_full_turns_stay_in_the_truth():
    poses = torch.tensor([[40.0, 32.0, 0.0], [40.0, 32.0, 9.0]], dtype=torch.float64)
    turned = Sequence(PlaneWaves.random(20), poses, Camera(size=SIZE)).truth(torch.tensor([[40.0, 32.0]]))
    assert float(turned[1, 0, 2]) == 9.0


def test_sequences_move_to_a_device(device):
    there = Sequence(micrograph(), sequence().poses, Camera(size=SIZE)).to(device)
    assert there.batch(0, 1).device.type == device.type
    assert there.scene.parts[0].poses.device.type == device.type


@pytest.mark.parametrize(
    ("pose", "fine"),
    [((30, 30, 0), True), ((10, 30, 0), True), ((9, 30, 0), False), ((12, 30, 0.3), False), ((49, 51, 0), False)],
)
def test_templates_must_stay_inside(pose, fine):
    truth = torch.tensor(pose, dtype=torch.float64).expand(1, 1, 3)
    refusal = pytest.raises(ValueError, match=r"21 x 21 px template 0 must stay inside the 60 x 60 px frame, got x = ")
    with nullcontext() if fine else refusal:
        check_inside(truth, (21, 21), (60, 60))


@pytest.mark.parametrize("workers", [0, 2])
def test_workers_do_not_change_a_dataset(workers):
    loader = DataLoader(SequenceDataset(sequence()), batch_size=4, num_workers=workers)
    frames, poses = (torch.cat(parts) for parts in zip(*loader, strict=True))
    assert torch.equal(frames, sequence().batch(0, 6))
    assert torch.equal(poses, sequence().poses)


@pytest.mark.parametrize("bits", [8, 16, None])
def test_folders_give_back_what_was_saved(tmp_path, bits):
    counts: list[int] = []
    folder = save(sequence(bits), tmp_path / "a", metadata={"note": "x"}, progress=counts.append)
    again = SavedSequence(folder)
    assert len(again) == 6
    assert counts == [4, 6]
    assert again.metadata == {"note": "x", "frames": 6, "size": [64, 80], "bits": bits, "seed": 9}
    assert torch.equal(again.poses, sequence().poses)  # to the last bit
    for i, frame in enumerate(sequence(bits)):
        read, pose = again[i]
        assert read.dtype == frame.dtype
        assert torch.equal(read.float(), frame.float())
        assert torch.equal(pose, sequence().poses[i])
    with pytest.raises(IndexError):
        again[6]


def test_half_written_folders_do_not_load(tmp_path):
    def stop(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save(sequence(), tmp_path / "a", progress=stop)
    with pytest.raises(ValueError, match="is not a finished sequence: it has no metadata"):
        SavedSequence(tmp_path / "a")
    with pytest.raises(ValueError, match="folder must be empty or new"):
        save(sequence(), tmp_path / "a")


def test_damaged_folders_are_refused(tmp_path):
    folder = save(sequence(), tmp_path / "a")
    (folder / "frames" / "000002.png").unlink()
    with pytest.raises(ValueError, match="cannot read"):
        SavedSequence(folder)[2]
    facts = json.loads((folder / "metadata.json").read_text())
    (folder / "metadata.json").write_text(json.dumps({**facts, "frames": 7}))
    with pytest.raises(ValueError, match="has 6 poses of 7"):
        SavedSequence(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2\n", "must have the columns x_px, y_px, theta_rad"),
        ("x_px,y_px,theta_rad\n", r"rows must be \(F, 3\)"),
        ("x_px,y_px,theta_rad\n1,b,3\n", "could not convert"),
    ],
)
def test_wrong_pose_tables_are_refused(tmp_path, text, message):
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_poses(tmp_path / "poses.csv")


@pytest.mark.parametrize(
    ("sequence_settings", "message"),
    [
        ({"poses": torch.zeros(0, 3)}, r"poses must be \(F, 3\) with F >= 1, got \(0, 3\)"),
        ({"poses": torch.full((2, 3), math.nan)}, "poses must be finite"),
        ({"poses": torch.zeros(2, 3), "seed": -1}, "seed must be >= 0, got -1"),
        (
            {"poses": torch.zeros(2, 3), "velocities": torch.zeros(3, 3)},
            r"velocities must have the shape of the poses, \(2, 3\), got \(3, 3\)",
        ),
    ],
)
def test_wrong_sequences_are_refused(sequence_settings, message):
    with pytest.raises(ValueError, match=message):
        Sequence(PlaneWaves.random(4), **sequence_settings)


def test_the_shipped_configuration_is_the_defaults():
    shipped = tomllib.loads((CONFIGS / "simulate.toml").read_text())
    a, b = from_config(shipped), from_config({})
    torch.testing.assert_close(a.sequence.poses, b.sequence.poses)
    assert a.sequence.camera == b.sequence.camera
    assert a.template == b.template
    assert torch.equal(a.sequence.batch(30, 31), b.sequence.batch(30, 31))
    assert torch.equal(a.truth, b.sequence.truth(torch.tensor([[320.0, 240.0]])))


def commented_tables() -> list[str]:
    """Every alternative of the shipped file, uncommented."""
    tables: list[list[str]] = []
    inside = False
    for line in (CONFIGS / "simulate.toml").read_text().splitlines():
        if line.startswith("# ["):
            tables.append([])
        inside = line.startswith("# [") or (inside and line.startswith("# "))
        if inside:
            tables[-1].append(line[2:])
    return ["\n".join(table) for table in tables]


def test_a_template_is_marked_where_the_lens_shows_it():
    """At a pixel of the frame; its truth is that of the point which the lens shows there."""
    simulation = from_config({"camera": {"lens": {"k1": 0.05}}, "template": {"center": [200, 180]}})
    center, lens = torch.tensor([200.0, 180.0], dtype=torch.float64), simulation.sequence.camera.lens
    torch.testing.assert_close(simulation.truth[0, 0, :2], lens.undistort(center))
    assert float((simulation.truth[0, 0, :2] - center).norm()) > 0.5
    assert (lens.center, lens.focal) == ((319.5, 239.5), math.hypot(319.5, 239.5))


@pytest.mark.parametrize("text", commented_tables(), ids=lambda t: " ".join(t.split("#")[0].split()))
def test_every_alternative_of_the_shipped_configuration_works(text, tmp_path):
    cv2.imwrite(str(tmp_path / "still.png"), np.random.default_rng(0).integers(0, 256, (60, 70), dtype=np.uint8))
    (tmp_path / "poses.csv").write_text("x_px,y_px,theta_rad\n1,2,0.1\n")
    settings = {"template": {"center": [95, 90], "size": [41, 41]}} | tomllib.loads(text)
    settings["camera"] = {"size": [180, 200]} | settings.get("camera", {})
    simulation = from_config(settings, folder=tmp_path)
    assert simulation.sequence.batch(0, 1).shape == (1, 1, 180, 200)


def test_degrees_are_radians_by_another_name():
    for plain, degrees in (
        ({"kind": "ramp", "end": [1.0, 2.0, math.pi]}, {"kind": "ramp", "end_deg": [1, 2, 180]}),
        ({"kind": "circle", "radius": 5, "spin": math.pi}, {"kind": "circle", "radius": 5, "spin_deg": 180}),
    ):
        a, b = from_config({"motion": plain}), from_config({"motion": degrees})
        torch.testing.assert_close(a.sequence.poses, b.sequence.poses)


def test_a_saved_motion_can_be_replayed(tmp_path):
    made = from_config({"motion": {"points": 5, "lead_in": 3}, "camera": {"size": [200, 220]}})
    save(made.sequence, tmp_path / "a")
    motion = {"kind": "file", "path": "a/poses.csv", "center": [0, 0], "lead_in": 0}
    again = from_config({"motion": motion, "camera": {"size": [200, 220]}}, folder=tmp_path)
    assert torch.equal(again.sequence.poses, made.sequence.poses)


def test_settings_reach_the_camera():
    camera = from_config({"camera": {"noise_variance": 0.001, "bits": "float", "drift": {}}}).sequence.camera
    assert camera.noise_sigma == pytest.approx(255 * 0.001**0.5)
    assert camera.bits is None
    assert camera.drift is not None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"sceen": {}}, r"simulate: unknown key 'sceen' \(did you mean 'scene'\?\)"),
        ({"scene": {"kind": "moon"}}, "kind must be one of micrograph, waves, wafer, speckle, image, got 'moon'"),
        ({"scene": {"kind": "image", "path": "no.png"}}, "no such still: .*no.png"),
        ({"scene": {"kind": "image"}}, r"\[scene\] image: missing key 'path'"),
        ({"scene": {"sigma": "a"}}, r"\[scene\] micrograph: sigma must be a valid number, got 'a'"),
        ({"scene": 3}, r"\[scene\] must be a table of settings, got 3"),
        ({"scene": {"kind": "waves", "count": 2.5}}, "count must be a valid integer, got 2.5"),
        ({"scene": {"kind": "waves", "spectrum": "x"}}, "spectrum must be 'natural' or 'fine', got 'x'"),
        ({"motion": {"kind": "fly"}}, "kind must be one of harmonic, circle"),
        ({"motion": {"kind": "ramp"}}, r"\[motion\] ramp: missing key 'end'"),
        ({"motion": {"kind": "file", "path": "no.csv"}}, "no such file: .*no.csv"),
        ({"motion": {"amplitudes_deg": "x"}}, "amplitudes_deg must be numbers, got 'x'"),
        ({"motion": {"amplitudes": [1, 2]}}, r"amplitudes must have more values, got \[1, 2\]"),
        ({"motion": {"amplitudes": [300, 0, 0]}}, "must stay inside the 480 x 640 px frame, got x = "),
        ({"motion": []}, r"\[motion\] must be a table of settings"),
        ({"light": [{"kind": "sun"}]}, "kind must be one of gradient, spot, vignette, drift, image, got 'sun'"),
        ({"light": 5}, r"\[light\] must be a table or an array of tables, got 5"),
        ({"light": {"kind": "spot", "spread": -1}}, "spread must be > 0, got -1.0"),
        ({"camera": {"noise_variance": -0.1}}, "variance must be >= 0, got -0.1"),
        ({"camera": {"noise_variance": "x"}}, "noise_variance must be a number, got 'x'"),
        ({"camera": {"noise_variance": 0.1, "noise_sigma": 1}}, "give noise_sigma or noise_variance, got both"),
        ({"camera": {"noise": 1}}, r"\[camera\]: unknown key 'noise' \(did you mean 'noise_sigma'\?\)"),
        ({"camera": {"light": {}}}, r"\[camera\]: unknown key 'light' \(known keys: size, "),
        ({"camera": {"drift": {"gian": 1}}}, r"\[camera\]: drift: unknown key 'gian' \(did you mean 'gain'\?\)"),
        ({"camera": {"lens": {"k3": 1}}}, r"\[camera.lens\]: unknown key 'k3'"),
        ({"camera": {"lens": {"k1": -0.6}}}, r"\[camera.lens\]: the lens is one to one up to 1\d\d px"),
        ({"camera": {"occluders": [{"center": [1, 2]}]}}, r"\[camera\]: occluders\[0\]: missing key 'half_size'"),
        ({"camera": {"drift": {"x": 1}}}, r"drift: unknown key 'x' \(known keys: gain, offset, period\)"),
        ({"camera": {"drift": {"period": 0}}}, r"\[camera\]: drift: Drift: period must be"),
        ({"camera": {"size": [480]}}, r"\[camera\]: size must have more values, got \[480\]"),
        ({"camera": {"bits": True}}, "bits must be a valid integer, got True"),
        ({"camera": 3}, r"\[camera\] must be a table of settings, got 3"),
        ({"template": {"size": 700}}, "the 700 x 700 px template 0 must stay inside"),
        ({"template": {"size": [0, 5]}}, "Template: size must be"),
        ({"template": {"center": [30, 30]}}, "must stay inside"),
        ({"seed": -1}, "seed must be an integer >= 0, got -1"),
    ],
)
def test_wrong_configurations_are_refused_before_any_rendering(config, message, monkeypatch, tmp_path):
    monkeypatch.setattr(Camera, "capture", lambda *_, **__: pytest.fail("rendered"))
    with pytest.raises(ValueError, match=message):
        from_config(config, folder=tmp_path)
