"""Laws of the template pyramid: a coarse level alone tells the full one's pose, exactly halved."""

from __future__ import annotations

import pytest
import torch

from torch_ecc import Status, align, prepare
from torch_ecc.core.pyramid import pyramid
from torch_ecc.search.locate import image_pyramid
from torch_ecc.sim import Camera, PlaneWaves

SCENE, SIZE = PlaneWaves.random(count=60, fmax=0.06, rms_gradient=2.0, spectrum="fine"), (200, 260)
POSE = torch.tensor([[131.3, 96.8, 0.7]], dtype=torch.float64)


@pytest.mark.parametrize("centre", [(0.0, 0.0), (6.25, -9.5)])
@pytest.mark.parametrize("size", [(81, 81), (80, 96), (97, 78)], ids=str)
@pytest.mark.parametrize("masked", [False, True])
def test_a_coarse_level_finds_the_pose_of_its_own_scale(size, centre, masked):
    """Pixel (i, j) of level l lies at (2^l i, 2^l j), and so does the point that poses speak of.

    A tenth of a coarse px: the blur mirrors the template at its border, where the frame goes on.
    """
    h, w = size
    middle = torch.tensor([[(w - 1) / 2, (h - 1) / 2, 0.0]], dtype=torch.float64)
    shift = torch.tensor([[*centre, 0.0]], dtype=torch.float64)
    template = Camera(size=size).capture(SCENE, middle + shift, seed=0)  # the scene's origin is at the centre
    mask = torch.ones(size, dtype=torch.bool)
    mask[:17, 40:] = not masked
    references = pyramid(prepare(template, mask=mask, centre=shift[:, :2].float()), 3)
    images = image_pyramid(Camera(size=SIZE).capture(SCENE, POSE, seed=1).float(), 3)
    assert len(references) == 3
    for level, (reference, image) in enumerate(zip(references, images, strict=True)):
        scale = POSE.new_tensor((2.0**level, 2.0**level, 1.0))
        found = align(reference, image, POSE / scale + POSE.new_tensor((0.4, -0.3, 0.01)))
        assert found.status == Status.CONVERGED
        assert (found.pose - POSE / scale)[0, :2].abs().max() < 0.1
        assert (found.pose - POSE / scale)[0, 2].abs() < 6e-3
