"""The peers of torch_ecc, each at the best settings that were found for the standard work (README.md)."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import torch
from adapters import Align, Image, Peer, aligned
from kornia.geometry.conversions import denormalize_homography
from kornia.geometry.transform import HomographyWarper, ImageRegistrator, Similarity
from torch import Tensor

BESIDE = 20  # px that the square given to a peer is wider than the template on every side


def opencv_ecc(epsilon: float, gauss: int) -> Align:
    """cv2.findTransformECC with its own blur of ``gauss`` px; ``epsilon``: least gain of the correlation."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, epsilon)

    def align(template: Image, image: Image, warp: Image) -> Image:
        start = warp.astype(np.float32)
        return cv2.findTransformECC(template, image, start, cv2.MOTION_EUCLIDEAN, criteria, None, gauss)[1]

    return align


def opencv_multiscale() -> Align:
    """cv2.findTransformECCMultiScale (OpenCV 5) at its own settings but for the motion."""
    parameters = cv2.ECCParameters()
    parameters.motionType = cv2.MOTION_EUCLIDEAN
    return lambda t, image, warp: cv2.findTransformECCMultiScale(t, image, warp.astype(np.float32), parameters)[1]


class Rigid(Similarity):
    """kornia's similarity without scale, that starts from the angle it found last."""

    def __init__(self) -> None:
        super().__init__(rotation=True, scale=False, shift=True)

    def reset_model(self) -> None:
        """Called by ``register``."""
        torch.nn.init.zeros_(self.shift)


def kornia_registrator() -> Align:
    """ImageRegistrator with Rprop instead of Adam, squared differences, and the template's surroundings left out."""
    options: dict[str, Any] = {"pyramid_levels": 2, "num_iterations": 40, "tolerance": 0.0, "lr": 1e-3}
    registrator = ImageRegistrator(Rigid(), torch.optim.Rprop, warper=HomographyWarper, **options)

    def align(template: Image, image: Image, warp: Image) -> Image:
        registrator.loss_fn = partial(_inner_squares, edge=BESIDE / template.shape[0])
        target, source = (torch.from_numpy(i / np.float32(255))[None, None] for i in (template, image))
        found, size = registrator.register(source, target).detach().double(), template.shape
        return denormalize_homography(found, size, size, align_corners=False)[0, :2].numpy()

    return align


def _inner_squares(warped: Tensor, target: Tensor, reduction: str, edge: float) -> Tensor:
    """Squared differences (kornia's ``reduction`` is always none) but for a share ``edge`` of the side all round."""
    h, w = target.shape[-2:]
    inner, n = torch.zeros_like(target), round(edge * h)
    inner[..., n : h - n, n : w - n] = 1.0
    return (warped - target).square() * inner


def stackreg() -> Align:
    """pystackreg's TurboReg, rigid body; it starts from no motion within the square around the last pose."""
    from pystackreg import StackReg

    register = StackReg(StackReg.RIGID_BODY).register
    return lambda template, image, warp: register(template, image)[:2]


def simpleitk() -> Align:
    """SimpleITK: correlation, B-spline interpolation, regular step gradient descent."""
    import SimpleITK as sitk  # noqa: N813

    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsCorrelation()
    method.SetInterpolator(sitk.sitkBSpline)
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-4, 100, gradientMagnitudeTolerance=1e-9)
    method.SetOptimizerScalesFromPhysicalShift()

    def align(template: Image, image: Image, warp: Image) -> Image:
        fixed, moving = (sitk.GetImageFromArray(i.astype(np.float32)) for i in (template, image))
        middle = (np.array(template.shape[::-1]) - 1) / 2
        turn, shift = warp[:, :2], warp[:, 2]
        angle = float(np.arctan2(turn[1, 0], turn[0, 0]))
        motion = sitk.Euler2DTransform(middle.tolist(), angle, (turn @ middle + shift - middle).tolist())
        method.SetInitialTransform(motion, inPlace=True)
        method.Execute(fixed, moving)
        turn = np.array(motion.GetMatrix()).reshape(2, 2)
        return np.column_stack((turn, middle + motion.GetTranslation() - turn @ middle))

    return align


def rivals() -> dict[str, Peer]:
    """All that are installed. The slow ones are run on the first frames of a sequence only."""
    found = {
        "OpenCV ECC, shipped": Peer(aligned(lambda: opencv_ecc(1e-3, 5), reach=None), "OpenCV"),
        "OpenCV ECC, fastest fair": Peer(aligned(lambda: opencv_ecc(1e-4, 1), reach=BESIDE, blur=True), "OpenCV"),
    }
    if hasattr(cv2, "findTransformECCMultiScale"):
        found["OpenCV ECC, multi-scale"] = Peer(aligned(opencv_multiscale, reach=BESIDE), "OpenCV")
    if find_spec("pystackreg"):
        found["pystackreg, rigid"] = Peer(aligned(stackreg, reach=0), "pystackreg")
    if find_spec("SimpleITK"):
        found["SimpleITK, B-spline"] = Peer(aligned(simpleitk, reach=BESIDE), "SimpleITK", frames=15)
    registrator = aligned(kornia_registrator, reach=BESIDE, surround=BESIDE)
    return found | {"kornia ImageRegistrator": Peer(registrator, "kornia", frames=10)}
