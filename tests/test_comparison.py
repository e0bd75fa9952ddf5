"""Laws of comparing two records: known offsets, angles and zeros come back, curves are exact, gaps stay gaps."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from torch_ecc.core.pose import rotation
from torch_ecc.records.curves import fit_circle, fit_ellipse, fit_line
from torch_ecc.records.motion import Motion, check_motion, dwell_errors, nearest_errors
from torch_ecc.records.spline import Curve, spline_slopes
from torch_ecc.records.synchrony import Unknowns, align_records, noise
from torch_ecc.records.whitening import autoregression, whiten

OFFSET, ANGLE, LEVER = 0.337, 0.01, (800.0, -500.0)
NEAR = Unknowns(max_offset_s=0.4)


def ease(u: torch.Tensor) -> torch.Tensor:
    u = u.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def truth(t: torch.Tensor, turn: float = 0.0) -> torch.Tensor:
    """Rest, a line to the rim, an ellipse, the line back: smooth, like a stage; ``turn`` rad there and back."""
    out = ease((t - 0.5) / 0.5) - ease((t - 4.0) / 0.5)
    phase = math.tau * ease((t - 1) / 3)
    return torch.stack((12 * out * phase.cos(), 11.5 * out * phase.sin(), turn * out), -1)


def records(nm: float = 0.0, seed: int = 0, turn: float = 0.0, lever: tuple[float, float] = (0.0, 0.0), late=0.0):
    """A track at 100 Hz of what sensors see at 1024 Hz, on another clock, along other axes, from other zeros."""
    t, s = torch.arange(0, 4.5, 0.01).double(), torch.arange(0, 5, 1 / 1024).double()
    m = truth(t + OFFSET + late, turn)
    m[:, :2] += (rotation(m[:, 2]) - torch.eye(2)) @ torch.tensor(lever).double() - torch.tensor([3.0, -2.0])
    m[:, :2] = m[:, :2] @ rotation(torch.tensor(ANGLE).double())
    scatter = torch.randn(m.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Motion(t, m + scatter * torch.tensor([1e-3, 1e-3, 1e-6]) * nm), Motion(s, truth(s, turn))


def test_without_noise_everything_is_found():
    found = align_records(*records(turn=0.004, lever=LEVER), Unknowns(lever=True, scale=True))
    assert found.converged
    assert abs(found.offset_s - OFFSET) < 1e-8
    assert abs(found.axis_angle - ANGLE) < 1e-8
    assert torch.allclose(found.lever, torch.tensor(LEVER).double(), atol=1e-3)
    assert abs(found.scale - 1) < 1e-8
    assert found.valid.sum() > 440
    assert found.rms[:2].max() < 1e-4


def test_the_scatter_agrees_with_the_covariance():
    found = [align_records(*records(5.0, seed), NEAR) for seed in range(24)]
    truth = torch.tensor([OFFSET, ANGLE], dtype=torch.float64)
    values = torch.tensor([(f.offset_s, f.axis_angle) for f in found], dtype=torch.float64)
    sigma = torch.stack([f.covariance.diagonal()[:2].sqrt() for f in found]).mean(0)
    ratio = (values - truth).square().mean(0).sqrt() / sigma
    assert ((ratio > 0.65) & (ratio < 1.4)).all(), ratio
    rms = torch.stack([f.rms for f in found]).mean(0)
    assert torch.allclose(rms, torch.tensor([5e-3, 5e-3, 5e-6]).double(), rtol=0.05)


def coloured(count: int, g: torch.Generator, keep: float = 0.85) -> torch.Tensor:
    """Errors of 10 nm and urad that cling together over several frames."""
    scatter = torch.randn(count, 3, generator=g, dtype=torch.float64)
    for k in range(1, count):
        scatter[k] = keep * scatter[k - 1] + math.sqrt(1 - keep**2) * scatter[k]
    return 10 * scatter


def disturbed(kind: str, seed: int) -> tuple[Motion, Motion]:
    """The records with one more thing that real ones have."""
    g = torch.Generator().manual_seed(seed)
    track, sensors = records(5.0, seed, turn=2e-3)
    unit, t, s = torch.tensor([1e-3, 1e-3, 1e-6]).double(), track.time_s, sensors.time_s
    random = lambda *size: torch.randn(*size, generator=g, dtype=torch.float64)  # noqa: E731
    if kind == "clinging":
        track.pose.add_(unit * coloured(len(t), g))
    elif kind == "drifting":
        track.pose.add_(unit * 100 * random(3) * (t[:, None] / t[-1] - 0.5))
    elif kind == "shaking":
        track.pose.add_(unit * 20 * (math.tau * 17.3 * t[:, None] + 6 * random(3)).sin())
    elif kind == "uneven":
        times = s + 0.3 / 1024 * (2 * torch.rand(len(s), generator=g).double() - 1)
        sensors = Motion(times, truth(times + 2e-4 * random(len(s)), 2e-3))
    elif kind == "quantised":
        sensors = Motion(s, (sensors.pose / (30 * unit)).round() * 30 * unit)
    elif kind == "jittering":
        late = 1e-3 * random(len(t))
        track = Motion(t, track.pose + (records(0.0, turn=2e-3, late=late)[0].pose - records(turn=2e-3)[0].pose))
    elif kind == "broken":
        track.pose[60:110] = math.nan
        keep = (s < 2.0) | (s > 2.3)
        sensors = Motion(s[keep], sensors.pose[keep])
    return track, sensors


@pytest.mark.parametrize("kind", ["clinging", "drifting", "shaking", "uneven", "quantised", "jittering", "broken"])
def test_sigma_is_honest_whatever_the_errors_are(kind):
    """The plain covariance of independent errors is too small by 3 and more where they cling, drift or jitter."""
    found = [align_records(*disturbed(kind, seed), NEAR) for seed in range(12)]
    assert all(f.converged for f in found)
    pulls = torch.tensor(
        [
            [(f.offset_s - OFFSET) / f.sigma["offset_s"], (f.axis_angle - ANGLE) / f.sigma["axis_angle_rad"]]
            for f in found
        ]
    )
    ratio = pulls.square().mean(0).sqrt()
    assert ((ratio > 0.5) & (ratio < 1.75)).all(), ratio


def test_a_drift_does_not_move_the_clock():
    """Of a drift of 1 um in 4.5 s next to nothing gets into the offset: 0.5 ms do if errors count as independent."""
    track, sensors = records(1.0)
    track.pose.add_(torch.tensor([1.0, -0.7, 3e-4]).double() * track.time_s[:, None] / 4.5)
    assert abs(align_records(track, sensors, NEAR).offset_s - OFFSET) < 1e-4


@pytest.mark.parametrize("apart", [0.0, 25.0, -1500.0, 5e7, 1.7e9])
def test_clocks_may_be_any_time_apart(apart):
    """Also a short track anywhere in a long record; hours, years."""
    track, sensors = records(5.0)
    found = align_records(Motion(track.time_s - apart, track.pose), sensors)
    assert found.offset_s - apart == pytest.approx(OFFSET, abs=1e-4)
    assert found.rival_s is None


@pytest.mark.parametrize("signs", [(1, 1, -1), (1, -1, 1), (1, -1, -1), (-1, 1, 1)])
@pytest.mark.parametrize("turn", [0.0, 1.5, -1.2])
def test_the_sense_of_the_axes_is_found(signs, turn):
    """Also with x and y exchanged; a lever arm turns as the stage does in the image, not as its sensors count."""
    track, sensors = records(5.0, turn=0.004)
    pose, lever = track.pose.clone(), torch.tensor(LEVER).double()
    angle = math.prod(signs) * truth(track.time_s + OFFSET, 0.004)[:, 2]
    arm = (rotation(angle) - torch.eye(2)) @ lever
    pose[:, :2] += arm @ rotation(torch.tensor(ANGLE).double())
    pose[:, :2] = pose[:, :2] @ rotation(torch.tensor(turn).double())
    pose = pose * torch.tensor(signs).double()
    found = align_records(Motion(track.time_s, pose), sensors, Unknowns(signs=None, lever=True, max_offset_s=0.4))
    assert math.prod(found.signs.tolist()) == math.prod(signs)
    assert found.signs[2] == signs[2]
    assert abs(found.offset_s - OFFSET) < 5 * found.sigma["offset_s"] < 1e-3
    assert (
        (found.lever - lever).abs() < 5 * torch.tensor([found.sigma["lever_x_um"], found.sigma["lever_y_um"]])
    ).all()
    assert torch.allclose(found.rms, 5 * torch.tensor([1e-3, 1e-3, 1e-6]).double(), rtol=0.1)


@pytest.mark.parametrize("missing", [(2,), (0, 2), (1, 2), (0, 1)])
def test_components_that_the_sensors_do_not_have(missing):
    """Nothing is asked of them, and the rest is as good as it can be."""
    track, sensors = records(5.0, turn=0.004)
    pose, plane = track.pose.clone(), len(missing) == 1
    if not plane:  # then the axis angle is taken as given
        pose[:, :2] = pose[:, :2] @ rotation(torch.tensor(-ANGLE).double())
    sensors.pose[:, list(missing)] = math.nan
    found = align_records(Motion(track.time_s, pose), sensors, NEAR)
    there = [k for k in range(3) if k not in missing]
    assert found.errors[found.valid][:, missing].isnan().all()
    assert torch.allclose(found.rms[there], (5 * torch.tensor([1e-3, 1e-3, 1e-6]).double())[there], rtol=0.1)
    assert abs(found.offset_s - OFFSET) < 5 * found.sigma["offset_s"]
    assert ("axis_angle_rad" in found.names) == plane


def test_a_motion_that_repeats_itself_has_rivals():
    """And the offset nearest to clocks that agree is taken."""
    t, s = torch.arange(0, 5, 0.01).double(), torch.arange(-10, 20, 1 / 1024).double()
    wave = lambda u: torch.stack(((math.tau * u).sin(), (math.tau * u).cos(), 1e-4 * (math.tau * u).sin()), -1)  # noqa: E731
    scatter = 5e-3 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0)).double()
    scatter[:, 2] *= 1e-3
    found = align_records(Motion(t, wave(t + 0.2) + scatter), Motion(s, wave(s)), Unknowns(angle=False))
    assert math.remainder(found.offset_s - 0.2, 1.0) == pytest.approx(0, abs=1e-3)
    assert abs(found.offset_s) < 2
    assert found.rival_s is not None
    assert math.remainder(found.rival_s - found.offset_s, 1.0) == pytest.approx(0, abs=1e-3)


def test_a_clock_that_is_faster():
    track, sensors = records(5.0)
    middle = float(track.time_s[-1]) / 2
    fast = Motion(middle + (track.time_s - middle) * (1 - 300e-6), track.pose)
    found = align_records(fast, sensors, Unknowns(rate=True, max_offset_s=0.4))
    assert abs(found.rate_ppm - 300) < 4 * found.sigma["rate_ppm"] < 200
    assert torch.allclose(found.at(fast.time_s) - OFFSET, track.time_s, atol=1e-4)


def test_samples_at_the_same_time_are_one():
    """Clocks that tick more slowly than the samples come, and rows that stand twice."""
    track, sensors = records(5.0)
    twice = Motion(sensors.time_s.repeat_interleave(2), sensors.pose.repeat_interleave(2, 0))
    found = align_records(track, twice, NEAR)
    assert found.offset_s == pytest.approx(align_records(track, sensors, NEAR).offset_s, abs=1e-9)


def test_autoregression_and_its_filter():
    """Burg's recursion finds what a series was made with, whitening gives back what it was made from."""
    g = torch.Generator().manual_seed(0)
    innovations = torch.randn(5000, generator=g, dtype=torch.float64)
    series = innovations.clone()
    for k in range(2, 5000):
        series[k] += 1.2 * series[k - 1] - 0.5 * series[k - 2]
    a = autoregression(series)
    exact = torch.tensor([1.2, -0.5], dtype=torch.float64)
    assert torch.allclose(a[:2], exact, atol=0.05)
    assert torch.allclose(whiten(series, exact, 4), innovations[4:], atol=1e-9)
    assert len(autoregression(innovations)) <= 1


