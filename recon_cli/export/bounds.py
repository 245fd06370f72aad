"""How far the Gaussians of an export reach, which viewers take for the size of the scene.

Training puts what windows show a hundred times as far away as the cameras walk, and a backdrop
behind that: a viewer that fits all of it shows the room as a dot. In files for viewers what lies
outside the room therefore is moved inwards on the line from the cameras that see it, its size in
proportion, so that these see what they saw; and what hardly changes any view is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.context import StageContext
from recon_cli.export.synthetic_cameras import ASSUMED_DB, SelfPsnr
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.splats.values import WIDE, find_bulk
from recon_cli.workspace.summaries import ExportChange

MOST_LOSS_DB = 0.1  # by bounds; more is said
# Bounding sphere of a file over that of its room, the first that loses no more. Content at infinity
# cannot be exact so near: in a room with a large window 3 loses 2.4 dB, 10 .9, 30 .1.
SPHERES = (3.0, 10.0, 30.0)
SIZE, VIEWS = 300, 50  # pixels and views, at most, that what lies outside is measured in
# Times the distance from the middle of the cameras within which nine tenths of the points lie:
# the corners of a box lie at 1.3 times, those of a room twice as long as wide at 1.4
_ROOM = 1.5
_VOID_DB = MOST_LOSS_DB / 2  # that leaving out may cost; the other half is for what is moved
_TRIES = 4  # each leaves out a quarter of the one before
# Times the distance of what is farthest: where the backdrop is. It is drawn in the order of depth
# along the axis of the camera, in which a Gaussian of it that covers a pixel 45 degrees aside, and
# has its middle 3 of its standard deviations (2.4 degrees) farther aside, is nearer by 1 / 1.15.
_BEHIND = 1.15
_STEPS = 40  # of bisections: more than the digits of float32


@dataclass(frozen=True, eq=False)
class Room:
    """A sphere around the cameras that holds the room, but not the view from its windows."""

    center: NDArray[np.float64]  # [3]
    radius: float

    @staticmethod
    def from_points(points: NDArray[np.float64], cameras: NDArray[np.float64]) -> Room:
        """Returns the room of triangulated points [P, 3], of which windows show few."""
        center = cameras.mean(axis=0)
        path = np.linalg.norm(cameras - center, axis=1).max()
        reach = np.quantile(np.linalg.norm(points - center, axis=1), 0.9) if len(points) else 0.0
        return Room(center, float(max(_ROOM * reach, _ROOM * path)))


def bound_scene(
    splats: Splats, room: Room, cameras: Sequence[Camera], ctx: StageContext, *,
    spheres: Sequence[float] = SPHERES,
) -> Splats:
    """Returns a scene, its backdrop as Gaussians, in a sphere not much larger than its room's.

    Args:
        splats: the scene; returned as it is where it has no backdrop and such bounds.
        room: in the world of the splats.
        cameras: of training views.
        ctx: backend and device.
        spheres: times the room's, of which the first is taken that loses at most MOST_LOSS_DB, or
            the last.
    """
    whole = splats.with_sphere()
    if splats.backdrop is not None:  # half as large, four times as many: see _BEHIND
        whole = splats.with_sphere(float(whole.scales[-1, 0]) / 2)
    center = torch.as_tensor(room.center)
    away = (whole.means.detach().double().cpu() - center).norm(dim=1)
    outside = away > room.radius
    inside = whole.means.detach().double().cpu()[~outside]
    if not len(inside) or (splats.backdrop is None and bounding_sphere(
            whole.means.detach().double().cpu()) <= spheres[0] * bounding_sphere(inside)):
        return splats
    harm, eyes = _observe(whole, cameras, center, ctx)
    psnr = SelfPsnr.from_renders(whole, cameras, ctx)
    kept = ~_find_void(whole, outside, harm, psnr)
    left = whole.select(torch.nonzero(kept)[:, 0].to(whole.means.device))
    for most in spheres:
        bounded = _move(left, away[kept], eyes[kept], int(kept[:len(splats)].sum()), room,
                        most * bounding_sphere(inside))
        if psnr.psnr_db(bounded) >= ASSUMED_DB - MOST_LOSS_DB:
            break
    return bounded


def _observe(
    splats: Splats, cameras: Sequence[Camera], center: Tensor, ctx: StageContext
) -> tuple[Tensor, Tensor]:
    """Returns the squared error that each one's removal causes [N], and whence it is seen [N, 3].

    The second is the mean of the cameras by blend weight, the `center` [3] where none sees it.
    """
    leaves = splats.map(lambda tensor: tensor.detach().to(ctx.device).requires_grad_(True))
    n, none = len(splats), torch.zeros(3, device=ctx.device)
    harm, weight, eyes = torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 3)
    with ctx.progress.bar("look outside", len(cameras), unit="view") as bar:
        for camera in cameras:
            output = render(leaves, camera, none.to(leaves.means.dtype), leaves.sh_degree,
                            backend=ctx.backend, scores=True)
            output.rgb.sum().backward()  # type: ignore[no-untyped-call]
            seen = output.statistics.blend_sum.detach().float().cpu()[:, None]
            harm += output.statistics.loo.detach().float().cpu()
            weight += seen
            eyes += seen * torch.as_tensor(camera.center).float()
            bar.advance()
    eyes = torch.where(weight > 0, eyes / weight.clamp_min(1e-12), center.float())
    return harm.double(), eyes.double()


def _find_void(splats: Splats, outside: Tensor, harm: Tensor, psnr: SelfPsnr) -> Tensor:
    """Returns what lies outside and may be left out at a loss of at most _VOID_DB, [N] bool.

    What is left out of one pixel together harms it by more than the sum, so each choice is
    measured.
    """
    least = ASSUMED_DB - _VOID_DB
    error = 10 ** (-least / 10) - 10 ** (-ASSUMED_DB / 10)
    allowed = error * 3 * sum(camera.width * camera.height for camera, _, _ in psnr.views)
    order = torch.argsort(torch.where(outside, harm, math.inf))
    total = torch.cumsum(harm[order], 0)
    for number in range(_TRIES):
        void = torch.zeros_like(outside)
        void[order[(total <= allowed / 4**number) & outside[order]]] = True
        rows = torch.nonzero(~void)[:, 0].to(splats.means.device)
        if psnr.psnr_db(splats.select(rows)) >= least:
            return void
    return outside & (harm == 0)


def _move(
    splats: Splats, away: Tensor, eyes: Tensor, count: int, room: Room, most: float
) -> Splats:
    """Returns a scene with what lies outside the room moved inwards, to a bounding sphere `most`.

    `away` [N] are distances from the middle of the room, `eyes` [N, 3] whence each one is seen;
    all but the first `count` are the backdrop.
    """
    means, center = splats.means.detach().double().cpu(), torch.as_tensor(room.center)
    order = torch.argsort(away)
    order = order[away[order] > room.radius]
    gaps = torch.log(away[order] / room.radius).diff(prepend=torch.zeros(1, dtype=torch.float64))
    gaps[order >= count] = gaps[order >= count].clamp_max(math.log(_BEHIND))
    # p = eye + s ray lies at the new distance d from the middle: |eye - middle + s ray| = d
    ray, offset = means[order] - eyes[order], eyes[order] - center
    square, half = (ray**2).sum(1).clamp_min(1e-30), (ray * offset).sum(1)

    def factors(cap: float) -> Tensor:
        distance = room.radius * torch.exp(torch.cumsum(gaps.clamp_max(cap), 0))
        rest = (offset**2).sum(1) - distance**2
        root = (half**2 - square * rest).clamp_min(0).sqrt()
        return ((root - half) / square).clamp(1e-6, 1.0)

    def moved(cap: float) -> Tensor:
        result = means.clone()
        result[order] = eyes[order] + factors(cap)[:, None] * ray
        return result

    # Gaps in depth are cut to one size, the large ones alone, so that what is near each other
    # keeps its order from all cameras: other maps, such as 1 / distance, mix what is blended.
    cap = _bisect(lambda cap: bounding_sphere(moved(cap)) <= most, float(gaps.sum()))
    log_scales = splats.log_scales.detach().clone()
    rows = order.to(log_scales.device)
    log_scales[rows] += factors(cap).log()[:, None].to(log_scales)
    return replace(splats, means=moved(cap).to(splats.means), log_scales=log_scales)


def _bisect(fits: Callable[[float], bool], high: float) -> float:
    """Returns the greatest number from 0 to `high` that fits, or 0 where none does."""
    if fits(high):
        return high
    low = 0.0
    for _ in range(_STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def bounding_sphere(means: Tensor) -> float:
    """Returns the radius of the sphere around the box of centres [N, 3], as three.js takes it."""
    middle = (means.amin(dim=0) + means.amax(dim=0)) / 2
    return float((means - middle).norm(dim=1).max())


def describe_loss(changes: Sequence[ExportChange]) -> str:
    """Returns a warning about bounds that views can see; else empty."""
    lost = max((-one.psnr_change_db for one in changes if one.option == "backdrop"), default=0.0)
    return "" if lost <= MOST_LOSS_DB else (
        f"the files lose {lost:.2f} dB: what windows show, or fills gaps, was moved nearer or left "
        "out. --backdrop keep leaves all where it was trained, and viewers that fit the bounds "
        "far away.")


def describe_bounds(splats: Splats) -> str:
    """Returns a warning about a scene that reaches much farther than its bulk; else empty."""
    means = splats.means.detach().double().cpu()
    low, high = find_bulk(means.numpy())
    bulk, alone = float((high - low).max()), _reach(means)
    across = _reach(splats.with_sphere().means.double().cpu())
    if not across > WIDE * bulk or not bulk:
        return ""
    text = (f"the files reach {across:,.4g} units across, but nine tenths of the Gaussians lie "
            f"between {_corner(low)} and {_corner(high)}, so viewers that fit the bounds start far "
            "away.")
    if splats.backdrop is not None:
        text += f" --backdrop drop leaves out the sphere behind them ({alone:,.4g} units are left)."
    if alone > WIDE * bulk:
        text += " --crop cuts off everything outside a box."
    return text


def _reach(means: Tensor) -> float:
    return float((means.amax(dim=0) - means.amin(dim=0)).max())


def _corner(corner: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.4g}" for value in corner.tolist())
