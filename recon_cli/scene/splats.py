"""Gaussians as raw parameters: selected, joined, and moved to another world frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.scene.backdrop import SPHERE_OPACITY, Backdrop, enclosing
from recon_cli.scene.harmonics import rotate_sh
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splat_arrays import EXTENT_SIGMAS as EXTENT_SIGMAS
from recon_cli.scene.splat_arrays import LEAST_OPACITY as LEAST_OPACITY
from recon_cli.scene.splat_arrays import MOST_OPACITY as MOST_OPACITY
from recon_cli.scene.splat_arrays import SH_C0 as SH_C0
from recon_cli.scene.splat_arrays import TERMS as TERMS
from recon_cli.scene.splat_arrays import SplatArrays


@dataclass(eq=False)
class Splats:
    """N Gaussians in the raw parameters that are optimized and stored.

    Only what colours use is stored: the scene's degree sets T, and the first M Gaussians are those
    that have coefficients of degrees 1 and up. The others are of degree 0.
    """

    means: Tensor  # [N, 3] centres in world units
    quats: Tensor  # [N, 4] rotations, wxyz, of any length; zeros stand for no rotation
    log_scales: Tensor  # [N, 3] natural logarithm of the standard deviations along the own axes
    logit_opacities: Tensor  # [N] opacity before the sigmoid
    # [N, 3] spherical-harmonics coefficients of degree 0; colour = SH_C0 * sh_dc + 0.5
    sh_dc: Tensor
    # [M, T, 3] coefficients of degrees 1 and up of the first M Gaussians, 0 <= M <= N and T one of
    # 0, 3, 8, 15
    sh_rest: Tensor
    # behind all of them; None is black
    backdrop: Backdrop | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        shapes = {
            "means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,),
            "sh_dc": (n, 3)}
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, needed {shape}")
        rest = tuple(self.sh_rest.shape)
        if len(rest) != 3 or rest[0] > n or rest[1] not in TERMS or rest[2] != 3:
            raise ValueError(
                f"sh_rest has shape {rest}, needed (M, T, 3) with M <= {n} and T of {TERMS}")
        for name, tensor in self.parameters().items():
            if tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise ValueError(f"{name} differs from means in dtype or device")

    @classmethod
    def from_parameters(
        cls, parameters: Mapping[str, Tensor], backdrop: Backdrop | None = None
    ) -> Self:
        """Returns splats of the raw parameters by name; ValueError where shapes disagree."""
        return cls(*(parameters[name] for name in PARAMETERS), backdrop=backdrop)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def parameters(self) -> dict[str, Tensor]:
        """Returns the raw parameters by name, in declaration order; no copies."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def as_arrays(self) -> SplatArrays:
        """Returns the raw parameters as float32 arrays, detached and on the CPU."""
        return SplatArrays(*(value.detach().cpu().float().numpy()
                             for value in self.parameters().values()), backdrop=self.backdrop)

    def as_tensors(self) -> Self:
        """Returns the same, as `SplatArrays.as_tensors` does of arrays."""
        return self

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Returns splats whose every parameter went through `change`."""
        changed: dict[str, Any] = {
            name: change(value) for name, value in self.parameters().items()}
        return replace(self, **changed)

    def select(self, rows: Tensor) -> Self:
        """Returns the Gaussians at `rows` ([K] indices or [N] mask), detached, in that order.

        Raises:
            ValueError: the order puts a Gaussian of degree 0 before one with coefficients; no
                mask and no ascending rows do.
        """
        if rows.dtype == torch.bool:
            rows = torch.nonzero(rows)[:, 0]
        rows = torch.where(rows < 0, rows + len(self), rows)
        colored = rows < len(self.sh_rest)
        count = int(colored.sum())
        if not bool(colored[:count].all()):
            raise ValueError("rows put Gaussians of degree 0 before some that have coefficients")
        taken: dict[str, Any] = {
            name: value.detach()[rows[:count] if name == "sh_rest" else rows]
            for name, value in self.parameters().items()}
        return replace(self, **taken)

    def within(self, center: Sequence[float], distance: float) -> Tensor:
        """Returns which centres lie within `distance` of `center` [3], [N] bool."""
        apart: Tensor = (self.means.detach() - self.means.new_tensor(center)).norm(dim=1)
        return apart <= distance

    def with_degree(self, degree: int) -> Self:
        """Returns the splats with coefficients of this degree: cut, or filled up with zeros."""
        return replace(self, sh_rest=with_terms(self.sh_rest, TERMS[degree]))

    def with_sphere(self, largest: float = math.inf) -> Self:
        """Returns the splats with their backdrop as Gaussians, behind all others and last.

        Where a file holds scales up to `largest` only, there are more of them.
        """
        if self.backdrop is None:
            return self
        positions, scale = self.backdrop.sphere(self.means.detach().cpu().numpy(), largest)
        n, values = len(positions), self.means.new_tensor
        sphere = replace(
            self, means=values(positions), quats=values([[1.0, 0, 0, 0]]).repeat(n, 1),
            log_scales=values([[math.log(scale)] * 3]).repeat(n, 1),
            logit_opacities=torch.logit(values([SPHERE_OPACITY])).repeat(n),
            sh_dc=((values([self.backdrop.color]) - 0.5) / SH_C0).repeat(n, 1),
            sh_rest=self.sh_rest[:0], backdrop=None)
        return joined([replace(self, backdrop=None), sphere])[0]

    @property
    def background(self) -> Tensor:
        """The colour behind all Gaussians, [3] in [0, 1]."""
        return self.means.new_tensor(
            (0.0, 0.0, 0.0) if self.backdrop is None else self.backdrop.color)

    @property
    def sh_degree(self) -> int:
        """The scene's degree, 0 to 3: that of the Gaussians that have coefficients."""
        return TERMS.index(self.sh_rest.shape[1])

    @property
    def scales(self) -> Tensor:
        """Standard deviations along the own axes, [N, 3], world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities in (0, 1), [N]."""
        return torch.sigmoid(self.logit_opacities)


