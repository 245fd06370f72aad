"""What any splat file needs of the Gaussians that go into it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.splats import Splats, with_rows

_Float = TypeVar("_Float", bound=np.floating[Any])


def arrays(splats: Splats, kind: str) -> dict[str, NDArray[np.float32]]:
    """Returns the raw parameters as float32 arrays by name, `sh_rest` for all N Gaussians.

    Quaternions are of unit length; zeros, which stand for no rotation, become 1 0 0 0. Where no
    Gaussian has coefficients, `sh_rest` is [N, 0, 3].

    Args:
        splats: raw parameters on any device.
        kind: what a message calls the file, such as ".sog".

    Raises:
        FormatError: there are no Gaussians, or a value is not finite.
    """
    if not len(splats):
        raise FormatError(f"There are no Gaussians to write; a {kind} needs at least one.")
    if not len(splats.sh_rest):
        splats = splats.with_degree(0)
    values = {name: value.detach().cpu().float() for name, value in splats.parameters().items()}
    values["sh_rest"] = with_rows(values["sh_rest"], len(splats))
    table = {name: value.numpy() for name, value in values.items()}
    refuse_not_finite(f"The scene for a {kind}", table)
    table["quats"] = unit_quats(table["quats"])
    return table


def refuse_not_finite(what: object, columns: Mapping[str, NDArray[Any]]) -> None:
    """Raises FormatError that names each column with NaN or infinity, and how many it has."""
    bad = {name: int(np.size(value) - np.isfinite(value).sum()) for name, value in columns.items()}
    bad = {name: count for name, count in bad.items() if count}
    if bad:
        found = ", ".join(f"{name} ({count})" for name, count in bad.items())
        raise FormatError(f"{what} holds values that are not finite in {found}.")


def unit_quats(quats: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Returns quaternions [N, 4] wxyz of unit length; zeros become no rotation."""
    wide = quats.astype(np.float64)
    wide[~wide.any(axis=1)] = [1, 0, 0, 0]
    # The greatest component first: the square of a tiny one underflows.
    wide /= np.abs(wide).max(axis=1, keepdims=True)
    wide /= np.linalg.norm(wide, axis=1, keepdims=True)
    return wide.astype(np.float32)


def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    """Returns opacities in [0, 1] of logits, without overflow."""
    return np.asarray(0.5 * (1 + np.tanh(0.5 * logits.astype(np.float64))))


def logit(opacities: NDArray[np.float64], least: float) -> NDArray[np.float32]:
    """Returns the logits of opacities in [0, 1], which are first kept `least` away from both ends.

    An opacity of exactly 0 or 1 has no finite logit.
    """
    inner = np.clip(opacities, least, 1 - least)
    return np.asarray(np.log(inner / (1 - inner)), np.float32)


def colored_rows(sh_rest: NDArray[_Float]) -> NDArray[_Float]:
    """Returns coefficients [N, T, 3] without the rows of zeros at the end."""
    rows = np.flatnonzero(sh_rest.any(axis=(1, 2)))
    return sh_rest[: rows[-1] + 1 if len(rows) else 0]
