"""The README's code runs as it stands and says what it says."""

from __future__ import annotations

import re
from pathlib import Path

import torch

import torch_ecc as te
from torch_ecc.sim import Camera, PlaneWaves, Sequence, SequenceDataset, harmonic, placed

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_the_example_runs(capsys):
    names: dict[str, object] = {}
    exec(BLOCKS[0], names)
    assert "The pose is good to the requested tolerance." in capsys.readouterr().out
    path, estimate = names["path"], names["estimate"]
    expected = te.pose.compose(
        path[-1], te.pose.compose(te.pose.inverse(path[0]), torch.tensor([340.0, 260.0, 0.0]).double())
    )
    assert (estimate.pose[0] - expected)[:2].abs().max() < 0.02


def test_the_library_block_runs():
    names: dict[str, object] = {}
    exec(BLOCKS[0], names)
    frames = names["frames"]
    names |= {"templates": frames[:1, None, 200:321, 280:401], "images": frames[1:2, None]}
    names["start"] = torch.tensor([[340.0, 260.0, 0.0]], dtype=torch.float64)
    exec(next(block for block in BLOCKS if "te.align(" in block), names)
    assert names["track"].pose.shape == (30, 1, 3)


def test_the_search_block_runs():
    names: dict[str, object] = {}
    exec(BLOCKS[0], names)
    frames = names["frames"]
    names |= {"templates": frames[:1, None, 200:321, 280:401], "images": frames[1:2, None]}
    names["reference"] = te.prepare(names["templates"])
    exec(next(block for block in BLOCKS if "te.locate" in block), names)
    assert names["found"].status == te.Status.CONVERGED
    assert not names["found"].ambiguous


def test_the_body_block_runs():
    names: dict[str, object] = {}
    exec(BLOCKS[0], names)
    exec(next(block for block in BLOCKS if "te.Body" in block), names)
    assert names["found"].used.all()
    assert names["found"].sigma[0, 2] < 1e-4


def test_the_streams_block_runs():
    """The synthetic datasets, read by workers, into one batch of trackers."""
    paths = [placed(harmonic((4, 3, 0.02 * k), points=6), center=(90 + k, 80)) for k in range(3)]
    scenes = [PlaneWaves.random(seed=seed) for seed in range(3)]
    sequences = [Sequence(scene, path, Camera(size=(150, 180))) for scene, path in zip(scenes, paths, strict=True)]
    names = {"te": te, "torch": torch, "streams": [SequenceDataset(each) for each in sequences]}
    names["centers"] = torch.stack([path[0, :2] for path in paths])
    exec(next(block for block in BLOCKS if "StackDataset" in block), names)
    error = names["estimate"].pose - torch.stack([path[-1] for path in paths])
    error[:, 2] += torch.stack([path[0, 2] for path in paths])
    assert error.abs().max() < 0.02


def test_first_screen():
    """One sentence, one picture, the two commands and an example before anything else."""
    first = README[: README.index("## ")]
    assert "pip install . && torch-ecc demo" in first
    assert 'pip install ".[dev]" && pytest' in first
    assert len([line for line in BLOCKS[0].splitlines() if line.strip()]) <= 12
    picture = re.search(r"!\[.*?\]\((.*?)\)", first).group(1)
    assert (Path(__file__).parents[1] / picture).is_file()


def test_names_and_options_exist():
    for name in re.findall(r"\bte\.([A-Za-z_]+)", README):
        assert hasattr(te, name), name
    import click

    from torch_ecc.cli import app

    options = {o for command in app.commands.values() for p in command.params for o in (*p.opts, *p.secondary_opts)}
    for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL):
        for option in re.findall(r" (--[a-z-]+)", block):
            assert option in options, option
    assert isinstance(app, click.Group)


def test_every_status_is_explained():
    for status in te.Status:
        assert f"`{status.name}`" in README


def test_every_reason_is_explained():
    for reason in te.Reason:
        assert f"`{reason.name}`" in README
