"""Figs. 6 to 11 in their short versions: what they have to show, and that pictures, tables and records are whole."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ecc.paper import body, circles, fig6, fig7, fig8, fig9, fig10, fig11, parasitic, steps
from torch_ecc.paper.acquisition import Bench, ease, zeroed
from torch_ecc.records.motion import Motion
from torch_ecc.sim.scene.micrograph import micrograph
from torch_ecc.sim.scene.window import Window
from torch_ecc.sim.stage.microscope import Microscope

MODULES = (fig6, fig7, fig8, fig9, fig10, fig11)


@pytest.fixture(scope="module")
def outcomes():
    """All six, simulated twice only: once for the circles, once for the steps."""
    calls: list[tuple[int, int]] = []
    found = [module.run(True, lambda done, total: calls.append((done, total))) for module in MODULES]
    assert all(0 < done <= total for done, total in calls)
    assert len(calls) < 1600  # one call per frame, and no frame twice
    return dict(zip((m.__name__.rsplit(".", 1)[1] for m in MODULES), found, strict=True))


@pytest.mark.parametrize("name", ["fig6", "fig7", "fig8", "fig9", "fig10", "fig11"])
def test_every_limit_is_kept(outcomes, name):
    outcome = outcomes[name]
    assert outcome.name == name
    assert [record for record in outcome.records if not record.kept] == []
    assert any(record.tolerance is not None for record in outcome.records)
    assert len(outcome.pictures) == 1
    assert outcome.pictures[0].figure.axes
    for table in outcome.tables:
        assert {len(row) for row in table.rows} == {len(table.header)}
        assert "nan" not in " ".join(cell for row in table.rows for cell in row)


def test_a_body_beside_the_template(outcomes, monkeypatch):
    """The three figures of it; what the template itself has found instead of a body is as good as the template."""
    found = steps.staircase(True, lambda done, total: None)
    twice = [values | {"body": values["ECC"]} for values in (found.tracks, found.dwells)]
    twin = body.with_truth(found._replace(tracks=twice[0], dwells=twice[1]))
    monkeypatch.setattr(body, "staircase", lambda quick, advance: twin)
    outcome = body.run(True, lambda done, total: None)
    assert [picture.name for picture in outcome.pictures] == ["fig8_body", "fig10_body", "fig11_body"]
    shares = [record.value for record in outcome.records if "over the template" in record.name]
    assert shares == [1.0] * 5
    noise, all_of_it = (body.figures(twin, "ECC")[name] for name in ("rms, less the truth", "Fig. 10: rms"))
    assert noise < 1.05 * all_of_it


def test_a_body_tells_where_the_template_is():
    """The same point as the template's, and nearer to the truth."""
    path = torch.zeros(600, 3, dtype=torch.float64)
    path[:, 2] = 1e-3 * ease(torch.linspace(-1, 1.5, 600))
    got = body.BodyBench(Microscope(region_px=(170, 250), exposure_s=0.0)).acquire(path, lambda: None)
    errors = {name: (track.pose - got.truth.pose).square().mean(0).sqrt() for name, track in got.tracks.items()}
    assert errors["body"][2] < 0.8 * errors["ECC"][2]
    assert (errors["body"][:2] < 0.02).all()  # um
    assert len(body.fields(170, 250)) == 6


def test_the_joint_estimate_keeps_what_the_nearest_points_absorb(outcomes):
    """Known clock and angle leave no less; tracker, lens and sensors together make up the whole."""
    for r in circles.rounds(True, lambda done, total: None):
        assert torch.allclose(r.joint.rms, r.parts["known"], rtol=0.05)
        parts = sum(r.parts[name].square() for name in ("lens", "tracker", "CDS")).sqrt()
        assert torch.allclose(r.parts["known"], parts, rtol=0.1)
        assert abs(r.joint.offset_s - r.acquired.offset_s) < 4 * r.joint.sigma["offset_s"]


def test_parasitic_translation_is_the_lever_arm_times_the_angle(outcomes):
    """By the sensors' angle as by the true one: the tracker's part of sigma stands alone in the second."""
    found = steps.staircase(True, lambda done, total: None)
    left, alone = parasitic.deviations(found), parasitic.true_deviations(found)
    for some in (left, alone):
        assert (some.nm.abs() < 4 * some.sigma).all()
        assert 0.3 < some.chi_square < 2
    assert left.nm.square().mean().sqrt() < 20  # nm, of up to 5 um
    assert alone.nm.square().mean().sqrt() < 3
    lever, spread = parasitic.lever_arm(found, left.covariance)
    assert ((lever - torch.tensor(steps.VIEW_UM).double()).abs() < 3 * spread).all()
    assert (spread < 15).all()


def test_more_frames_do_not_average_out_where_the_template_lies_between_the_pixels(outcomes):
    """The first step is common to all; aliasing stays when the scatter of the frames has gone."""
    found = steps.staircase(True, lambda done, total: None)
    blocks = parasitic.tracked(found).reshape(12, 2, 12, 2)
    assert torch.allclose(blocks[0, :, 5], parasitic.scattered(found)[0].diag())
    ecc = found.dwells["ECC"]
    endless = found._replace(dwells={"ECC": ecc._replace(standard_error=torch.zeros_like(ecc.standard_error))})
    left = parasitic.tracked(endless)
    assert torch.equal(left, torch.block_diag(*parasitic.aliased(found)[1:]))
    assert (left.diagonal().sqrt() > 0.3).all()  # nm


