"""Which Gaussians hang in the air: by what the training views say of each, not by how they look.

Three kinds. *Unseen*: no view ever blends it with more than a tiny weight (RadSplat, Niemeyer et
al. 2024, prunes by the same maximum). *In front*: two views at most see it, and in each it hangs
less than half way to what is behind it: it was fitted to these views alone. *Harmful*: without it
the views would be shown better. That is exact for each Gaussian alone, for colour is affine in its
alpha: with d = alpha T (c - B) what it adds to a pixel and e the error there, leaving it out
changes the squared error by sum ||d||^2 - 2 sum e d. The first sum is `loo`; the second is the
gradient of half the squared error by the logarithm of the opacity. Two that stand in front of each
other are blamed for each other's error, so the worst go first and the rest is looked at again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.render import RenderOutput, render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView

# docs/cleanup.md has what these were measured on.
_WEIGHT = 0.01  # alpha T; below, a view does not show it. RadSplat's threshold for high quality
_FEW = 2  # views
_IN_FRONT = 0.5  # of the depth of what is behind
_SOLID = 0.5  # coverage from which something is behind
_HARM = 3e-4  # of the squared error of all views, that would go with it: .0013 dB
_WORST = 0.2  # of the greatest harm: what goes in one round
_ROUNDS = 12

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class Floaters:
    """Gaussians of each kind, [N] bool; none is of two kinds."""

    unseen: Tensor
    in_front: Tensor
    harmful: Tensor

    @property
    def all(self) -> Tensor:
        """Those of any kind, [N] bool."""
        return self.unseen | self.in_front | self.harmful


def floaters(
    splats: Splats, views: Sequence[TrainView], *, backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> Floaters:
    """Returns which Gaussians hang in the air.

    Args:
        splats: N Gaussians.
        views: training views, whose cameras are in the world of the Gaussians; never validation or
            test views.
        backend: rasterizer.
        on_view: called after each view that was rendered.
    """
    none = torch.zeros(len(splats), dtype=torch.bool, device=splats.means.device)
    seen_by = sightings(splats, views, backend=backend, on_view=on_view)
    found = Floaters(seen_by == 0, _in_front(splats, seen_by, views, backend, on_view), none)
    rows = torch.nonzero(~found.all)[:, 0]
    harmful = none.clone()
    for number in range(1, _ROUNDS + 1):
        harm, error = harms(splats.select(rows), views, backend=backend, on_view=on_view)
        worst = harm > max(_HARM * error, _WORST * float(harm.max()) if len(rows) else 0.0)
        if not worst.any() or worst.all():
            break
        logger.info("floaters, round %d: %d Gaussians make the training views worse", number,
                    int(worst.sum()))
        harmful[rows[worst]] = True
        rows = rows[~worst]
    return Floaters(found.unseen, found.in_front, harmful)


def harms(
    splats: Splats, views: Sequence[TrainView], *, backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> tuple[Tensor, float]:
    """Returns by how much the squared error falls without each alone [N] float64, and the error.

    Args:
        splats: N Gaussians.
        views: with their images; pixels that a mask ignores have no error.
        backend: rasterizer.
        on_view: called after each view.
    """
    leaves = splats.map(lambda tensor: tensor.detach().requires_grad_(True))
    device = splats.means.device
    loo = torch.zeros(len(splats), dtype=torch.float64, device=device)
    total = 0.0
    for view in views:
        output = _rendered(leaves, view.camera, backend, view.counting(device))
        difference = output.rgb - view.pixels(device)
        mask = view.counting(device)
        if mask is not None:
            difference = difference * mask[..., None]
        error = 0.5 * difference.square().sum()
        total += 2 * float(error.detach())
        if error.requires_grad:
            error.backward()  # type: ignore[no-untyped-call]
        loo += output.statistics.loo
        on_view()
    pull = leaves.logit_opacities.grad
    if pull is None:
        return torch.zeros_like(loo), total
    # d/d log o = (d/d logit) / (1 - o), for o' = o (1 - o)
    by_log = pull.double() * (1 + torch.exp(splats.logit_opacities.detach().double()))
    return 2 * by_log - loo, total


def _rendered(
    splats: Splats, camera: Camera, backend: str, mask: Tensor | None = None
) -> RenderOutput:
    background = torch.zeros(3, dtype=splats.means.dtype, device=splats.means.device)
    return render(
        splats, camera, background, splats.sh_degree, backend=backend, scores=True, mask=mask)


def sightings(
    splats: Splats, views: Sequence[TrainView], *, backend: str,
    on_view: Callable[[], None] = lambda: None,
) -> Tensor:
    """Returns how many views show each Gaussian, [N] int64: blend it with 0.01 or more somewhere.

    The arguments are those of `floaters`.
    """
    seen_by = torch.zeros(len(splats), dtype=torch.int64, device=splats.means.device)
    with torch.no_grad():
        for view in views:
            seen_by += _rendered(splats, view.camera, backend).statistics.blend_max >= _WEIGHT
            on_view()
    return seen_by


def _in_front(
    splats: Splats, seen_by: Tensor, views: Sequence[TrainView], backend: str,
    on_view: Callable[[], None],
) -> Tensor:
    """Returns which Gaussians hang in front of the few views that see them, [N] bool."""
    few = (seen_by > 0) & (seen_by <= _FEW)
    hangs = few.clone()
    rest = splats.select(~few)
    if not few.any() or not len(rest):
        return torch.zeros_like(few)
    with torch.no_grad():
        for view in views:
            shown = few & (_rendered(splats, view.camera, backend).statistics.blend_max >= _WEIGHT)
            if shown.any():
                behind = _rendered(rest, view.camera, backend)
                hangs[shown] &= _before(splats.means[shown], view.camera, behind)
            on_view()
    return hangs


def _before(means: Tensor, camera: Camera, behind: RenderOutput) -> Tensor:
    """Returns which centres [K, 3] lie far in front of what a picture shows, [K] bool."""
    viewmat = torch.from_numpy(camera.viewmat).to(means)
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(dim=1)
    ahead = z.clamp_min(1e-6)
    column = (camera.fx * x / ahead + camera.cx).long().clamp(0, camera.width - 1)
    line = (camera.fy * y / ahead + camera.cy).long().clamp(0, camera.height - 1)
    cover = behind.alpha[line, column]
    return (cover >= _SOLID) & (z * cover < _IN_FRONT * behind.depth[line, column])
