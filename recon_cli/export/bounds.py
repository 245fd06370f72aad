"""How far the Gaussians of an export reach, which viewers take for the size of the scene."""

from __future__ import annotations

from torch import Tensor

from recon_cli.scene.splats import Splats

_FAR = 10.0  # times the size of the bulk: the room is a dot in a viewer that shows all
_BULK = (0.05, 0.95)  # quantiles along each axis, between which the bulk lies


def describe_bounds(splats: Splats) -> str:
    """Returns a warning about a scene that reaches much farther than its bulk; else empty."""
    means = splats.means.detach().double().cpu()
    low, high = find_bulk(means)
    bulk, alone = float((high - low).max()), _reach(means)
    across = _reach(splats.with_sphere().means.double().cpu())
    if not across > _FAR * bulk or not bulk:
        return ""
    text = (f"the files reach {across:,.4g} units across, but nine tenths of the Gaussians lie "
            f"between {_corner(low)} and {_corner(high)}, so viewers that fit the bounds start far "
            "away.")
    if splats.backdrop is not None:
        text += f" --drop-backdrop leaves out the sphere behind them ({alone:,.4g} units are left)."
    if alone > _FAR * bulk:
        text += " --crop cuts off everything outside a box."
    return text


def find_bulk(means: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the lowest and the highest corner [3] of the box that the bulk [N, 3] lies in."""
    order = means.sort(dim=0).values  # torch.quantile takes 16 million values at most
    low, high = (order[round(share * (len(means) - 1))] for share in _BULK)
    return low, high


def _reach(means: Tensor) -> float:
    return float((means.amax(dim=0) - means.amin(dim=0)).max())


def _corner(corner: Tensor) -> str:
    return " ".join(f"{value:.4g}" for value in corner.tolist())