def test_sigma_of_the_steps_and_of_the_lever_arm_over_many_sets_of_sensors(outcomes):
    """One set bends all steps alike: only over many of them are deviations and lever arms what sigma says."""
    found = steps.staircase(True, lambda done, total: None)
    sets, levers = parasitic.other_sensors(found, 400), []
    nm = torch.stack([some.nm for some in sets])
    assert nm[:, :, 1].std(0).allclose(parasitic.sensed(found.dwells["CDS"].mean[1:]).diagonal()[1::2].sqrt(), rtol=0.1)
    assert torch.tensor([some.chi_square for some in sets]).mean() == pytest.approx(1, abs=0.5)
    bent = nm - nm.mean(0)  # what the sensors alone make
    for some in bent:
        dwells = found.dwells | {"ECC": found.dwells["ECC"]._replace(mean=_by_the_law(found, 1e-3 * some))}
        levers.append(parasitic.lever_arm(found._replace(dwells=dwells), sets[0].covariance)[0])
    fits = torch.stack(levers)
    sensors = parasitic.lever_arm(found, parasitic.sensed(found.dwells["CDS"].mean[1:]))[1]
    assert (fits - torch.tensor(steps.VIEW_UM).double()).square().mean(0).sqrt().allclose(sensors, rtol=0.1)


def _by_the_law(found, more):
    """Means (K, 3) of a track that follows the sensors exactly but for ``more`` (K - 1, 2) um."""
    mean = found.dwells["CDS"].mean.clone()
    mean[:, :2] = parasitic.predicted(mean)
    mean[1:, :2] += more
    return mean


def test_commands():
    path = circles.command(8.0, 5.0)
    assert path[:, :2].norm(dim=1).max() == pytest.approx(8.0)
    assert torch.equal(path[0], path[-1])
    assert path.diff(dim=0).norm(dim=1).max() < 0.1  # um per ms: no jumps
    stairs = steps.command(0.4)[:, 2].rad2deg()
    assert stairs.max() == pytest.approx(0.24)
    assert stairs.diff().abs().max() == pytest.approx(0.04)
    assert stairs[-1] == 0
    u = torch.linspace(-1, 2, 301)
    assert ease(u)[0] == 0
    assert ease(u)[-1] == 1
    assert (ease(u).diff() >= 0).all()


def test_portions_of_a_made_up_record():
    """Out, three quarters of a circle, back, seen by both: the angle between their axes comes back."""
    t = torch.linspace(0, 10, 1000, dtype=torch.float64)
    path = circles.command(10.0, 10.0)[:: len(circles.command(10.0, 10.0)) // 1000][:1000]
    sensors = Motion(t, path)
    turned = path.clone()
    c, s = math.cos(0.01), math.sin(0.01)
    turned[:, 0], turned[:, 1] = c * path[:, 0] - s * path[:, 1], s * path[:, 0] + c * path[:, 1]
    assert circles.line_angle(Motion(t, turned), sensors) == pytest.approx(0.01, abs=1e-9)
    rim = circles.portions(sensors)[1]
    assert path[rim, :2].norm(dim=1).min() > 8.9
    assert not rim[0]
    assert not rim[-1]


def test_a_window_shows_the_same_scene():
    """Around the pose as in the whole frame, darkness elsewhere, also at a border."""
    scene = micrograph()
    window = Window(scene, (61, 81))
    poses = torch.tensor([[60.3, 50.7, 0.2], [5.0, 95.0, 0.0]], dtype=torch.float64)
    whole, part = scene.render(poses, (100, 120)), window.render(poses, (100, 120))
    seen = part != 0
    assert seen.sum((1, 2, 3)).tolist() == [61 * 81, 61 * 81]
    assert torch.allclose(part[seen], whole[seen], atol=1e-3)
    assert seen[0, 0, 51, 60]
    with pytest.raises(ValueError, match="Window: size must be"):
        Window(scene, (0, 5))


def test_an_acquisition_says_what_is_lost_and_where_zero_is():
    path = torch.zeros(700, 3, dtype=torch.float64)
    path[:, 0] = 2 * ease(torch.linspace(-1, 1.5, 700))
    got = Bench(Microscope(region_px=(200, 220), exposure_s=0.0)).acquire(path, lambda: None)
    frames = len(got.truth.time_s)
    assert frames == got.tracks["ECC"].pose.shape[0]
    error = (got.tracks["ECC"].pose - got.truth.pose)[:, :2].abs()
    assert error.max() < 5e-3  # um
    assert set(got.seconds) == {"stage", "sensors", "frames", "tracking, ECC"}
    track = got.tracks["ECC"]
    track.pose[3] = math.nan
    rest = zeroed(track, 0.1)
    assert rest.pose[:10].nanmean(0).abs().max() < 1e-9
    assert rest.pose[3].isnan().all()
