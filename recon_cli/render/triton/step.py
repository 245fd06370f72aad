"""Loss and gradients of one training view without autograd and without waiting for the device.

How many instances a view has is known on the device alone, so buffers have room for more than are
likely. A step that needs more is stopped there, with all that follow it, until the host looks at
the `StepStatus`, makes room and takes them again: no result depends on the room. On CUDA the
launches of a step are recorded once its sizes have come up before, and replayed as a graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.contract import Statistics, StepOptions, TargetDepth, TargetImage
from recon_cli.render.depth_loss import depth_loss_gradient
from recon_cli.render.response import Response, ResponseTensors
from recon_cli.render.triton.cuda_graphs import Graphs
from recon_cli.render.triton.gaussian import camera_buffer
from recon_cli.render.triton.loss import loss_and_gradient
from recon_cli.render.triton.passes import (
    BackwardOptions,
    ViewInput,
    build_tile_lists,
    composite_tiles,
    composite_tiles_backward,
    project_splats,
    project_splats_backward,
)
from recon_cli.render.triton.step_status import StepReport, StepStatus, admit_step, record_step
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

_FIRST_ROOM = 2  # instances a Gaussian; a room has 2 to 5 of each that is in view
_LEAST_ROOM = 1 << 10
_SPARE = 1.5  # times the most that was needed so far
_FULL = 0.8  # of the room, from which more is made before it runs out
_CAMERAS = 4096  # whose buffers stay on the device
_PHOTOGRAPHS = 0.125  # of its memory, for photographs that stay there


@dataclass(frozen=True, eq=False)
class _DeviceTarget:
    """A `TargetImage` on the device; the mask as uint8."""

    pixels: Tensor
    mask: Tensor | None
    response: Response | None
    depth: Tensor | None


class PhotometricStep:
    """Renders views over the backdrop, compares them with their photographs, and goes back.

    `graphs` None takes what suits the device, `room` None a likely number of instances at first.
    """

    def __init__(
        self, device: torch.device, *, graphs: Graphs | None = None, room: int | None = None
    ) -> None:
        self._graphs = Graphs.for_device(device) if graphs is None else graphs
        self._room, self.status, self._most = room or 0, StepStatus(device), 0
        self._cameras: dict[int, tuple[Camera, Tensor]] = {}
        # of the last view, overwritten by each call; all zero where the view does not count
        self.statistics = Statistics.zeros(torch.zeros(0, 3, device=device))
        # [1] 0 where the last view does not count: stopped, no Gaussian seen, or loss not finite
        self.counted, self._fits = (
            torch.zeros(1, dtype=torch.int32, device=device) for _ in range(2))
        self._background, self._shown = torch.zeros(3, device=device), (0.0, 0.0, 0.0)
        self._view = torch.zeros(25, dtype=torch.float64, device=device)
        self._pixels: dict[tuple[object, ...], Tensor] = {}
        self._depth_factor = torch.zeros((), device=device)  # in the same memory, as above
        self._photographs: dict[int, tuple[NDArray[Any], Tensor]] = {}
        self._room_for_photographs = 0 if device.type == "cpu" else int(
            _PHOTOGRAPHS * torch.cuda.get_device_properties(device).total_memory)
        # of the last view that had a response; reading it waits for the device
        self.response_tensors: ResponseTensors | None = None

    def __call__(
        self, splats: Splats, gradients: Splats, camera: Camera, target: TargetImage,
        options: StepOptions,
    ) -> None:
        """Starts the work on one view: the gradients of its loss overwrite `gradients`.

        They are zero where the view does not count. A masked pixel counts as one without error, and
        gets no gradient.

        Args:
            splats: N Gaussians, float32, contiguous; in the same memory from call to call.
            gradients: of the same shapes; sh_rest is left alone at degree 0 and without
                `harmonics`.
            camera: of the view.
            target: the photograph, in memory from which the device can read.
            options: scores count even where the loss is not finite.
        """
        if len(self.statistics.radii) != len(splats):
            self.statistics = Statistics.zeros(splats.means.detach())
            self._graphs.forget()  # recorded for other sizes
        if not self._room:
            self._room = max(_LEAST_ROOM, _FIRST_ROOM * len(splats))
        self._view.copy_(self._camera_buffer(camera))
        color = (0.0, 0.0, 0.0) if splats.backdrop is None else splats.backdrop.color
        if color != self._shown:  # in the same memory, which graphs read
            self._background.copy_(torch.tensor(color))
            self._shown = color
        photograph = self._upload(target)
        noise = None if target.depth is None else target.depth.noise
        terms = TERMS[min(options.sh_degree, splats.sh_degree)]
        work = self._work(
            ViewInput(splats, self._view, terms), gradients, camera, photograph, options,
            noise)
        places = (tensor.data_ptr() for parameters in (splats, gradients)
                  for tensor in parameters.parameters().values())
        key = (*places, len(splats), splats.sh_rest.shape, camera.width, camera.height,
               target.mask is None, noise, options.sh_degree, options.ssim_weight, options.details,
               options.harmonics, self._room)
        if target.response is None and not options.scores and not options.loo:
            self._graphs.run(key, work)
        else:
            work()

    def close(self) -> StepReport:
        """Waits for the device and returns the results of the steps since the last call.

        Where one was stopped there is room for it from now on.
        """
        report = self.status.close()
        self._most = max(self._most, report.needed)
        enough = max(_LEAST_ROOM, int(_SPARE * self._most))
        if self._most > _FULL * self._room or self._room > _SPARE * enough:
            self._room = enough
            self._graphs.forget()
        return report

    def _camera_buffer(self, camera: Camera) -> Tensor:
        """Returns the buffer of a camera on the device, where it stays."""
        known = self._cameras.get(id(camera))
        if known is None:
            if len(self._cameras) >= _CAMERAS:
                self._cameras.clear()
            # with the camera itself: its id is its own as long as it lives
            known = camera, camera_buffer(camera, self._view.device)
            self._cameras[id(camera)] = known
        return known[1]

    def _upload(self, target: TargetImage) -> _DeviceTarget:
        mask = target.mask
        return _DeviceTarget(
            self._copy_to_device("pixels", target.pixels),
            None if mask is None else self._copy_to_device("mask", mask),
            target.response,
            None if target.depth is None else self._upload_depth(target.depth))

    def _upload_depth(self, target: TargetDepth) -> Tensor:
        """Returns the depths [H, W] in the same memory each time, and sets the factor."""
        key = ("depth", *target.depths.shape)
        if key not in self._pixels:
            self._pixels[key] = torch.empty(target.depths.shape, device=self._view.device)
        self._depth_factor.fill_(target.factor)
        return self._pixels[key].copy_(torch.from_numpy(target.depths))

    def _copy_to_device(self, name: str, source: NDArray[Any]) -> Tensor:
        """Returns the device's own copy of a host array, in the same memory each time."""
        key = (name, *source.shape)
        if key not in self._pixels:
            self._pixels[key] = torch.empty(
                source.shape, dtype=torch.uint8, device=self._view.device)
        self._pixels[key].copy_(self._photograph(source), non_blocking=True)
        return self._pixels[key]

    def _photograph(self, source: NDArray[Any]) -> Tensor:
        """Returns an array on the device, where it stays, or on the host if it does not fit."""
        known = self._photographs.get(id(source))
        if known is not None and known[0] is source:
            return known[1]
        tensor = torch.from_numpy(source.view(np.uint8))
        if source.nbytes > self._room_for_photographs:
            return tensor
        self._room_for_photographs -= source.nbytes
        tensor = tensor.to(self._view.device, non_blocking=True)
        # with the array itself: its id is its own as long as it lives
        self._photographs[id(source)] = source, tensor
        return tensor

    def _work(
        self, source: ViewInput, gradients: Splats, camera: Camera, target: _DeviceTarget,
        options: StepOptions, noise: float | None,
    ) -> Callable[[], None]:
        """Returns the work on views of this size; it reads the values that differ among them."""
        room, statistics = self._room, self.statistics
        plain = noise is None
        backward = BackwardOptions(
            plain=plain, details=options.details, loo=options.loo, harmonics=options.harmonics)
        scores = statistics if options.scores else None

        def work() -> None:
            projected = project_splats(source)
            starts = admit_step(projected.ends, room, self.status, self._fits)
            lists = build_tile_lists(projected, starts, camera, self._view, room)
            image = composite_tiles(
                lists, camera, self._background, target.mask, scores, keep=True,
                plain=plain)
            rgb, response = image.rgb, None
            if target.response is not None:
                response = ResponseTensors(target.response, camera, rgb)
                shown = rgb.detach().requires_grad_()
                with torch.enable_grad():
                    photograph = response.apply(shown)
                rgb = photograph.detach()
            loss, grad_rgb = loss_and_gradient(rgb, target.pixels, options.ssim_weight, target.mask)
            if response is not None:
                photograph.backward(grad_rgb)
                assert shown.grad is not None
                grad_rgb, self.response_tensors = shown.grad, response
            grad_depth = grad_alpha = None
            if noise is not None and target.depth is not None:
                off, grad_depth, grad_alpha = depth_loss_gradient(
                    image.depth, image.alpha, target.depth, noise, self._depth_factor)
                loss = loss + off
            record_step(projected.ends, room, loss, self._fits, self.status, self.counted)
            sums = composite_tiles_backward(
                lists, image, self._background, target.mask, backward, grad_rgb, grad_alpha,
                grad_depth)
            project_splats_backward(
                source, lists, sums, backward, gradients, statistics, counted=self.counted)
            torch.mul(projected.radii, self.counted, out=statistics.radii)

        return work
