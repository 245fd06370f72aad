"""How well the expected error agrees with the real one on held-out views, and what it costs.

    python tests/bench/bench_trust.py WORKSPACE...

AUSE is the area to the oracle's sparsification curve, of absolute errors over the mean of a view;
the last two AUSE columns say how low it can get: by the mean of the real errors in 5x5 pixels, and
by chance. Held-out views calibrate nothing. The cost is the processor time of the pass over the
training views and of the calibration, over that of the training; `recon eval` takes it, and
training none.
"""

from __future__ import annotations

import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from collections.abc import Sequence
from pathlib import Path
from time import process_time

import click
import cv2
import numpy as np
from workbench import numba_context, open_trained, print_head, print_row, workspaces_argument

from recon_cli.evaluation.reference_views import RenderedModel, load_reference_views
from recon_cli.io.views import ReferenceView
from recon_cli.machine import usable_threads
from recon_cli.train.fit.runner import seconds_at
from recon_cli.trust.agreement import ause
from recon_cli.trust.error_model import picture_terms
from recon_cli.trust.scene_trust import Trust, measure_trust, model_trust
from recon_cli.trust.support import error_image
from recon_cli.trust.surface import find_cells, surface_shares


def bounds(
    model: RenderedModel, trust: Trust, views: Sequence[ReferenceView]
) -> tuple[float, float]:
    """Returns the AUSE of the real error's local mean, and of a random order."""
    rng, areas = np.random.default_rng(0), []
    for view in views:
        picture = picture_terms(model, trust.support, view.camera)
        error = error_image(picture.rgb, view, gains=False)[0]
        flat = error.ravel().astype(np.float64)
        areas.append(ause(flat, cv2.blur(error, (5, 5)).ravel(), rng.random(len(flat))))
    low, high = np.mean(areas, axis=0)
    return float(low), float(high)


@click.command()
@workspaces_argument
def main(workspaces: Sequence[Path]) -> None:
    """Print AUSE, reliability, the surface's shares and the cost of each workspace."""
    plots = []
    print_head("workspace", "views", "AUSE", "opacity", "depth", "5x5 means", "random",
               "gap of bins", "well seen", "few", "CPU s", "of training")
    for workspace in workspaces:
        config, scene, splats = open_trained(workspace)
        ctx = numba_context(usable_threads())
        start = process_time()
        model = RenderedModel(splats, config.sh_degree, "numba")
        trust = measure_trust(model, scene, config, config.max_size, ctx)
        took = process_time() - start
        views = load_reference_views(scene.test, config.max_size, ctx)
        surface = surface_shares(find_cells(splats, trust.support))
        row = model_trust(trust, model, surface, views, gains=config.exposure == "on")
        agreement, (low, high) = row.agreement, bounds(model, trust, views)
        assert agreement is not None
        trained = seconds_at(workspace / "train" / 1 << 62, clock="cpu_seconds")
        areas = (agreement.ause, agreement.ause_opacity, agreement.ause_depth, low, high)
        print_row(
            workspace.name, str(agreement.views), *(f"{area:.3f}" for area in areas),
            f"{agreement.gap:.0%}", f"{row.surface.well:.0%}", f"{row.surface.few:.0%}",
            f"{took:.1f}", f"{took / max(trained, 1e-9):.1%}")
        plots.append(f"\n{workspace.name}: bias {trust.error.bias:.2f}, weights "
                     f"{ {k: round(v, 2) for k, v in trust.error.weights.items()} }\n" + "\n".join(
            f"  expected {expected:.4f} real {real:.4f} ratio {expected / real:.2f}"
            for expected, real in zip(agreement.expected, agreement.real, strict=True)))
    click.echo("\n".join(plots))


if __name__ == "__main__":
    main()
