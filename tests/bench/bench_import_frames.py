"""What training views say of a scene that lies a little beside them.

`python tests/bench/bench_import_frames.py WORKSPACE...`, each with a fresh training. The scene is
turned about the vertical through the mean of the points, moved or scaled; printed are dB above
flat pictures in the mean colours of the views, which `recon import` goes by.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from scipy.spatial.transform import Rotation
from workbench import open_trained, workspaces_argument

from recon_cli.context import StageContext
from recon_cli.export.import_alignment import SOURCE, align_to_views
from recon_cli.render.registry import resolve
from recon_cli.scene.similarity import Similarity

MOVES = [  # degrees, extents, scale
    (0, 0, 1), (1, 0, 1), (3, 0, 1), (10, 0, 1), (45, 0, 1), (0, 0.05, 1), (0, 0.2, 1),
    (0, 0, 1.1), (0, 0, 3)]


@click.command()
@workspaces_argument
def main(workspaces: tuple[Path, ...]) -> None:
    """Prints a line for each workspace and move."""
    backend, device = resolve("auto", "cpu")
    ctx = StageContext(backend=backend, device=device)
    for root in workspaces:
        _, scene, splats = open_trained(root)
        middle = scene.points.mean(axis=0)
        for degrees, extents, scale in MOVES:
            turn = Rotation.from_rotvec([0, 0, np.radians(degrees)]).as_matrix()
            away = middle - scale * turn @ middle + [extents * scene.extent, 0, 0]
            found = align_to_views(splats, scene, Similarity(scale, turn, away), SOURCE, 400, ctx)
            click.echo(f"{root.name}: turned {degrees} degrees, moved {extents} extents, "
                       f"{scale}x: {found.psnr_db[SOURCE] - found.flat_db:+.1f} dB")


if __name__ == "__main__":
    main()
