"""What is taken from a scene before it is handed out: what lies outside a box, degrees, Gaussians.

Never in silence: each change is told in Gaussians, degree and PSNR.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from recon_cli.errors import ConfigError
from recon_cli.scene.splats import Splats
from recon_cli.train.pruning import survivors

Box = tuple[float, float, float, float, float, float]  # x, y, z of the lowest corner, the highest

_SHRINK = 0.99  # of the count at least, from one try to the next

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Change:
    """One thing that was taken away.

    Attributes:
        option: that asked for it.
        gaussians: that are left.
        gaussians_before: count.
        degree: of the colours that is left.
        degree_before: of the colours.
        psnr_change_db: on the views that the scene is held against.
    """

    option: str
    gaussians: int
    gaussians_before: int
    degree: int
    degree_before: int
    psnr_change_db: float

    def record(self) -> dict[str, Any]:
        """Returns it as JSON keeps it."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        text = f"{self.option}: {self.gaussians:,} of {self.gaussians_before:,} Gaussians"
        if self.degree != self.degree_before:
            text += f", degree {self.degree_before} -> {self.degree}"
        return f"{text}, {self.psnr_change_db:+.2f} dB"


def changed(
    option: str, before: Splats, after: Splats, psnr_db: Callable[[Splats], float]
) -> Change:
    """Returns what an option has taken away, and says it."""
    change = Change(
        option, len(after), len(before), after.sh_degree, before.sh_degree,
        round(psnr_db(after) - psnr_db(before), 4))
    logger.info("%s", change)
    return change


def cropped(splats: Splats, box: Box) -> Splats:
    """Returns the Gaussians whose centres lie in a box, its sides included.

    Raises:
        ConfigError: none does.
    """
    low, high = splats.means.new_tensor(box[:3]), splats.means.new_tensor(box[3:])
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not inside.any():
        least, most = (value.tolist() for value in (
            splats.means.quantile(0.05, dim=0), splats.means.quantile(0.95, dim=0)))
        raise ConfigError(
            f"No Gaussian has its centre in the box {' '.join(f'{one:g}' for one in box)}.",
            hint="Nine tenths of them lie between "
            f"{' '.join(f'{one:.2f}' for one in least)} and "
            f"{' '.join(f'{one:.2f}' for one in most)}.")
    return splats.select(inside)


def of_size(
    splats: Splats, most_bytes: int, *, size_of: Callable[[Splats], int],
    score_of: Callable[[Splats], Tensor], psnr_db: Callable[[Splats], float],
) -> Splats:
    """Returns the scene cut to a size: by the degree and the count that look best together.

    For each degree as many Gaussians of the highest scores as fit; of these scenes the one with the
    highest PSNR.

    Args:
        splats: the scene.
        most_bytes: of the file.
        size_of: returns the bytes of the file that a scene would make.
        score_of: returns how much each Gaussian matters, [N]; asked at most once.
        psnr_db: returns how good a scene looks, on views that no score comes from.

    Raises:
        ConfigError: not even one Gaussian fits.
    """
    if size_of(splats) <= most_bytes:
        return splats
    score = score_of(splats)
    fitting = [one for one in (
        _within(splats.with_degree(degree), most_bytes, size_of, score)
        for degree in range(splats.sh_degree, -1, -1)) if one is not None]
    if not fitting:
        raise ConfigError(
            f"Not even one Gaussian fits into {most_bytes / 1e6:g} MB.",
            hint="Allow more with --max-mb.")
    return max(fitting, key=psnr_db)


def _within(
    splats: Splats, most_bytes: int, size_of: Callable[[Splats], int], score: Tensor
) -> Splats | None:
    """Returns as many Gaussians of the highest scores as fit; None where not even one does."""
    count = len(splats)
    while count:
        kept = splats if count == len(splats) else splats.select(survivors(score, count))
        size = size_of(kept)
        if size <= most_bytes:
            return kept
        count = min(int(_SHRINK * count), int(count * most_bytes / size))
    return None
