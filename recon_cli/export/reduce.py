"""Reduction of a scene before export: to a box, a lower degree or a file size."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from recon_cli.errors import ConfigError
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.train.prune_loop import survivors
from recon_cli.workspace.export_record import ExportChange

Box = tuple[float, float, float, float, float, float]  # x, y, z of the lowest corner, the highest

_RIDGE = 1e-3  # keeps coefficients small that no view tells apart, such as of a wall seen head-on
_BLOCK = 1 << 16  # Gaussians that are solved for at once
_SHRINK = 0.99  # of the count at most, from one attempt to the next

logger = logging.getLogger("recon")


def measure_change(
    option: str, before: Splats, after: Splats, psnr_db: Callable[[Splats], float]
) -> ExportChange:
    """Returns and logs what an option has removed."""
    change = ExportChange(
        option=option, gaussians=len(after), gaussians_before=len(before),
        degree=after.sh_degree, degree_before=before.sh_degree,
        psnr_change_db=round(psnr_db(after) - psnr_db(before), 4))
    text = f"{option}: {len(after):,} of {len(before):,} Gaussians"
    if change.degree != change.degree_before:
        text += f", degree {change.degree_before} -> {change.degree}"
    logger.info("%s, %+.2f dB", text, change.psnr_change_db)
    return change


def crop(splats: Splats, box: Box) -> Splats:
    """Returns the Gaussians with their centres in a box or on it, alone; ConfigError if none is."""
    low, high = splats.means.new_tensor(box[:3]), splats.means.new_tensor(box[3:])
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not inside.any():
        least, most = (splats.means.quantile(share, dim=0).tolist() for share in (0.05, 0.95))
        raise ConfigError(
            f"No Gaussian has its centre in the box {' '.join(f'{side:g}' for side in box)}.",
            hint="Nine tenths of them are between "
            f"{' '.join(f'{value:.2f}' for value in least)} and "
            f"{' '.join(f'{value:.2f}' for value in most)}.")
    return replace(splats.select(inside), backdrop=None)


class LowerDegrees:
    """A scene in lower degrees of spherical harmonics, fitted to what the views see of its colours.

    Cutting the higher coefficients off changes all colours: a Gaussian that is seen from one side
    only owes its colour there to all of them together. The lower ones y are instead the least
    squares of w |Y_low(d) y - Y(d) x|^2 over the views, with directions d to the Gaussian and its
    blend weights w in them. What no view sees is cut.
    """

    def __init__(self, splats: Splats, cameras: Sequence[Camera], *, backend: str) -> None:
        self._splats, full = splats, (splats.sh_degree + 1) ** 2
        low = splats.sh_degree**2  # of the next lower degree, whose part serves those below
        device = splats.means.device
        self._weight = torch.zeros(len(splats), device=device)
        self._products = torch.zeros(len(splats), low, full, device=device)
        background = torch.zeros(3, dtype=splats.means.dtype, device=device)
        for camera in cameras:
            with torch.no_grad():
                weight = render(splats, camera, background, 0, backend=backend,
                                scores=True).statistics.blend_sum.float()
            seen = torch.nonzero(weight)[:, 0]
            center = torch.as_tensor(camera.center, dtype=torch.float32, device=device)
            away = torch.nn.functional.normalize(splats.means[seen].float() - center, dim=1)
            basis = torch.cat([
                torch.full((len(seen), 1), SH_C0, device=device),
                basis_rest(away, splats.sh_degree)], dim=1)
            weighted = weight[seen, None] * basis[:, :low]
            self._weight.index_add_(0, seen, weight[seen])
            self._products.index_add_(0, seen, weighted[:, :, None] * basis[:, None])

    def at(self, degree: int) -> Splats:
        """Returns the scene in a degree below its own; in its own it is unchanged."""
        splats = self._splats
        if degree >= splats.sh_degree:
            return splats
        low = (degree + 1) ** 2
        colored = len(splats.sh_rest)  # the others have a base colour only
        rest = torch.nn.functional.pad(splats.sh_rest, (0, 0, 0, 0, 0, len(splats) - colored))
        whole = torch.cat([splats.sh_dc[:, None], rest], dim=1)  # [N, T, 3]
        result = whole[:, :low].clone()
        ridge = _RIDGE * torch.eye(low, dtype=torch.float64, device=whole.device)
        ridge[0, 0] = 0
        for rows in torch.split(torch.nonzero(self._weight)[:, 0], _BLOCK):
            products = self._products[rows, :low].double() / self._weight[rows, None, None]
            wanted = products @ whole[rows].double()
            solved = torch.linalg.solve(products[..., :low] + ridge, wanted)
            result[rows] = solved.to(result.dtype)
        return replace(splats, sh_dc=result[:, 0].contiguous(),
                       sh_rest=result[:colored, 1:].contiguous())


def fit_to_size(
    splats: Splats, max_bytes: int, *, size_of: Callable[[Splats], int],
    score_of: Callable[[Splats], Tensor], at_degree: Callable[[int], Splats],
    psnr_db: Callable[[Splats], float],
) -> Splats:
    """Returns the scene reduced to a file size, by the degree and count that look best together.

    For each degree as many Gaussians of the highest scores as fit; of these scenes the one with the
    highest PSNR, on views that the scores do not use. `score_of` returns how much each Gaussian
    matters, [N], and is called at most once; `at_degree` returns the scene in a lower degree.
    ConfigError if not even one Gaussian fits.
    """
    if size_of(splats) <= max_bytes:
        return splats
    score = score_of(splats)
    degrees = range(splats.sh_degree, -1, -1)
    candidates = (_fit_count(at_degree(degree), max_bytes, size_of, score) for degree in degrees)
    fitting = [scene for scene in candidates if scene is not None]
    if not fitting:
        raise ConfigError(
            f"Not even one Gaussian fits into {max_bytes / 1e6:g} MB.",
            hint="Allow more with --max-mb.")
    return max(fitting, key=psnr_db)


def _fit_count(
    splats: Splats, max_bytes: int, size_of: Callable[[Splats], int], score: Tensor
) -> Splats | None:
    """Returns as many Gaussians of the highest scores as fit; None if not even one does."""
    count = len(splats)
    while count:
        best = splats if count == len(splats) else splats.select(survivors(score, count))
        size = size_of(best)
        if size <= max_bytes:
            return best
        count = min(int(_SHRINK * count), int(count * max_bytes / size))
    return None