@example(0.0390625, 0.3550873852102767, 0.0)  # a step that was small by chance before the weights had settled
@settings(max_examples=6, deadline=None)
@given(st.floats(-0.05, 0.05), st.floats(-0.5, 0.5), st.floats(-50, 50))
def test_clock_axes_and_zero_of_the_track_do_not_matter(later, turn, shift):
    track, sensors = records(5.0)
    pose = track.pose.clone()
    pose[:, :2] = pose[:, :2] @ rotation(torch.tensor(turn).double()) + shift
    moved = align_records(Motion(track.time_s + later, pose), sensors, NEAR)
    found = align_records(track, sensors, NEAR)
    assert moved.offset_s + later == pytest.approx(found.offset_s, abs=1e-7)
    assert moved.axis_angle - turn == pytest.approx(found.axis_angle, abs=1e-6)
    both = moved.valid & found.valid
    assert torch.allclose(moved.errors[both], found.errors[both], atol=1e-6)


def test_on_a_circle_offset_and_angle_do_the_same():
    """And the covariance says so: without the straight parts both are hundreds of times less certain."""
    t, s = torch.arange(0, 3, 0.01).double(), torch.arange(-1, 4, 1 / 1024).double()
    ring = lambda u: torch.stack((12 * u.cos(), 12 * u.sin(), 0 * u), -1)  # noqa: E731
    scatter = 5e-3 * torch.randn(300, 3, generator=torch.Generator().manual_seed(0)).double()
    alone = align_records(Motion(t, ring(t) + scatter), Motion(s, ring(s)), Unknowns(max_offset_s=0.1))
    whole = align_records(*records(5.0))
    assert alone.sigma["axis_angle_rad"] > 100 * whole.sigma["axis_angle_rad"]
    assert alone.rms[0] < 6e-3


