"""Loss and gradients of one training view without autograd and without waiting for the device.

How many instances a view has is known on the device alone, so there is room for more than are
likely. A step that needs more is stopped there, with all that follow it, until the host looks
(`ledger`): it makes room and takes them again, so that no result depends on the room there was.

On CUDA the launches of a step are recorded once its sizes have come up before, and played back as a
graph: between two densifications every size stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render.contract import Statistics
from recon_cli.render.triton.cuda_graphs import Graphs
from recon_cli.render.triton.ellipse import view_numbers
from recon_cli.render.triton.loss import loss_and_gradient
from recon_cli.render.triton.passes import Wanted, composited, decomposed, unprojected
from recon_cli.render.triton.step_status import Account, Ledger, admitted, noted
from recon_cli.render.triton.tile_lists import listed, project
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

_FIRST_ROOM = 2  # instances a Gaussian; a room has 2 to 5 of each that is in view
_LEAST_ROOM = 1 << 10
_SPARE = 1.5  # times the most that was needed so far
_FULL = 0.8  # of the room, from which more is made before it runs out
_CAMERAS = 4096  # whose numbers stay on the device


@dataclass(frozen=True, eq=False)
class Photograph:
    """What a view is compared with, in memory from which the device can read.

    Attributes:
        pixels: [H, W, 3] uint8.
        mask: [H, W] bool, True where a pixel counts; None where all do.
        gain: [3] float32, what the rendered channels are multiplied by before; None for ones.
    """

    pixels: Tensor
    mask: Tensor | None = None
    gain: Tensor | None = None


class PhotometricStep:
    """Renders views, compares them with the truth and carries the gradients back.

    Attributes:
        statistics: of the last view; its tensors are written anew by each call. All zero where the
            view came to nothing.
        counted: [1] int32 on the device, zero where the last view came to nothing: its loss was not
            finite, it saw no Gaussian, or it was stopped.
        log_gain_gradient: [3] float64 on the device, of the last view that had a gain.
        ledger: what the device writes down.

    Args:
        device: where everything lies.
        graphs: records launches; None takes what suits the device.
        room: instances that there is memory for at first; None for what is likely to do.
    """

    def __init__(
        self, device: torch.device, *, graphs: Graphs | None = None, room: int | None = None
    ) -> None:
        self._graphs = Graphs.of(device) if graphs is None else graphs
        self._room, self.ledger, self._most = room or 0, Ledger(device), 0
        self._cameras: dict[int, tuple[Camera, Tensor]] = {}
        self.statistics = Statistics.zeros(torch.zeros(0, 3, device=device))
        self.counted, self._fits = (
            torch.zeros(1, dtype=torch.int32, device=device) for _ in range(2))
        self._background = torch.zeros(3, device=device)
        self._view = torch.zeros(25, dtype=torch.float64, device=device)
        self._pixels: dict[tuple[object, ...], Tensor] = {}
        self.log_gain_gradient = torch.zeros(3, dtype=torch.float64, device=device)

    def __call__(
        self, splats: Splats, gradients: Splats, camera: Camera, photograph: Photograph,
        sh_degree: int, ssim_weight: float, *, details: bool = False, scores: bool = False,
        loo: bool = False,
    ) -> None:
        """Starts the work on one view: the gradients of its loss overwrite `gradients`.

        They are zero where the view comes to nothing. A pixel that the mask ignores counts as one
        without error, and gets no gradient.

        Args:
            splats: N Gaussians, float32, contiguous; in the same memory from call to call.
            gradients: tensors of the same shapes; sh_rest is left alone at degree 0.
            camera: of the view.
            photograph: what it is compared with.
            sh_degree: highest in use, as in `recon_cli.render.registry.render`.
            ssim_weight: w in [0, 1].
            details: the statistics absolute_grad and variance are wanted too.
            scores: hits and blend weights too; they count even where the loss is not finite.
            loo: loo too.
        """
        if len(self.statistics.radii) != len(splats):
            self.statistics = Statistics.zeros(splats.means.detach())
            self._graphs.forget()  # recorded for other sizes
        if not self._room:
            self._room = max(_LEAST_ROOM, _FIRST_ROOM * len(splats))
        self._view.copy_(self._numbers(camera))
        truth = self._brought("truth", photograph.pixels)
        mask = photograph.mask
        counting = None if mask is None else self._brought("mask", mask.view(torch.uint8))
        gain = photograph.gain
        work = self._work(
            splats, gradients, camera, truth, counting, gain, min(sh_degree, splats.sh_degree),
            ssim_weight, Wanted(plain=True, details=details, loo=loo), scores=scores)
        places = (tensor.data_ptr() for held in (splats, gradients)
                  for tensor in held.parameters().values())
        key = (*places, len(splats), splats.sh_rest.shape, camera.width, camera.height,
               mask is None, sh_degree, ssim_weight, details, self._room)
        if gain is None and not scores and not loo:
            self._graphs.run(key, work)
        else:
            work()

    def close(self) -> Account:
        """Waits for the device and returns what became of the views since the last look.

        Where one was stopped there is room for it from now on.
        """
        account = self.ledger.close()
        self._most = max(self._most, account.needed)
        enough = max(_LEAST_ROOM, int(_SPARE * self._most))
        if self._most > _FULL * self._room or self._room > _SPARE * enough:
            self._room = enough
            self._graphs.forget()
        return account

    def _numbers(self, camera: Camera) -> Tensor:
        """Returns the numbers of a camera on the device, where they stay."""
        known = self._cameras.get(id(camera))
        if known is None:
            if len(self._cameras) >= _CAMERAS:
                self._cameras.clear()
            # with the camera itself: its id is its own as long as it lives
            known = camera, view_numbers(camera, self._view.device)
            self._cameras[id(camera)] = known
        return known[1]

    def _brought(self, name: str, source: Tensor) -> Tensor:
        """Returns the device's own copy of what lies on the host, in the same place each time."""
        key = (name, *source.shape)
        if key not in self._pixels:
            self._pixels[key] = torch.empty(
                source.shape, dtype=source.dtype, device=self._view.device)
        self._pixels[key].copy_(source, non_blocking=True)
        return self._pixels[key]

    def _work(
        self, splats: Splats, gradients: Splats, camera: Camera, truth: Tensor,
        counting: Tensor | None, gain: Tensor | None, degree: int, ssim_weight: float,
        wanted: Wanted, *, scores: bool,
    ) -> Callable[[], None]:
        """Returns the work on a view of this size; what differs from view to view it reads."""
        terms, room, statistics = TERMS[degree], self._room, self.statistics

        def work() -> None:
            seen = project(splats, self._view, terms)
            starts = admitted(seen.ends, room, self.ledger, self._fits)
            lists = listed(seen, starts, camera, self._view, room)
            made = composited(
                lists, camera, self._background, counting, statistics if scores else None)
            rgb = made.rgb if gain is None else made.rgb * gain
            loss, grad_rgb = loss_and_gradient(rgb, truth, ssim_weight, counting)
            if gain is not None:
                # y = g x: dL/dlog g = g dL/dg = sum over pixels of y dL/dy
                self.log_gain_gradient.copy_((rgb.double() * grad_rgb).sum((0, 1)))
                grad_rgb = grad_rgb * gain
            noted(seen.ends, room, loss, self._fits, self.ledger, self.counted)
            sums = decomposed(lists, made, self._background, counting, wanted, grad_rgb)
            unprojected(splats, self._view, lists, sums, wanted, terms, gradients, statistics,
                        counted=self.counted)
            torch.mul(seen.radii, self.counted, out=statistics.radii)

        return work
