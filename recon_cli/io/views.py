"""Views in memory: their pixels at the size that is asked for, with masks, on black."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from recon_cli.errors import Hint
from recon_cli.io.images import fit_camera, read_masked_image
from recon_cli.scene.camera import Camera
from recon_cli.scene.image_file import ImageFile
from recon_cli.scene.scene import View
from recon_cli.scene.train_view import MIN_PIXELS, TrainView, leaves_enough

MASK_HINT = Hint("ingest", then=" with masks that hide less")
_Item = TypeVar("_Item")


@dataclass(frozen=True, eq=False)
class ReferenceView(TrainView):
    """A view with its original pixels, at the size it is scored at."""

    name: str = field(kw_only=True)
    face_of: str | None = field(default=None, kw_only=True)  # as of `View`


def load_views(
    views: Sequence[View], max_size: int, consequence: str,
    notice: Callable[[str], None] | None = None, *,
    denoised: bool = False, threads: int = 1, file: ImageFile | None = None,
) -> list[ReferenceView]:
    """Returns views without those whose mask leaves too little; a notice gives the consequence.

    Their images are put into `file`, if any.
    """
    def read(view: View) -> ReferenceView:
        camera = fit_camera(view.camera, max_size)
        path = view.denoised if denoised else view.original
        image, mask = read_masked_image(path, view.mask, camera.width, camera.height)
        if file is not None:
            image = file.put(image)
        return ReferenceView(
            camera, image, mask, name=view.name, face_of=view.face_of, file=file)

    with ThreadPoolExecutor(threads) as pool:
        every = list(pool.map(read, views))
    loaded = [view for view in every if leaves_enough(view.mask)]
    hidden = [view.name for view in every if not leaves_enough(view.mask)]
    if hidden and notice is not None:
        notice(f"{len(hidden)} views are {consequence}: their masks leave fewer than "
               f"{MIN_PIXELS} pixels: {', '.join(hidden)}")
    return loaded


def evenly_spread(items: Sequence[_Item], most: int) -> Sequence[_Item]:
    """Returns at most `most` of the items, evenly spread."""
    return items[:: max(1, -(-len(items) // most))]


def spread_inside(items: Sequence[_Item], count: int) -> list[_Item]:
    """Returns `count` of the items, or all: the middles of so many runs of one length."""
    count = min(count, len(items))
    return [items[int((at + 0.5) * len(items) / count)] for at in range(count)]


def size_summary(cameras: Sequence[Camera]) -> dict[str, Any]:
    """Returns width and height of the largest camera; where sizes differ also all as `sizes`."""
    sizes = sizes_of(cameras)
    summary: dict[str, Any] = {"width": sizes[0][0], "height": sizes[0][1]}
    return summary if len(sizes) == 1 else {**summary, "sizes": tuple(sizes)}


def sizes_of(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Returns the different (width, height) of cameras, the one of most pixels first."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    return sorted(sizes, key=lambda size: (size[0] * size[1], size), reverse=True)
