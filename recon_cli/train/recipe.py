"""Recipes: when a run does what, as shares of its length. One for each densification strategy.

The reference's constants are those of INRIA's 3DGS; those of the others were found by
measurement (docs/benchmarks.md, "Recipes").
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """The plan of one strategy; shares are of the run's steps.

    Attributes:
        densify_from: share from which Gaussians are added and deleted.
        densify_until: share up to which.
        full_at: share at which the count reaches its cap.
        levels: (share, factor): up to that share images are reduced by the factor.
        sh_at: shares at which the degree of the colours rises by one.
        sh_every: the higher degrees are moved every so many steps.
        opacity_decay: opacities are multiplied by this at each densification.
        resets: opacities are lowered to .01 now and then, as in the reference.
        means_rate: factor of the option of that name, and so on: a run of some thousand steps has
            to go as far as the reference's 30,000.
        scales_rate: likewise.
        sh_rate: likewise.
        means_final: rate of the means at the end, of that at the start; exponential between.
        final_from: share from which all other rates fall.
        final_rate: to which they fall at the end, of their own; exponential.
        noise: of the means, x their rate (MCMC).
        regularize: weight of opacities and scales in the loss (MCMC).
    """

    densify_from: float
    densify_until: float
    full_at: float
    levels: tuple[tuple[float, int], ...]
    sh_at: tuple[float, float, float]
    sh_every: int
    opacity_decay: float
    resets: bool
    means_rate: float = 1.0
    scales_rate: float = 1.0
    sh_rate: float = 1.0
    means_final: float = 0.01
    final_from: float = 1.0
    final_rate: float = 1.0
    noise: float = 0.0
    regularize: float = 0.0


# Kerbl et al. 2023 and INRIA's defaults: 500, 15,000 and 1,000 of 30,000 iterations
REFERENCE = Recipe(
    densify_from=500 / 30_000, densify_until=0.5, full_at=0.5, levels=(),
    sh_at=(1000 / 30_000, 2000 / 30_000, 3000 / 30_000), sh_every=1, opacity_decay=1.0,
    resets=True)
BUDGET = Recipe(
    densify_from=0.03, densify_until=0.6, full_at=0.54, levels=((0.4, 2),),
    sh_at=(0.15, 0.3, 0.45), sh_every=4, opacity_decay=0.99, resets=False, means_rate=6.0,
    scales_rate=2.0, sh_rate=2.0, final_from=0.8, final_rate=0.1)
# Kheradmand et al. 2024 as in gsplat: relocation from 500 of 30,000, noise 5e5, both regularisers
# .01; it ends with the others, so that a pruned branch is not filled up again
MCMC = Recipe(
    densify_from=500 / 30_000, densify_until=0.6, full_at=0.54, levels=BUDGET.levels,
    sh_at=BUDGET.sh_at, sh_every=4, opacity_decay=1.0, resets=False, final_from=0.8,
    final_rate=0.1, noise=5e5, regularize=0.01)
RECIPES = {"reference": REFERENCE, "budget": BUDGET, "mcmc": MCMC}