def test_a_record_at_rest_tells_no_offset():
    track, sensors = records(1.0)
    scatter = 1e-3 * torch.randn(len(track.time_s), 3, generator=torch.Generator().manual_seed(1)).double()
    found = align_records(Motion(track.time_s, scatter), Motion(sensors.time_s, 0 * sensors.pose))
    assert found.sigma["offset_s"] == math.inf
    assert found.errors[found.valid].isfinite().all()


def test_ringing_does_not_mislead_the_clock():
    """Steps that ring at 240 Hz: one period off, 4.2 ms, fits nearly as well, and a lever arm moves x and y along."""
    lever = torch.tensor([1500.0, -1000.0]).double()
    t, s = torch.arange(0.2137, 3, 0.01).double(), torch.arange(0, 3, 1 / 1024).double()

    def stairs(u: torch.Tensor) -> torch.Tensor:
        since = u[:, None] - torch.arange(0.4, 2.9, 0.2413).double()
        rung = 1 - (-45 * since).exp() * (math.tau * 240 * since).cos()
        up_and_down = 7e-4 * torch.where(torch.arange(since.shape[1]) < 5, 1.0, -1.0)
        theta = torch.where(since > 0, rung, 0.0) @ up_and_down.double()
        return torch.stack((0 * theta, 0 * theta, theta), 1)

    seen = stairs(t)
    seen[:, :2] = (rotation(seen[:, 2]) - torch.eye(2)) @ lever
    seen += torch.tensor([0.02, 0.02, 5e-5]) * torch.randn(seen.shape, generator=torch.Generator().manual_seed(0))
    unknowns = Unknowns(angle=False, lever=True, max_offset_s=0.5)
    found = align_records(Motion(t - t[0], seen), Motion(s, stairs(s)), unknowns)
    assert "axis_angle_rad" not in found.names
    assert found.axis_angle == 0
    assert found.offset_s == pytest.approx(0.2137, abs=2e-4)
    assert ((found.lever - lever).abs() < 20).all()


