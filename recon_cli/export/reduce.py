"""Reduction of a scene before export: to a box, a lower degree or a file size."""

from __future__ import annotations

import logging
from collections.abc import Callable

from torch import Tensor

from recon_cli.errors import ConfigError
from recon_cli.scene.splats import Splats
from recon_cli.train.prune_loop import survivors
from recon_cli.workspace.summaries import ExportChange

Box = tuple[float, float, float, float, float, float]  # x, y, z of the lowest corner, the highest

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
    """Returns the Gaussians with their centres in a box or on it; ConfigError if none is."""
    low, high = splats.means.new_tensor(box[:3]), splats.means.new_tensor(box[3:])
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not inside.any():
        least, most = (splats.means.quantile(share, dim=0).tolist() for share in (0.05, 0.95))
        raise ConfigError(
            f"No Gaussian has its centre in the box {' '.join(f'{side:g}' for side in box)}.",
            hint="Nine tenths of them are between "
            f"{' '.join(f'{value:.2f}' for value in least)} and "
            f"{' '.join(f'{value:.2f}' for value in most)}.")
    return splats.select(inside)


def fit_to_size(
    splats: Splats, max_bytes: int, *, size_of: Callable[[Splats], int],
    score_of: Callable[[Splats], Tensor], psnr_db: Callable[[Splats], float],
) -> Splats:
    """Returns the scene reduced to a file size, by the degree and count that look best together.

    For each degree as many Gaussians of the highest scores as fit; of these scenes the one with the
    highest PSNR, on views that the scores do not use. `score_of` returns how much each Gaussian
    matters, [N], and is called at most once. ConfigError if not even one Gaussian fits.
    """
    if size_of(splats) <= max_bytes:
        return splats
    score = score_of(splats)
    candidates = (_fit_count(splats.with_degree(degree), max_bytes, size_of, score)
                  for degree in range(splats.sh_degree, -1, -1))
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
