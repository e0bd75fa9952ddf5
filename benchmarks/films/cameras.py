"""What stays with the camera while the target moves, and noise that is not white."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from films.disturbed import jpeg
from films.shot import NOISE, Film, Shot, each, sense
from torch_ecc.paper.bound import rounding
from torch_ecc.sim import PlaneWaves
from torch_ecc.sim.camera import optics, sensor
from torch_ecc.sim.camera.sensor import WHITE

BLACK = 12.0  # grey levels of what shuts out the light


def around(shot: Shot) -> tuple[Tensor, Tensor]:
    """x (w,) and y (h, 1) from the middle of the motion, px."""
    x, y = (torch.arange(n) - c for n, c in zip(shot.frame[::-1], shot.path[:, :2].mean(0).tolist(), strict=True))
    return x, y[:, None]


def shut(shot: Shot, opacity: Tensor, known: str = "") -> Film:
    """BLACK by an ``opacity`` (h, w) that stays with the camera; ``known``: whether the tracker is "told" where,
    or is to "find" it."""
    image = torch.lerp(shot.clean, torch.tensor(BLACK), opacity.float())
    options = {"": {}, "told": {"frame_mask": opacity == 0}, "find": {"frame_mask": "find"}}[known]
    return shot.film(image, (opacity > 0.05).expand_as(image), options=options)


def aperture(shot: Shot, known: str = "") -> Film:
    """A round field of view that cuts the template's corners."""
    return shut(shot, (torch.hypot(*around(shot)) - 0.58 * shot.size).clamp(0, 1), known)


def stripe(shot: Shot, opacity: float = 1.0, known: str = "") -> Film:
    """A dark stripe of 8 px, slanted by 10 deg."""
    x, y = around(shot)
    return shut(shot, opacity * (4.5 - (x + math.tan(math.radians(10)) * y - 12).abs()).clamp(0, 1), known)


def dust(shot: Shot, opacity: float = 1.0, grains: int = 10, known: str = "") -> Film:
    """Dark grains of 2 to 5 px on the sensor."""
    x, y = around(shot)
    u = torch.rand(grains, 3, generator=torch.Generator().manual_seed(shot.seed)) - 0.5
    off = [3.5 + 3 * r - torch.hypot(x - shot.size * a, y - shot.size * b) for a, b, r in u.tolist()]
    return shut(shot, opacity * torch.stack(off).amax(0).clamp(0, 1), known)


def coded(shot: Shot, one: Callable[[Shot], Film], quality: int = 70) -> Film:
    """The frames of another film as a coder leaves them."""
    film = one(shot)
    return film._replace(frames=jpeg(film.frames, quality))


def drifting(shot: Shot, one: Callable[[Shot], Film], step: float = 0.05) -> Film:
    """Another film of the same scene, which drifts by ``step`` px a frame."""
    time = torch.arange(len(shot.path), dtype=shot.path.dtype)
    return one(shot.moved(shot.path[0] - step * time[:, None] * shot.path.new_tensor((1.0, 0.6, 0.0003))))


def fixed_pattern(shot: Shot, sigma: float = 4.0) -> Film:
    """An offset of its own for every pixel, the same in all frames."""
    pattern = sigma * torch.randn(shot.frame, generator=torch.Generator().manual_seed(shot.seed))
    frames = sense(shot.clean + pattern, shot.seed)
    return shot.sensed(frames, None, NOISE**2 + sigma**2 + rounding(8))


def fixed_columns(shot: Shot, sigma: float = 3.0) -> Film:
    """An offset of its own for every column, the same in all frames."""
    offsets = sigma * torch.randn(1, shot.frame[1], generator=torch.Generator().manual_seed(shot.seed))
    return shot.sensed(sense(shot.clean + offsets, shot.seed))


def lined(shot: Shot, across: bool) -> Film:
    """Beside white noise an offset of 2 grey levels for every row, or column where ``across``, drawn in every frame."""
    h, w = shot.frame
    lines = partial(sensor.read, torch.zeros(1, 1, w) if across else torch.zeros(1, h, 1), 2.0)
    image = shot.clean + each(shot.clean, shot.seed + 1, lambda one, source: lines(source))
    return shot.sensed(sense(image, shot.seed))


def soft(shot: Shot, sigma: float = 1.0) -> Film:
    """Noise blurred by a Gaussian, of 2 grey levels after it."""
    reach = optics.margin(sigma, 0.0)
    white = torch.zeros(len(shot.clean), 1, *(n + 2 * reach for n in shot.frame))
    noise = optics.focus(each(white, shot.seed + 1, partial(sensor.read, sigma=2.0)), sigma, 0.0)
    noise *= 2.0 / noise.std()
    return shot.sensed(sensor.quantise(shot.clean + noise, 8))


def noisy_jpeg(shot: Shot, quality: int) -> Film:
    """Noise of 4 grey levels before JPEG."""
    return shot.sensed(jpeg(sense(shot.clean, shot.seed, 4.0), quality))


def white(shot: Shot, sigma: float) -> Film:
    """White noise of ``sigma`` grey levels; of 0 only rounding is left."""
    return shot.film(shot.clean, noise=sigma)


def photons(shot: Shot, peak: float) -> Film:
    """Shot noise of ``peak`` photons at white, and nothing else but rounding."""
    shown = sensor.quantise(each(shot.clean, shot.seed, partial(sensor.shot, full_well=peak)), 8)
    return shot.sensed(shown, None, shot.slopes[0].clamp(min=1) * WHITE / peak + rounding(8))


def dark_photons(shot: Shot, peak: float) -> Film:
    """The same where the darker half of the scene gives no light at all."""
    middle = shot.patch(shot.clean).median()
    image = ((shot.clean - middle) * 1.5).clamp(0, 255)
    shown = sensor.quantise(each(image, shot.seed, partial(sensor.shot, full_well=peak)), 8)
    return shot.sensed(shown)


def dim(shot: Shot, contrast: float, size: int, noise: float = 4.0) -> Film:
    """Wide waves whose standard deviation is ``contrast`` times that of the noise."""
    source = torch.Generator().manual_seed(shot.seed)
    k, a, phase = torch.rand(3, 40, generator=source, dtype=torch.float64)
    k, a = 0.1 + 0.2 * k, math.pi * a
    waves = k[:, None] * torch.stack((a.cos(), a.sin()), -1)
    amplitude = torch.full_like(k, contrast * noise / math.sqrt(20))
    wide = Shot(PlaneWaves(waves, amplitude, math.tau * phase, 110.0), shot.seed, shot.path, size)
    return wide.film(wide.clean, noise=noise)