def test_the_spline_is_exact_on_cubics():
    """At uneven times; what its ends do not know fades inwards."""
    gaps = 0.5 + torch.rand(80, generator=torch.Generator().manual_seed(0)).double()
    t = gaps.cumsum(0) / 80
    slopes = spline_slopes(t, torch.stack((t**3, 1 + t - 2 * t**2), 1))
    assert torch.allclose(slopes[20:-20], torch.stack((3 * t**2, 1 - 4 * t), 1)[20:-20], atol=1e-7)


def test_lost_frames_and_gaps_stay_in_the_result():
    track, sensors = records(1.0)
    track.pose[100:110] = math.nan
    sensors.pose[2500:2600] = math.nan  # 0.1 s
    keep = torch.ones(len(sensors.time_s), dtype=torch.bool)
    keep[3000:3100] = False
    found = align_records(track, Motion(sensors.time_s[keep], sensors.pose[keep]))
    assert len(found.errors) == len(track.time_s)
    assert abs(found.offset_s - OFFSET) < 1e-4
    at = track.time_s + OFFSET
    gone = (at > 2500 / 1024) & (at < 2599 / 1024) | (at > 3000 / 1024) & (at < 3099 / 1024)
    gone[100:110] = True
    assert (~found.valid[gone]).all()
    assert found.valid.sum() >= (~gone).sum() - 8


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_frames_at_the_edges_of_gaps_do_not_keep_it_from_ending(seed, ends):
    """Twenty gaps of 50 ms, which begin, or end, where a frame lies by the offset that is found: so a step of any
    size takes some of these frames in and leaves others out."""
    track, sensors = records(20.0, seed)
    s, found = sensors.time_s, align_records(track, sensors, NEAR)
    for _ in range(3):
        edges = track.time_s[60:440:20] + found.offset_s
        after = (s[:, None] - edges) * (-1 if ends else 1)
        kept = torch.cat((s[~((after > -1e-4) & (after < 0.05)).any(1)], edges)).sort().values
        found = align_records(track, Motion(kept, truth(kept)), NEAR)
    assert found.converged
    assert abs(found.offset_s - OFFSET) < 4 * float(found.covariance[0, 0].sqrt()) < 1e-3


