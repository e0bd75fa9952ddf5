"""What light, optics, read-out and the target itself do to a picture. Most of it lasts from FIRST to LAST."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import singledispatch

import cv2
import torch
from torch import Tensor

from films.shot import FIRST, LAST, Film, Shot, each, eq11, frames, sense
from torch_ecc.sim import Pads, PlaneWaves, Scene, Speckle, Sum

BAND = 8  # rows of a frame that are read at once
UNKNOWN = math.nan


def flicker(shot: Shot) -> Film:
    """A gain of 0.7 to 1.3 and an offset of up to 20 grey levels, drawn anew in every frame but the first."""
    u = torch.rand(2, len(shot.path), 1, 1, 1, generator=torch.Generator().manual_seed(shot.seed)) - 0.5
    u[:, 0] = 0
    return shot.film(shot.clean * (1 + 0.6 * u[0]) + 40 * u[1])


def blurred(shot: Shot, sigma: float) -> Film:
    """Out of focus for a while."""
    return lasting(shot, shot.taken(blur_sigma=sigma))


def smeared(shot: Shot) -> Film:
    """The shutter stays open all the time; the target is where it is in the middle of the exposure."""
    return lasting(shot, shot.taken(exposure=1.0))


def averaged(shot: Shot, share: float) -> Film:
    """A camera that takes out noise over time: a ``share`` of every picture is the one before, as it was shown."""
    shown = [shot.clean[0]]
    for image in shot.clean[1:]:
        shown.append(torch.lerp(image, shown[-1], share))
    return shot.film(torch.stack(shown))


def gamma(shot: Shot, power: float) -> Film:
    """Grey levels 255 (g / 255)^power for a while."""
    return lasting(shot, 255 * (shot.clean.clamp(0, 255) / 255) ** power)


def specular(shot: Shot) -> Film:
    """A highlight of 12 px that stays with the lamp."""
    x, y = (torch.arange(n) - c for n, c in zip(shot.frame[::-1], shot.path[:, :2].mean(0).tolist(), strict=True))
    spot = 220 * torch.exp(-((x - 15) ** 2 + (y[:, None] - 10) ** 2) / (2 * 12.0**2))
    return shot.film(shot.clean + spot, spot.expand_as(shot.clean) > 20)


def scaled_up(shot: Shot, percent: float) -> Film:
    """Larger for a while, as with another focus."""
    return lasting(shot, Shot(scaled(shot.scene, 1 + percent / 100), shot.seed, shot.path).clean)


def sheared(shot: Shot, percent: float) -> Film:
    """Every row shifted by its distance from the target."""
    slope = torch.tensor((percent / 100, 0.0, 0.0), dtype=torch.float64)
    return lasting(shot, by_rows(shot, lambda k, row: shot.path[k] + (row - shot.path[k, 1]) * slope))


def rolling(shot: Shot) -> Film:
    """Rows are exposed one after the other, in a frame's time; the pose is that when the target's middle row is."""
    h, time = shot.frame[0], frames(len(shot.path))
    image = by_rows(shot, lambda k, row: eq11(time[k] + (row - h / 2) / h))
    path, seen = shot.path, time
    for _ in range(5):
        seen = time + (path[:, 1] - h / 2) / h
        path = eq11(seen)
    return from_rest(shot, image, path)


def interlaced(shot: Shot) -> Film:
    """Odd rows are exposed half a frame after the even ones; the pose is the mean of both, which is not that of the
    time in between: what speeds up by 0.5 px a frame is 0.016 px off it."""
    time = frames(len(shot.path))
    even, odd = eq11(time - 0.25), eq11(time + 0.25)
    image = shot.moved(even).clean
    image[..., 1::2, :] = shot.moved(odd).clean[..., 1::2, :]
    return from_rest(shot, image, (even + odd) / 2)


def compressed(shot: Shot, quality: int) -> Film:
    """JPEG of every frame."""
    return shot.sensed(jpeg(sense(shot.clean, shot.seed), quality))


def salted(shot: Shot, share: float) -> Film:
    """A ``share`` of the pixels of every frame black or white."""
    u = each(shot.clean, shot.seed + 1, lambda one, source: torch.rand(one.shape, generator=source))
    image = torch.where(u < share / 2, 0.0, torch.where(u < share, 255.0, shot.clean))
    return shot.film(image, u < share)


def without_rows(shot: Shot, share: float, same: bool) -> Film:
    """A ``share`` of the rows black: the ``same`` in every frame, or others in each but the first."""
    u = each(shot.clean, shot.seed + 1, lambda one, source: torch.rand(one.shape[-2], generator=source)[None, :, None])
    u = u[:1].expand_as(u) if same else torch.cat((torch.ones_like(u[:1]), u[1:]))
    return shot.film(torch.where(u < share, 0.0, shot.clean), (u < share).expand(shot.clean.shape))


def leaving(shot: Shot, nearest: float) -> Film:
    """To the left until the centre is at ``nearest`` px, and back."""
    swing = 0.5 - 0.5 * (math.tau * frames(len(shot.path)) / len(shot.path)).cos()
    gone = shot.moved(shot.path + torch.stack((swing * (nearest - 340), 0 * swing, 0 * swing), -1))
    return gone.film(gone.clean)


def turning(shot: Shot, degrees: float) -> Film:
    """Eq. (11) and ``degrees`` more in every frame."""
    turned = shot.moved(shot.path + frames(len(shot.path))[:, None] * torch.tensor((0.0, 0.0, math.radians(degrees))))
    return turned.film(turned.clean)


def jumping(shot: Shot, every: int = 8) -> Film:
    """A leap of 20 to 60 px and up to 30 deg in every eighth frame, and darkness in the frame before some of them."""
    source = torch.Generator().manual_seed(shot.seed)
    length, way, turn = torch.rand(3, len(shot.path), generator=source, dtype=torch.float64)
    leap = torch.stack(((20 + 40 * length) * (math.tau * way).cos(), (20 + 40 * length) * (math.tau * way).sin()), -1)
    leap = torch.cat((leap, math.radians(60) * (turn[:, None] - 0.5)), -1)
    leap[torch.arange(len(leap)) % every != 0] = 0
    leap[0] = 0
    path = leap.cumsum(0)
    path[:, :2] = (path[:, :2] + 120).remainder(240) - 120  # stays in the frame
    moved = shot.moved(shot.path + path)
    image, dark = moved.clean, torch.arange(len(leap)) % (2 * every) == every - 1
    return moved.film(
        torch.where(dark[:, None, None, None], 10.0, image), dark[:, None, None, None].expand(image.shape)
    )


def lasting(shot: Shot, image: Tensor) -> Film:
    """The film with the pictures ``image`` from FIRST to LAST; of these nobody knows the bound."""
    film = shot.film(shot.during(image))
    film.bound[FIRST - 1 : LAST - 1] = UNKNOWN
    return film._replace(clear=LAST - 1)


def from_rest(shot: Shot, image: Tensor, path: Tensor) -> Film:
    """The film with the pictures ``image`` and truth ``path`` of all frames but the first, in which nothing moves."""
    film = shot.moved(torch.cat((shot.path[:1], path[1:]))).film(torch.cat((shot.clean[:1], image[1:])))
    return film._replace(clear=len(film.truth))


def by_rows(shot: Shot, pose: Callable[[int, float], Tensor]) -> Tensor:
    """Pictures whose bands of rows see the target at poses of their own, ``pose(frame, row)`` (3,)."""
    image = torch.empty_like(shot.clean)
    for top in range(0, shot.frame[0], BAND):
        poses = torch.stack([pose(k, top + (BAND - 1) / 2) for k in range(len(shot.path))])
        image[..., top : top + BAND, :] = shot.scene.render(
            poses - poses.new_tensor((0.0, top, 0.0)), (BAND, shot.frame[1])
        )
    return image


def jpeg(shown: Tensor, quality: int) -> Tensor:
    """Frames (F, 1, h, w) uint8 through JPEG."""
    options = (cv2.IMWRITE_JPEG_QUALITY, quality)
    files = [cv2.imencode(".jpg", one[0].numpy(), options)[1] for one in shown]
    return torch.stack([torch.from_numpy(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)) for file in files])[:, None]


@singledispatch
def scaled(scene: Scene, factor: float) -> Scene:
    """The same scene ``factor`` times as large about its origin."""
    raise TypeError(f"scaled: no scene of this kind: {type(scene).__name__}")


@scaled.register
def _(scene: PlaneWaves, factor: float) -> Scene:
    return replace(scene, waves=scene.waves / factor)


@scaled.register
def _(scene: Pads, factor: float) -> Scene:
    place = scene.poses.new_tensor((factor, factor, 1.0))
    sizes = scene.half_sizes * factor
    return replace(scene, poses=scene.poses * place, half_sizes=sizes, sigma=scene.sigma * factor)


@scaled.register
def _(scene: Speckle, factor: float) -> Scene:
    return replace(scene, centers=scene.centers * factor, sigmas=scene.sigmas * factor)


@scaled.register
def _(scene: Sum, factor: float) -> Scene:
    return Sum(tuple(scaled(part, factor) for part in scene.parts))
