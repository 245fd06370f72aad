"""A view of a model, linearised: J v, J^T u, the curvature of the loss, and conjugate gradients.

A model is one flat vector of its raw parameters (colours of degree 0), one after the other: means,
quaternions, logarithms of the scales, logits of the opacities and base colours.

The loss (1 - w) mean |e| + w (1 - SSIM) is no sum of squares. Its gradient is taken as it is; its
curvature is that of the squares that touch it: |e| <= e^2 / 2|e0| + |e0| / 2 (reweighted least
squares), and w var(e) / B2 of SSIM with the window's variances B2 held, where var(e) of a window is
bounded by the mean of e^2. So W is diagonal, and J^T W J positive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import block_kernels
import gauss_newton_kernels as kernels
import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.kernels.thread_pool import pool
from recon_cli.render.contract import Statistics
from recon_cli.render.numba.loss import MAPS, photometric
from recon_cli.render.numba.view_pass import ImageBuffers, PackedSplats, RenderSettings, ViewPass
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.gradient import blur

Vector = NDArray[np.float32]
SIZES = 3, 4, 3, 1, 3  # numbers of a Gaussian: mean, quaternion, scales, logit, colour
NUMBERS = sum(SIZES)
LEAST_ERROR = 0.02  # of |e| in the weights: below it L1 is taken for a parabola
SSIM_SHARE = 0.3  # of the bound of SSIM's curvature, which low frequencies do not reach
_C2 = 0.03**2


def parts(vector: Vector) -> list[Vector]:
    """Returns views of the five parameters, flat."""
    n = len(vector) // NUMBERS
    return np.split(vector, [n * size for size in np.cumsum(SIZES)[:-1]])


def geometry(vector: Vector) -> list[Vector]:
    """Returns views of all parameters but the colours."""
    return parts(vector)[:4]


def to_vector(splats: Splats) -> Vector:
    """Returns the raw parameters without higher degrees, copied."""
    values = [value.detach().numpy().reshape(-1) for value in splats.parameters().values()]
    return np.concatenate(values[:5]).astype(np.float32)


def to_splats(vector: Vector, like: Splats) -> Splats:
    """Returns splats that share the vector's memory."""
    n = len(vector) // NUMBERS
    means, quats, scales, logits, colors = (torch.from_numpy(part) for part in parts(vector))
    return Splats(means.view(n, 3), quats.view(n, 4), scales.view(n, 3), logits,
                  colors.view(n, 3), torch.zeros(n, 0, 3), backdrop=like.backdrop)


def _packed(vector: Vector) -> PackedSplats:
    return PackedSplats(*parts(vector), np.zeros(0, np.float32), 0)


