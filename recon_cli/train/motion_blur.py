"""Steps on blurred views: the mean of what the camera saw on its way is what the photograph shows.

A sensor adds up linear light while the shutter is open, and a photograph holds its root (a power of
1/2.2, as about in sRGB). A render that is blurred in the same way needs no blurred scene:

    y = (mean_k x_k^2.2)^(1/2.2)   of the renders x_k of cameras along the way

(as Wang et al. 2023 for fields and Zhao et al. 2024 for Gaussians, who also fit the ways; here they
follow from the cameras before and after, and one shutter time for the capture.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from recon_cli.errors import ConfigError
from recon_cli.evaluation.metrics import corrected_psnr
from recon_cli.render import Statistics, render
from recon_cli.render.contract import StepOptions
from recon_cli.render.response import Response, ResponseGradient, ResponseTensors
from recon_cli.scene.camera import Camera
from recon_cli.scene.motion import Motion
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.background import project_points
from recon_cli.train.gradient import GradientStep, photometric_loss
from recon_cli.train.optimizer import SplatOptimizer
from recon_cli.train.shutter import ViewMotions, median_speed
from recon_cli.train.task import Task

_GAMMA = 2.2
_LIFT = 1 / 255  # added while light is summed: the slope of the root has no end at black
_LEAST = 1.0  # pixels of blur; less is within the width of an edge
_FEWEST, _MOST = 3, 5  # cameras along a way
# Of views that leave training: times the median blur, and pixels; and how many views of the median
# blur or less must show how much of their points
_MUCH, _SHARP_VIEWS, _SHOWN = 3.0, 3, 0.95
_POINTS = 4000  # looked at for that
_APART = 3.0  # pixels from one to the next, if that many are enough


def mean_light(images: Sequence[Tensor]) -> Tensor:
    """Returns the photograph of all of some images [H, W, 3] together."""
    linear = [(image + _LIFT).pow(_GAMMA) for image in images]
    return torch.stack(linear).mean(0).pow(1 / _GAMMA) - _LIFT


def cameras_along(
    camera: Camera, motion: Motion | None, seconds: float, pixels_per_second: float
) -> list[Camera]:
    """Returns cameras along the way of an exposure, the middle one first; one where it is short."""
    blur = seconds * pixels_per_second
    if motion is None or blur < _LEAST:
        return [camera]
    count = _FEWEST if blur <= _APART * _FEWEST else _MOST
    shares = (np.arange(count) + 0.5) / count - 0.5
    return [motion.at(camera, seconds * share) for share in sorted(shares, key=abs)]


def _blur_of(task: Task) -> tuple[ViewMotions, float]:
    """Returns the motions and the shutter time of a task whose blur is on.

    Raises:
        ConfigError: one of them is not known.
    """
    seconds = task.schedule.config.shutter
    if task.motions is None or not any((*task.motions.train, *task.motions.validation)):
        raise ConfigError(
            "blur is on, but the frames have no times, or none has a neighbour within a second: "
            "how the camera moved is not known.", hint="Leave out --blur on.")
    if seconds is None:
        raise ConfigError(
            "blur is on, but the frames do not show for how long the shutter was open.",
            hint="Give --shutter 0.02, if it was open for a fiftieth of a second, or leave out "
            "--blur on.")
    return task.motions, seconds


def turn_chances(task: Task) -> Tensor:
    """Returns the chance [F] of each training view to have a turn in an epoch with blur.

    1 for views of the median blur or less; others have the fewer turns, the more pixels they are
    blurred by. One that is much more blurred has none if sharp views show what it shows.
    """
    motions, seconds = _blur_of(task)
    pixels = np.array([
        0.0 if motion is None else seconds * median_speed(view.camera, motion, motions.points)
        for view, motion in zip(task.train, motions.train, strict=True)])
    chances = np.minimum(1.0, (1 + np.median(pixels)) / (1 + pixels))
    chosen = motions.points[:: max(1, len(motions.points) // _POINTS)]
    shown = np.zeros((len(pixels), len(chosen)), bool)
    for seen, view in zip(shown, task.train, strict=True):
        seen[project_points(view.camera, chosen)[0]] = True
    known = shown[chances == 1].sum(axis=0) >= _SHARP_VIEWS
    for row in np.flatnonzero(pixels > max(_MUCH * float(np.median(pixels)), _MUCH)):
        if shown[row].any() and known[shown[row]].mean() >= _SHOWN:
            chances[row] = 0.0
    return torch.from_numpy(chances)


class BlurredSteps:
    """Chooses for each step of a run how its view is compared: as it is, or blurred."""

    def __init__(self, task: Task, plain: GradientStep) -> None:
        self._schedule = task.schedule
        self._blur = _blur_of(task) if task.schedule.config.blur == "on" else None
        self._blurred = _BlurredStep(task.backend, plain)
        self._speeds: dict[int, float] = {}  # pixels/s at the width of 1
        self._chances = None if self._blur is None else turn_chances(task)

    def draw(self, order: Tensor, generator: torch.Generator, iteration: int) -> Tensor:
        """Returns which views have a turn in an epoch that begins with this step, of an order."""
        if self._chances is None or not self._schedule.blurs(iteration):
            return order
        drawn = torch.rand(len(order), generator=generator, dtype=torch.float64)
        return order[drawn < self._chances[order]]

    def choose(self, view: TrainView, index: int, iteration: int) -> GradientStep | None:
        """Returns the step for a training view by its index; None where it is compared as it is."""
        if self._blur is None or not self._schedule.blurs(iteration):
            return None
        (motions, seconds), motion = self._blur, self._blur[0].train[index]
        if motion is None:
            return None
        if index not in self._speeds:
            speed = median_speed(view.camera, motion, motions.points)
            self._speeds[index] = speed / view.camera.width
        cameras = cameras_along(
            view.camera, motion, seconds, self._speeds[index] * view.camera.width)
        if len(cameras) == 1:
            return None
        self._blurred.cameras = cameras
        return self._blurred


class _BlurredStep:
    """Leaves the gradients of a blurred view in an optimizer, with any backend."""

    def __init__(self, backend: str, plain: GradientStep) -> None:
        self._backend, self._plain = backend, plain
        self.cameras: list[Camera] = []  # of the next view
        self.response_gradient = ResponseGradient.zeros()

    def __call__(
        self, optimizer: SplatOptimizer, view: TrainView, options: StepOptions,
        response: Response | None = None,
    ) -> tuple[float, Statistics | None]:
        # scores are of single renders
        scored = self._plain(optimizer, view, options, response)[1] if (
            options.scores or options.loo) else None
        optimizer.discard()
        splats, device = optimizer.splats, optimizer.splats.means.device
        outputs = [render(splats, camera, splats.background, options.sh_degree,
                          backend=self._backend) for camera in self.cameras]
        image = mean_light([output.rgb for output in outputs])
        tensors = None if response is None else ResponseTensors(response, view.camera, image)
        if tensors is not None:
            image = tensors.apply(image)
        loss = photometric_loss(
            image, view.pixels(device), options.ssim_weight, mask=view.counting(device))
        value = float(loss.detach())
        if not (loss.requires_grad and any(
                bool(output.statistics.radii.any()) for output in outputs)):
            return value, None
        if np.isfinite(value):
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.take_gradients()
            if tensors is not None:
                self.response_gradient = tensors.gradient()
        return value, scored or _join([output.statistics for output in outputs])


def _join(statistics: Sequence[Statistics]) -> Statistics:
    """Returns the statistics of the middle render, with the mean variance of all."""
    first = statistics[0]
    first.variance = torch.stack([each.variance for each in statistics]).mean(0)
    return first


def blurred_psnr(splats: Splats, view: TrainView, motion: Motion, task: Task) -> float:
    """Returns the PSNR in dB, after the best gain of each channel, of a render blurred as the view.

    `task` is that of the splats.
    """
    config = task.schedule.config
    motions, seconds = _blur_of(task)
    cameras = cameras_along(
        view.camera, motion, seconds, median_speed(view.camera, motion, motions.points))
    with torch.no_grad():
        image = mean_light([render(
            splats, camera, splats.background, config.sh_degree, backend=task.backend).rgb
            for camera in cameras])
    return corrected_psnr(image.cpu().numpy(), view.image, view.mask)
