"""A view's photo next to recon's own render of it, and thumbnails of all views."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.evaluation.metrics import leaves_enough, psnr
from recon_cli.evaluation.reference_views import render_on_black
from recon_cli.io.images import fit_camera, fit_size, read_image, read_masked_image, to_uint8
from recon_cli.pipeline.execute import Job, render_context
from recon_cli.scene.scene import View
from recon_cli.scene.splats import Splats

_THUMBNAIL = 160  # pixels, longest side


class PhotoPairs:
    """Photos and renders of views, made on request, by one thread at a time.

    Args:
        job: device, backend and threads to render with.
        max_size: longest side in pixels.
    """

    def __init__(self, job: Job, max_size: int) -> None:
        self._job, self._max_size = job, max_size
        self._thumbnails: dict[str, NDArray[np.uint8]] = {}

    @cached_property
    def _ctx(self) -> StageContext:
        return render_context(self._job.compute, self._job.progress)

    def load_photo(self, view: View) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """Returns a photo [H, W, 3] at the size of training, painted under its mask [H, W].

        Raises:
            FormatError: it cannot be read.
        """
        camera = fit_camera(view.camera, self._max_size)
        return read_masked_image(view.original, view.mask, camera.width, camera.height)

    def render_view(self, view: View, splats: Splats) -> tuple[NDArray[np.uint8], float | None]:
        """Returns recon's render [H, W, 3] of a view and its PSNR in dB, as `recon eval` has it.

        The PSNR is None if a mask leaves too little of the view.

        Raises:
            BackendError: the requested rasterizer is not available.
            FormatError: the photo cannot be read.
        """
        truth, mask = self.load_photo(view)
        camera, device = fit_camera(view.camera, self._max_size), self._ctx.device
        on_device = splats.map(lambda tensor: tensor.to(device))
        rgb = render_on_black(on_device, camera, splats.sh_degree, self._ctx.backend).rgb
        image: NDArray[np.float32] = rgb.cpu().numpy()
        return to_uint8(image), psnr(image, truth, mask) if leaves_enough(mask) else None

    def thumbnail(self, view: View) -> NDArray[np.uint8]:
        """Returns a small picture of a view.

        Raises:
            FormatError: the photo cannot be read.
        """
        if view.name not in self._thumbnails:
            size = fit_size(view.camera.width, view.camera.height, _THUMBNAIL)
            self._thumbnails[view.name] = read_image(view.original, *size)
        return self._thumbnails[view.name]