class LinearizedView:
    """One view at one model; buffers are used again."""

    def __init__(self) -> None:
        self._pass = ViewPass()
        self._statistics = Statistics.zeros(torch.zeros(0, 3))
        self.loss = 0.0

    def render(self, values: Vector, view: TrainView, background: Vector) -> Vector:
        """Renders a model, which must not change before the next call; returns [H * W * 3]."""
        if len(self._statistics.radii) != len(values) // NUMBERS:
            self._statistics = Statistics.zeros(torch.zeros(len(values) // NUMBERS, 3))
        camera, take = view.camera, self._pass.take
        self._camera, self._values = camera, _packed(values)
        size = camera.width * camera.height
        self._image = take("rgb", 3 * size)
        self._pass.forward(
            self._values, camera, RenderSettings(background, 0),
            ImageBuffers(self._image, take("alpha", size), take("nothing", 0)), self._statistics)
        self._all_last = self._pass.last
        return self._image

    def compare(self, view: TrainView, ssim_weight: float, *, weigh: bool = True) -> Vector:
        """Returns the gradient of the loss by the render; fills `loss`, and W if it is asked for.

        W is the diagonal `weights` [H * W * 3].
        """
        rgb, take = self._image, self._pass.take
        truth = np.array(view.image.reshape(-1))
        ignored = None if view.mask is None else np.repeat(~view.mask.reshape(-1), 3)
        if ignored is not None:
            rgb[ignored] = truth[ignored] * np.float32(1 / 255)
        gradient = take("grad_rgb", len(rgb))
        self.loss = photometric(
            rgb, truth, self._camera.width, self._camera.height, ssim_weight,
            maps=take("maps", MAPS * len(rgb)), gradient=gradient)
        if weigh:
            self.weights = self._weigh(truth * np.float32(1 / 255), ssim_weight)
        if ignored is not None:
            gradient[ignored] = 0
            if weigh:
                self.weights[ignored] = 0
        return gradient

    def _weigh(self, photo: Vector, ssim_weight: float) -> Vector:
        rgb = self._image
        weights = (1 - ssim_weight) / np.maximum(np.abs(rgb - photo), LEAST_ERROR)
        if ssim_weight:
            shape = self._camera.height, self._camera.width, 3
            x, y = (torch.from_numpy(image.reshape(shape)).permute(2, 0, 1).contiguous()
                    for image in (rgb, photo))
            mean_x, mean_y, square = blur(torch.stack([x, y, x * x + y * y]))
            spread = square - mean_x * mean_x - mean_y * mean_y + _C2
            bound = blur(1 / spread).permute(1, 2, 0).reshape(-1).numpy()
            weights += 2 * ssim_weight * SSIM_SHARE * bound
        scaled: Vector = weights / np.float32(len(rgb))
        return scaled

    def sample(self, share: float, random: np.random.Generator) -> None:
        """Takes products over so large a share of the patches of pixels from now on."""
        self._pass.last = self._all_last
        if share < 1:
            patches = self._all_last.reshape(-1, kernels.LANES)
            taken = random.random(len(patches)) < share
            self._pass.last = (patches * taken[:, None].astype(np.float32)).reshape(-1)

    def push(self, change: Vector) -> Vector:
        """Returns J v, the change of the render [H * W * 3] with that of the parameters."""
        view, values = self._pass, self._values
        tangents = view.take("tangents", len(view.ids) * kernels.TANGENT)
        pool.run(kernels.project_tangent, view.ids, values.means, values.quats, values.log_scales,
                 values.logit_opacities, view.records, view.view, *parts(change), tangents,
                 scratch=False)
        rgb = view.take("d_rgb", len(self._image))
        pool.run(kernels.composite_tangent, view.tile_start, view.members, view.records, tangents,
                 view.view.width, view.view.height, view.tiles_x, view.cutoff, view.background,
                 view.last, rgb)
        return rgb

    def pull(self, slopes: Vector, out: Vector) -> None:
        """Writes J^T u, the gradient by the parameters, of a gradient by the render."""
        nothing = self._pass.take("nothing", 0)
        self._pass.backward(
            self._values, _packed(out), ImageBuffers(slopes, nothing, nothing), self._statistics,
            details=False, loo=False)

    def add_blocks(self, factor: float, blocks: Vector, colors: Vector) -> None:
        """Adds a multiple of the diagonal blocks of J^T W J, [N * 66], and of the colours'."""
        view, values = self._pass, self._values
        sums = view.take("block_sums", len(view.members) * kernels.BLOCK_SLOT)
        pool.run(kernels.composite_blocks, view.tile_start, view.members, view.slots, view.records,
                 view.view.width, view.view.height, view.tiles_x, view.cutoff, view.background,
                 view.final, view.last, view.met, self.weights, sums)
        pool.run(kernels.project_blocks, view.ids, view.slot_start, sums, values.means,
                 values.quats, values.log_scales, values.logit_opacities, view.records, view.view,
                 factor, blocks, colors, scratch=False)


class Blocks:
    """A block-diagonal matrix: 11 x 11 for a Gaussian's geometry, diagonal for its colours."""

    def __init__(self, n: int) -> None:
        self.geometry = np.zeros(n * block_kernels.TRIANGLE, np.float32)
        self.colors = np.zeros(3 * n, np.float32)

    def decay(self, factor: float) -> None:
        """Multiplies all by a factor."""
        self.geometry *= np.float32(factor)
        self.colors *= np.float32(factor)

    def select_appearance(self) -> Blocks:
        """Returns the entries of opacities and colours alone, zeros elsewhere."""
        result = Blocks(len(self.colors) // 3)
        last = slice(block_kernels.TRIANGLE - 1, None, block_kernels.TRIANGLE)
        result.geometry[last] = self.geometry[last]
        result.colors = self.colors
        return result

    def multiply(self, vector: Vector) -> Vector:
        """Returns the product with a vector."""
        result = vector.copy()
        pool.run(block_kernels.multiply_blocks, self.geometry, *geometry(result), scratch=False)
        parts(result)[4][:] *= self.colors
        return result


def invert(blocks: Blocks, scale: float, ridge: Vector) -> Blocks:
    """Returns the inverse of scale * blocks + diag(ridge).

    `ridge` is a vector like that of the parameters, positive.
    """
    *rows, colors = parts(ridge)
    n = len(colors) // 3
    diagonal = np.concatenate([row.reshape(n, -1) for row in rows], axis=1).reshape(-1)
    inverse = Blocks(n)
    pool.run(block_kernels.invert, blocks.geometry, scale, diagonal, inverse.geometry,
             scratch=False)
    inverse.colors = 1 / (np.float32(scale) * blocks.colors + colors)
    return inverse


def dot(one: Vector, other: Vector) -> float:
    """Returns the inner product, summed in float64."""
    return float(np.dot(one.astype(np.float64), other.astype(np.float64)))


def conjugate_gradients(
    multiply: Callable[[Vector], Vector], right: Vector, solve: Callable[[Vector], Vector],
    products: int, start: Vector | None = None,
) -> Vector:
    """Returns an approximate solution of A x = b by preconditioned conjugate gradients.

    As in Golub and Van Loan, algorithm 11.5.1; `products` counts those with A, one of which a
    `start` other than zero takes.
    """
    x = np.zeros_like(right)
    residual = right.copy()
    if start is not None:
        x, products = start.copy(), products - 1
        residual -= multiply(x)
    z = solve(residual)
    direction, rho = z.copy(), dot(residual, z)
    for _ in range(products):
        image = multiply(direction)
        curvature = dot(direction, image)
        if rho <= 0 or curvature <= 0:
            break
        length = np.float32(rho / curvature)
        x += length * direction
        residual -= length * image
        z = solve(residual)
        rho, before = dot(residual, z), rho
        direction = z + np.float32(rho / before) * direction
    return x


def multiply_views(
    views: Sequence[LinearizedView], change: Vector, share: float
) -> Vector:
    """Returns the mean over views of J^T W J v, from a sampled share of their pixels."""
    total, one = np.zeros_like(change), np.empty_like(change)
    for view in views:
        slopes = view.push(change)
        slopes *= view.weights
        view.pull(slopes, one)
        total += one
    total *= np.float32(1 / (share * len(views)))
    return total