def test_exposure_is_averaged_over():
    """Of a 20 Hz sine, an exposure T leaves sinc(f T)."""
    t, s = torch.arange(0.1, 4, 0.01).double(), torch.arange(0, 5, 1 / 4096).double()
    wave = lambda u: torch.stack(((20 * math.tau * u).sin(), 0 * u, 0 * u), -1)  # noqa: E731
    curve = Curve(Motion(s, wave(s)), 0.008)
    (value, inside), speed = curve(t), curve.speed(t)
    expected = math.sin(math.pi * 0.16) / (math.pi * 0.16)
    assert inside.all()
    assert torch.allclose(value, expected * wave(t), atol=2e-3)
    assert torch.allclose(speed[:, 0], expected * 20 * math.tau * (20 * math.tau * t).cos(), atol=0.3)


def test_the_noise_of_a_smooth_motion():
    track, _ = records()
    slow = track.pose / 100 + 0.02 * torch.randn(450, 3, generator=torch.Generator().manual_seed(0)).double()
    assert torch.allclose(noise(Motion(track.time_s, slow)), torch.tensor(0.02).double(), rtol=0.1)


def test_nearest_point_of_each_group():
    """Brute force over ten sensor samples per frame, the records divided equally."""
    sensors = Motion(torch.arange(400).double() / 1000, torch.randn(400, 3).double())
    track = Motion(torch.arange(40).double() / 100 + 5.0, torch.randn(40, 3).double())
    errors = nearest_errors(track, sensors)
    for k in range(40):
        group = sensors.pose[10 * k : 10 * k + 10]
        nearest = group[(group - track.pose[k])[:, :2].norm(dim=1).argmin()]
        assert torch.equal(errors[k], track.pose[k] - nearest)


def test_nearest_point_with_lost_frames_and_samples():
    sensors = Motion(torch.arange(400).double() / 1000, torch.randn(400, 3).double())
    track = Motion(torch.arange(40).double() / 100, torch.randn(40, 3).double())
    whole = nearest_errors(track, sensors)
    track.pose[7] = math.nan
    sensors.pose[200:210] = math.nan
    keep = torch.arange(40) != 30  # a frame that is missing gives its samples to its neighbours
    errors = nearest_errors(Motion(track.time_s[keep], track.pose[keep]), sensors)
    assert errors.isnan().all(1).nonzero()[:, 0].tolist() == [7, 20]
    same = [k for k in range(40) if k not in (7, 20, 29, 30, 31)]
    assert torch.equal(errors[[k - (k > 30) for k in same]], whole[same])


def bad_motions():
    t, pose = torch.arange(10).double(), torch.zeros(10, 3).double()
    swapped, broken, lost = t.clone(), t.clone(), pose.clone()
    swapped[[4, 5]] = swapped[[5, 4]]
    broken[3] = math.nan
    lost[3:] = math.nan
    return [
        (Motion(t, pose[:, :2]), r"name: expected times \(T,\) and poses \(T, 3\), got \(10,\), \(10, 2\)"),
        (Motion(swapped, pose), "name: times must increase, sample 5 at 4.000000 s follows 5.000000 s"),
        (Motion(broken, pose), "name: times must be finite, sample 3 is not"),
        (Motion(t, lost), "name: expected at least 4 samples with a finite pose, got 3 of 10"),
    ]


@pytest.mark.parametrize(("motion", "message"), bad_motions())
def test_bad_records(motion, message):
    with pytest.raises(ValueError, match=message):
        check_motion("name", motion)


def test_records_apart():
    track, sensors = records()
    with pytest.raises(ValueError, match="align: the records do not overlap, see max_offset_s"):
        align_records(Motion(track.time_s + 100, track.pose), sensors, Unknowns(max_offset_s=2.0))


@pytest.mark.parametrize("name", ["exposure_s", "max_offset_s"])
def test_bad_unknowns(name):
    with pytest.raises(ValueError, match=f"{name}: expected a time >= 0 in s, got -1"):
        Unknowns(**{name: -1.0})