S = TypeVar("S", bound=Splats)
PARAMETERS = tuple(item.name for item in fields(Splats) if item.name != "backdrop")


def with_terms(sh_rest: Tensor, terms: int) -> Tensor:
    """Returns coefficients [M, T, 3] as [M, terms, 3]: cut, or filled up with zeros."""
    missing = terms - sh_rest.shape[1]
    if missing <= 0:
        return sh_rest[:, :terms]
    return torch.cat([sh_rest, sh_rest.new_zeros(len(sh_rest), missing, 3)], dim=1)


def with_rows(sh_rest: Tensor, rows: int) -> Tensor:
    """Returns coefficients [M, T, 3] as [rows, T, 3], rows >= M, filled up with zeros."""
    missing = sh_rest.new_zeros(rows - len(sh_rest), *sh_rest.shape[1:])
    return torch.cat([sh_rest, missing])


def joined(parts: Sequence[S]) -> tuple[S, Tensor]:
    """Returns the Gaussians of all parts, those with coefficients first, and their order.

    The order is the row [N] of each in the plain concatenation of the parts. The backdrop is
    that of the first which has one, for all cameras.

    Raises:
        ValueError: the parts are of different degrees.
    """
    colored = torch.cat([
        torch.arange(len(part), device=part.means.device) < len(part.sh_rest) for part in parts])
    order = torch.cat([torch.nonzero(colored)[:, 0], torch.nonzero(~colored)[:, 0]])
    if len({part.sh_degree for part in parts}) > 1:
        raise ValueError("the parts are of different SH degrees; see with_degree")
    together = {name: torch.cat([part.parameters()[name] for part in parts])
                for name in parts[0].parameters()}
    rest = together.pop("sh_rest")  # in that order already
    rows: dict[str, Any] = {name: value[order] for name, value in together.items()}
    backdrop = enclosing([part.backdrop for part in parts])
    return replace(parts[0], **rows, sh_rest=rest, backdrop=backdrop), order


def transformed(splats: Splats, similarity: Similarity) -> Splats:
    """Returns the same Gaussians in the new world: a moved camera sees the same image.

    Computed in float64. Parameters that the similarity leaves alone keep their bits: a change of
    scale touches neither rotations nor colours. Quaternions keep their length, except zeros, which
    stand for no rotation and become unit quaternions.
    """
    device = splats.means.device
    rotation = torch.from_numpy(np.asarray(similarity.rotation, np.float64)).to(device)
    translation = torch.from_numpy(np.asarray(similarity.translation, np.float64)).to(device)
    means = similarity.scale * (splats.means.double() @ rotation.T) + translation
    log_scales = splats.log_scales.double() + math.log(similarity.scale)
    quats, sh_rest = splats.quats, splats.sh_rest
    if not np.array_equal(similarity.rotation, np.eye(3)):
        quats = _rotate_quats(quats, similarity.rotation)
        sh_rest = rotate_sh(sh_rest, similarity.rotation)
    return Splats(
        means.to(splats.means.dtype), quats, log_scales.to(splats.log_scales.dtype),
        splats.logit_opacities, splats.sh_dc, sh_rest,
        backdrop=None if splats.backdrop is None else splats.backdrop.moved(similarity))


def _rotate_quats(quats: Tensor, rotation: NDArray[np.float64]) -> Tensor:
    """Returns quaternions [N, 4] wxyz after a rotation: the product q(rotation) * quats."""
    w, *vector = quaternion(rotation)
    turn = torch.tensor([w, *vector], dtype=torch.float64, device=quats.device)
    none = quats.new_tensor([1.0, 0, 0, 0])
    valid = torch.where((quats == 0).all(-1, keepdim=True), none, quats).double()
    axis, own = turn[1:].expand(len(quats), 3), valid[:, 1:]
    real = turn[0] * valid[:, :1] - (axis * own).sum(-1, keepdim=True)
    imaginary = turn[0] * own + valid[:, :1] * axis + torch.linalg.cross(axis, own)
    return torch.cat([real, imaginary], dim=-1).to(quats.dtype)


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the unit quaternion [4], wxyz with w >= 0, of a rotation [3, 3].

    Bar-Itzhack 2000, "New Method for Extracting the Quaternion from a Rotation Matrix": the
    eigenvector of the greatest eigenvalue, which is as exact for half turns as for none.
    """
    r = np.asarray(rotation, np.float64)
    trace = np.trace(r)
    k = np.empty((4, 4))
    k[0, 0] = trace
    k[0, 1:] = k[1:, 0] = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    k[1:, 1:] = r + r.T - trace * np.eye(3)
    vector: NDArray[np.float64] = np.linalg.eigh(k)[1][:, -1]
    return vector if vector[0] >= 0 else -vector
