"""Gaussians with their files, and with the values that other programs take them by."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.errors import InputError
from recon_cli.scene import splats as scene_splats
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.splats import SH_C0, TERMS, with_rows
from recon_cli.splats.axes import UP
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.lod import discard_levels
from recon_cli.splats.registry import FORMATS, check_writable, load_splats, put_in_place

Array = NDArray[Any] | Tensor | Sequence[Any]

logger = logging.getLogger("recon")


@dataclass(eq=False)
class Splats(scene_splats.Splats):
    """N Gaussians: raw parameters as tensors, their activated values, and files of any format.

    `means` [N, 3] are centres in world units, `quats` [N, 4] rotations wxyz of any length, `scales`
    [N, 3] standard deviations along the own axes in world units, `opacities` [N] in (0, 1), and
    `sh` [N, K, 3] spherical-harmonics coefficients of degree 0 to 3 (K of 1, 4, 9, 16; colour =
    sum of basis times coefficient, + 0.5). All are tensors; `arrays` returns them for NumPy.

    The constructor takes raw parameters; `from_arrays` takes activated values.
    """

    up: str | None = field(default=None, kw_only=True)  # z, -y or y, if its file says; for files
    # trained with antialiasing (Mip-Splatting), as its file says; for files
    antialiased: bool = field(default=False, kw_only=True)

    @classmethod
    def read(cls, path: str | Path) -> Splats:
        """Returns the Gaussians of a file, by the end of its name; docs/formats.md lists formats.

        FormatError if it is damaged, missing or of an unknown format.
        """
        path = Path(path)
        scene = load_splats(path)
        return cls.from_scene(
            put_in_place(scene, path.name), up=scene.up, antialiased=scene.antialiased)

    @classmethod
    def from_scene(
        cls, splats: scene_splats.Splats, *, up: str | None = None, antialiased: bool = False
    ) -> Splats:
        """Returns the same Gaussians, sharing their tensors."""
        return cls(**splats.parameters(), backdrop=splats.backdrop, up=up, antialiased=antialiased)

    @classmethod
    def from_arrays(
        cls, means: Array, quats: Array, scales: Array, opacities: Array, sh: Array, *,
        backdrop: Backdrop | None = None,
    ) -> Splats:
        """Returns Gaussians of activated values, as the class names them.

        Gradients pass through tensors, which stay of their type; all else becomes float32.

        Args:
            means: [N, 3].
            quats: [N, 4].
            scales: [N, 3], all above 0.
            opacities: [N] in [0, 1]; 0 and 1 become the nearest values that a logit has.
            sh: [N, K, 3] coefficients, or [N, 3] colours in [0, 1] that look alike from everywhere.
            backdrop: `backdrop` of other Gaussians.

        Raises:
            InputError: a shape does not fit, or a value is not finite or out of its range.
        """
        values = {name: _tensor(name, value) for name, value in (
            ("means", means), ("quats", quats), ("scales", scales), ("opacities", opacities),
            ("sh", sh))}
        n = len(values["means"]) if values["means"].ndim else 0
        coefficients = values["sh"]
        if coefficients.ndim == 2:
            coefficients = ((coefficients - 0.5) / SH_C0)[:, None]
        _check_shapes({**values, "sh": coefficients}, n)
        _check_ranges(values)
        scale, opacity = values["scales"], values["opacities"]
        least = torch.finfo(opacity.dtype).eps / 2
        return cls(
            values["means"], values["quats"], scale.log(),
            torch.logit(opacity, eps=least), coefficients[:, 0], coefficients[:, 1:],
            backdrop=backdrop)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Returns copies of the activated values by name; `from_arrays` takes them.

        The backdrop is not among them: `with_sphere` makes Gaussians of it.
        """
        return {name: getattr(self, name).detach().cpu().float().numpy().copy()
                for name in ("means", "quats", "scales", "opacities", "sh")}

    @property
    def sh(self) -> Tensor:
        """Spherical-harmonics coefficients, [N, K, 3]."""
        return torch.cat([self.sh_dc[:, None], with_rows(self.sh_rest, len(self))], dim=1)

    def write(self, path: str | Path, *, title: str | None = None) -> None:
        """Writes a file in the format that its name ends with; one that is there is replaced.

        Formats that round are not checked; `recon convert` does that. `title` is shown by a page
        (.html). FormatError or InputError if it cannot be written, and then nothing is.
        """
        path = Path(path)
        row = check_writable(path)
        if self.sh_degree > row.sh_degree:
            logger.warning("%s has no room for harmonics above degree %d: they are left out",
                           path, row.sh_degree)
        up = None if self.up is None else np.array(UP[self.up])
        settings = WriteSettings(
            up=up, antialiased=self.antialiased, title=title or path.name.partition(".")[0])
        if row.name == "lod":
            discard_levels(path)
        FORMATS[row.name].write(path, self.map(lambda tensor: tensor.detach().cpu()), settings)


def _tensor(name: str, value: Array) -> Tensor:
    try:
        if not isinstance(value, Tensor):
            return torch.from_numpy(np.array(value, np.float32))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is not an array of numbers: {error}.",
                         hint="Give a NumPy array or a tensor.") from error
    return value if value.dtype in (torch.float32, torch.float64) else value.float()


def _check_shapes(values: dict[str, Tensor], n: int) -> None:
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    found = {name: tuple(value.shape) for name, value in values.items()}
    wrong = {name: shape for name, shape in shapes.items() if found[name] != shape}
    sh = found["sh"]
    if len(sh) != 3 or sh[0] != n or sh[1] - 1 not in TERMS or sh[2] != 3:
        wrong["sh"] = (n, 1 + max(TERMS), 3)
    for name, shape in wrong.items():
        raise InputError(
            f"{name} has shape {found[name]}, needed {shape}.",
            hint="sh is [N, K, 3] with K of 1, 4, 9 or 16, or [N, 3] colours." if name == "sh" else
            "means is [N, 3], quats [N, 4], scales [N, 3], opacities [N].")
    kinds = {(value.dtype, value.device) for value in values.values()}
    if len(kinds) > 1:
        raise InputError(
            f"The values are of several types or devices: {', '.join(sorted(map(str, kinds)))}.",
            hint="Convert them with .to(means).")


def _check_ranges(values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        if not bool(torch.isfinite(value).all()):
            raise InputError(f"{name} holds a value that is not finite.",
                             hint="Leave such Gaussians out.")
    if bool((values["scales"] <= 0).any()):
        raise InputError(
            f"scales holds {float(values['scales'].min()):g}, needed are values above 0.",
            hint="Give standard deviations, not their logarithms: numpy.exp(log_scales).")
    opacities = values["opacities"]
    if bool(((opacities < 0) | (opacities > 1)).any()):
        raise InputError(
            f"opacities goes from {float(opacities.min()):g} to {float(opacities.max()):g}, "
            "needed is 0 to 1.", hint="Give opacities after the sigmoid, not logits.")
