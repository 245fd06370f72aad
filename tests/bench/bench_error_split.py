"""Splits the squared error of held-out views into its causes.

    python tests/bench/bench_error_split.py WORKSPACE ...

Causes are taken away one after the other, each as well as a view allows it, and what the mean error
of the view falls by is their share: pixels that fewer than three training views see, and regions
that contradict other views (both: beyond the error of the other pixels); a small turn and shift of
the camera; a gain per channel; a cubic tone curve per channel beyond it; and a linear filter of the
render that blurs or sharpens it, also along one direction. The order matters where causes overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import workbench
from numpy.typing import NDArray

from recon_cli.evaluation.reference_views import load_reference_views, render_view
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo.depths import unproject
from recon_cli.train import moving
from recon_cli.train.parts.photometry import read_falloffs

CAUSES = ("few views", "moving", "pose", "gain", "tone curve", "blur", "rest")
_FEW = 3  # training views that a pixel needs to be well seen
_TURNS = 4  # steps of the pose
_SMOOTH = 1.0  # pixels; images are smoothed where slopes are taken
_SCALES = (0.8, 1.6)  # pixels, of the filters
_MOST = 300  # training views that are looked at

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]
# of a camera: the render [H, W, 3] and the depth of its surface [H, W], 0 for none
Draw = Callable[[Camera], tuple[Image, Image]]


@dataclass(frozen=True)
class Split:
    """The mean squared error of a view, and what its causes take of that."""

    error: float
    parts: tuple[float, ...]  # in the order of CAUSES; they add up to `error`
    sharpness: float  # slopes of the photo over those of the render, root of the mean square


def count_witnesses(
    own: moving.ComparedView, views: Sequence[moving.ComparedView]
) -> NDArray[np.int64]:
    """Returns how many of `views` see the surface in each pixel [H, W] of another view."""
    pixels = np.flatnonzero(own.depth.reshape(-1) > 0)
    where = unproject(own.camera, own.depth, pixels)
    count = np.zeros(own.depth.size, np.int64)
    for other in views:
        count[pixels] += moving.sees(other, where)
    return count.reshape(own.depth.shape)


def split_view(draw: Draw, view: TrainView, few: Mask, moves: Mask) -> Split:
    """Returns the split of one view; `few` and `moves` are [H, W]."""
    photo = view.image / 255.0
    counts = np.ones(few.shape, np.bool_) if view.mask is None else view.mask
    render, _ = draw(view.camera)
    squared = ((render - photo) ** 2).mean(axis=2)
    few, moves = few & counts, moves & counts & ~few
    plain = counts & ~few & ~moves
    if not plain.any():
        plain, few, moves = counts, few & False, moves & False
    total, base = squared[counts].mean(), squared[plain].mean()
    excess = [float((squared[part] - base).sum() / counts.sum()) for part in (few, moves)]
    levels = [float(base)]
    render = align(draw, view.camera, photo, plain)
    levels.append(_error(render, photo, plain))
    for basis in (_gains, _curves, _filters):
        render = _fit(basis(render), photo, plain)
        levels.append(_error(render, photo, plain))
    drops = [before - after for before, after in pairwise(levels)]
    return Split(float(total), (*excess, *drops, levels[-1]),
                 _slopes(photo, plain) / max(_slopes(draw(view.camera)[0], plain), 1e-12))


def _error(render: Image, photo: Image, counts: Mask) -> float:
    return float(((render - photo) ** 2)[counts].mean())


def align(draw: Draw, camera: Camera, photo: Image, counts: Mask) -> Image:
    """Returns the render of the camera turned and shifted so that it shows the photo best.

    Gauss-Newton on the six parameters, besides a gain and an offset of each channel: a shift of
    brightness moves no camera. A step that does not lower the error is not taken.
    """
    best = draw(camera)
    for _ in range(_TURNS):
        render, depth = best
        twist = _twist(camera, render, depth, photo, counts & (depth > 0))
        camera = replace(camera, viewmat=_motion(twist) @ camera.viewmat)
        moved = draw(camera)
        if not _error(moved[0], photo, counts) < _error(render, photo, counts):
            break
        best = moved
    return best[0]


def _twist(
    camera: Camera, render: Image, depth: Image, photo: Image, counts: Mask
) -> NDArray[np.float64]:
    """Returns the turn [3] and shift [3] of the camera that explain photo minus render best."""
    render, photo = (cv2.GaussianBlur(image, (0, 0), _SMOOTH) for image in (render, photo))
    lines, columns = np.nonzero(counts)
    z = depth[counts]
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (lines + 0.5 - camera.cy) / camera.fy
    zero, one = np.zeros_like(x), np.ones_like(x)
    # of a point (x z, y z, z) moved by w x X + v, over its depth
    across = np.stack([-x * y, 1 + x * x, -y, one / z, zero, -x / z], axis=1) * camera.fx
    down = np.stack([-1 - y * y, x * y, x, zero, one / z, -y / z], axis=1) * camera.fy
    matrix, right = np.zeros((12, 12)), np.zeros(12)
    for channel in range(3):
        slope = [np.gradient(render[..., channel], axis=axis)[counts] for axis in (1, 0)]
        rows = np.zeros((len(x), 12))
        rows[:, :6] = -(slope[0][:, None] * across + slope[1][:, None] * down)
        rows[:, 6 + 2 * channel] = render[..., channel][counts]
        rows[:, 7 + 2 * channel] = 1
        matrix += rows.T @ rows
        right += rows.T @ (photo - render)[..., channel][counts]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))  # shifts and turns differ in units
    solved = np.linalg.lstsq(matrix * scale[:, None] * scale, right * scale, rcond=1e-9)[0]
    return np.asarray((solved * scale)[:6])


def _motion(twist: NDArray[np.float64]) -> NDArray[np.float64]:
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(twist[:3])[0]
    motion[:3, 3] = twist[3:]
    return motion


def _gains(render: Image) -> list[Image]:
    return [render * axis for axis in np.eye(3)]


def _curves(render: Image) -> list[Image]:
    return [render**power * axis for power in range(4) for axis in np.eye(3)]


def _filters(render: Image) -> list[Image]:
    """Returns the render and its second derivatives: weighted, they blur or sharpen any way."""
    images = [render]
    for scale in _SCALES:
        smooth = cv2.GaussianBlur(render, (0, 0), scale)
        down, across = np.gradient(smooth, axis=(0, 1))
        images += [np.gradient(across, axis=1), np.gradient(across, axis=0),
                   np.gradient(down, axis=0)]
    return images


def _fit(basis: Sequence[Image], photo: Image, counts: Mask) -> Image:
    """Returns the weighted sum of images that is nearest to a photo where that counts."""
    columns = np.stack([image[counts].reshape(-1) for image in basis], axis=1)
    weights = np.linalg.lstsq(columns, photo[counts].reshape(-1), rcond=None)[0]
    return np.asarray(sum(weight * image for weight, image in zip(weights, basis, strict=True)))


def _slopes(image: Image, counts: Mask) -> float:
    down, across = np.gradient(image, axis=(0, 1))
    return float(np.sqrt((down**2 + across**2)[counts].mean()))


def split_workspace(workspace: Path) -> list[Split]:
    """Returns the splits of the held-out views of a workspace by its trained model."""
    config, scene, splats = workbench.open_trained(workspace)
    degree, falloffs = config.sh_degree, read_falloffs(workspace / "train")

    def draw(camera: Camera) -> tuple[Image, Image]:
        rgb = render_view(splats, camera, degree, "numba").rgb.numpy()
        if falloffs is not None:
            rgb = falloffs.shade(rgb, camera)
        depth = render_surface(splats, camera, backend="numba").depth.numpy()
        return rgb.astype(np.float64), depth.astype(np.float64)

    train = load_reference_views(
        scene.train[::max(1, -(-len(scene.train) // _MOST))], config.max_size)
    others = [moving.compare_view(splats, view, degree, "numba") for view in train]
    views = load_reference_views(scene.test, config.max_size)
    held_out = [moving.compare_view(splats, view, degree, "numba") for view in views]
    splits = []
    for view, one, moves in zip(
            views, held_out, moving.find_moving(held_out, others), strict=True):
        few = count_witnesses(one, others) < _FEW
        size = view.camera.width, view.camera.height
        large = [cv2.resize(part.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
                 for part in (few, moves)]
        splits.append(split_view(draw, view, large[0], large[1]))
    return splits


@workbench.click.command()
@workbench.workspaces_argument
def main(workspaces: tuple[Path, ...]) -> None:
    """Prints the shares of the causes in the held-out error of finished workspaces."""
    workbench.numba_context()
    workbench.print_head("workspace", "views", "dB", *(f"{cause} %" for cause in CAUSES),
                         "sharpness", "worst view")
    for workspace in workspaces:
        splits = split_workspace(workspace)
        errors = np.array([split.error for split in splits])
        # of each view alike: one that is all wrong would say nothing of the others
        shares = np.mean([np.array(split.parts) / split.error for split in splits], axis=0)
        worst = CAUSES[int(np.argmax(splits[int(errors.argmax())].parts))]
        workbench.print_row(
            workspace.name, str(len(splits)), f"{np.mean(-10 * np.log10(errors)):.2f}",
            *(f"{100 * share:.0f}" for share in shares),
            f"{np.mean([split.sharpness for split in splits]):.2f}", worst)


if __name__ == "__main__":
    main()
