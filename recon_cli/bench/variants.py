"""The approximations that are tried: what each leaves out, and how it is rendered."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from recon_cli.render import registry
from recon_cli.render.contract import ALPHA_MIN, EXACT, Approximation, Renderer, RenderOutput
from recon_cli.render.numba import backend as numba_backend
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats


@dataclass(frozen=True)
class Variant:
    """One way to be cheaper, or more careful, than the contract.

    Attributes:
        name: what the tables show.
        approximation: of the rasterizer.
        sh_degree: the harmonics are cut at this degree; None keeps those of the scene.
        half_colors: the SH coefficients are rounded to float16 first. The kernels have no float16
            arithmetic, so this shows an error and can save no time.
    """

    name: str
    approximation: Approximation = field(default=EXACT)
    sh_degree: int | None = None
    half_colors: bool = False

    @property
    def saves_time(self) -> bool:
        """Whether a difference in time means anything."""
        return not self.half_colors


CONTRACT = Variant("contract")
_ALL = (
    Variant("tiles by the 3-sigma square", Approximation(square=True)),
    *(Variant(f"stop at T < {value:g}", Approximation(transmittance_min=value))
      for value in (1e-2, 1e-3, 1e-5)),
    Variant("no early stop", Approximation(transmittance_min=0.0)),
    *(Variant(f"alpha >= {name}", Approximation(alpha_min=factor * ALPHA_MIN))
      for name, factor in (("4/255", 4.0), ("2/255", 2.0), ("1/510", 0.5), ("1/2550", 0.1))),
    *(Variant(f"SH degree {degree}", sh_degree=degree) for degree in (0, 1, 2)),
    Variant("float16 colours", half_colors=True),
)


def variants_for(backend: str, sh_degree: int) -> list[Variant]:
    """Returns the approximations that a backend can draw of a scene with this SH degree."""
    return [
        one for one in _ALL
        if (one.approximation == EXACT or backend == "numba")
        and (one.sh_degree is None or one.sh_degree < sh_degree)]


def renderer_of(variant: Variant, backend: str) -> Renderer:
    """Returns a backend's render function with the variant's approximation built in."""
    if variant.approximation == EXACT:
        draw = registry.renderer(backend)
    else:
        def draw(
            splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
            mask: Tensor | None = None,
        ) -> RenderOutput:
            return numba_backend.render(
                splats, camera, background, sh_degree, scores, mask, variant.approximation)

    def render(
        splats: Splats, camera: Camera, background: Tensor, sh_degree: int, scores: bool,
        mask: Tensor | None = None,
    ) -> RenderOutput:
        if variant.half_colors:
            splats = _rounded(splats)
        return draw(splats, camera, background, _cut(variant, sh_degree), scores, mask)

    return render


def _cut(variant: Variant, sh_degree: int) -> int:
    return sh_degree if variant.sh_degree is None else variant.sh_degree


def _rounded(splats: Splats) -> Splats:
    """Returns splats with colours rounded to float16; gradients pass as through the identity."""
    def through(sh: Tensor) -> Tensor:
        return sh + (sh.detach().half().to(sh.dtype) - sh.detach())

    return Splats(
        splats.means, splats.quats, splats.log_scales, splats.logit_opacities,
        through(splats.sh_dc), through(splats.sh_rest))