@given(st.floats(0.5, 50), st.floats(0.05, 1), st.floats(-1.5, 1.5), st.floats(-100, 100), st.floats(1.5, 6.3))
def test_ellipse_is_exact(major, ratio, angle, shift, arc):
    t = torch.linspace(0, arc, 60, dtype=torch.float64)
    points = torch.stack((major * t.cos(), major * ratio * t.sin()), 1) @ rotation(torch.tensor(-angle).double()).mT
    fit = fit_ellipse(points + shift)
    assert torch.allclose(fit.semi_axes, torch.tensor([major, major * ratio]).double(), rtol=1e-5)
    assert torch.allclose(fit.center, torch.full((2,), shift).double(), atol=1e-4 * major)
    assert fit.residual_rms < 1e-6 * major
    if ratio < 0.99:
        assert math.sin(fit.angle - angle) == pytest.approx(0, abs=1e-3)


@given(st.floats(0.1, 50), st.floats(-100, 100), st.floats(0.5, 6.3))
def test_circle_is_exact(radius, shift, arc):
    t = torch.linspace(0, arc, 40, dtype=torch.float64)
    fit = fit_circle(radius * torch.stack((t.cos(), t.sin()), 1) + shift)
    assert fit.radius == pytest.approx(radius, rel=1e-5)
    assert torch.allclose(fit.center, torch.full((2,), shift).double(), atol=1e-5 * radius)


@given(st.floats(-3.1, 3.1), st.floats(-100, 100))
def test_line_has_the_direction_of_travel(angle, shift):
    t = torch.linspace(0, 5, 30, dtype=torch.float64)[:, None]
    fit = fit_line(t * torch.tensor([math.cos(angle), math.sin(angle)]) + shift)
    assert fit.angle == pytest.approx(angle, abs=1e-6)


def test_sigma_of_a_line():
    t = torch.linspace(0, 12, 100, dtype=torch.float64)
    g = torch.Generator().manual_seed(0)
    lines = [fit_line(torch.stack((t, 0.01 * torch.randn(100, generator=g).double()), 1)) for _ in range(200)]
    scatter = torch.tensor([line.angle for line in lines]).std()
    assert scatter / lines[0].sigma == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("fit", "points", "message"),
    [
        (fit_line, torch.zeros(5, 2), "fit_line: points must not all lie in one place"),
        (fit_line, torch.zeros(2, 2), "fit_line: points must be 3 or more, got 2"),
        (fit_circle, torch.zeros(5, 3), r"fit_circle: points must be finite numbers \(N, 2\), got \(5, 3\)"),
        (fit_circle, torch.arange(10.0)[:, None].expand(-1, 2), "fit_circle: points must not lie on one line"),
        (
            fit_ellipse,
            torch.stack((torch.linspace(-2, 2, 20), torch.linspace(-2, 2, 20) ** 2), 1),
            "fit_ellipse: points must lie around an ellipse",
        ),
    ],
)
def test_bad_points(fit, points, message):
    with pytest.raises(ValueError, match=message):
        fit(points)


def test_dwells():
    """Means, deviations and their standard errors; lost samples and what is between the dwells count nowhere."""
    t = torch.arange(0, 30, 0.01).double()
    level = (t // 3).clamp(max=9)[:, None] * torch.tensor([1.0, 2.0, 1e-3]).double()
    scatter = 0.1 * torch.randn(3000, 3, generator=torch.Generator().manual_seed(0)).double()
    pose = level + scatter
    pose[500] = math.nan
    starts = 3.0 * torch.arange(10).double()
    dwells = dwell_errors(Motion(t, pose), torch.stack((starts + 0.5, starts + 3), 1))
    assert dwells.samples.tolist() == [250, 249, *[250] * 8]
    assert (dwells.step == -1).sum() == 501
    expected = torch.arange(10).double()[:, None] * torch.tensor([1.0, 2.0, 1e-3]).double()
    assert ((dwells.mean - expected).abs() < 4 * dwells.standard_error).all()
    assert dwells.standard_error.mean() == pytest.approx(0.1 / math.sqrt(250), rel=0.05)
    inside = dwells.step >= 0
    assert torch.allclose(dwells.errors[inside], (pose - dwells.mean[dwells.step])[inside])
    assert dwells.errors[~inside].isnan().all()


def test_bad_windows():
    motion = Motion(torch.arange(10).double(), torch.zeros(10, 3).double())
    with pytest.raises(ValueError, match=r"windows_s must be \(K, 2\) with start < end"):
        dwell_errors(motion, torch.tensor([[2.0, 1.0]]))
