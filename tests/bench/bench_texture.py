"""What a mesh shows of held-out photos, with a colour for each vertex and with a texture.

`PYTHONPATH=. python tests/bench/bench_texture.py WORKSPACE [--mesh FILE.npz]` with a trained
workspace. It prints the mean PSNR in the pixels that the mesh shows, also with a gain for each
photo and channel, which an exposure that drifts needs, and what the texture took;
`--mesh` keeps the mesh, which takes most of the time, for the next run.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from workbench import numba_context, open_trained, print_head, print_row, workspace_argument

from recon_cli.io.mesh_data import Mesh
from recon_cli.io.views import load_views
from recon_cli.room.charts import Charts
from recon_cli.room.mesh import build_mesh
from recon_cli.room.texture import Drawn, add_texture, draw_mesh, halve, shade_mesh
from recon_cli.room.texture_kernels import COLUMNS, WEIGHT
from recon_cli.scene.camera import Camera
from recon_cli.stereo.depths import camera_row


def vertex_colors(mesh: Mesh, camera: Camera, drawn: Drawn) -> NDArray[np.float64]:
    """Returns the colours [P, 3] of the pixels that show the mesh, mixed from its corners."""
    rows, columns = np.nonzero(drawn.owners >= 0)
    corners = mesh.faces[drawn.owners[rows, columns]]
    rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx,
                     (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(rows))], axis=1)
    places = rays / drawn.nearness[rows, columns][:, None]
    a, b, c = np.swapaxes((mesh.vertices @ camera.viewmat[:3, :3].T
                           + camera.viewmat[:3, 3])[corners], 0, 1)
    normal = np.cross(b - a, c - a)
    square = (normal * normal).sum(axis=1)
    second = (np.cross(places - a, c - a) * normal).sum(axis=1) / square
    third = (np.cross(b - a, places - a) * normal).sum(axis=1) / square
    weights = np.stack([1 - second - third, second, third], axis=1).clip(0, 1)
    weights /= weights.sum(axis=1, keepdims=True)
    return (mesh.colors[corners] * weights[..., None]).sum(axis=1)


def texture_colors(mesh: Mesh, camera: Camera, drawn: Drawn) -> NDArray[np.float64]:
    """Returns the same from a texture."""
    assert mesh.texture is not None
    row = np.zeros(COLUMNS)
    row[:WEIGHT] = camera_row(camera)
    charts = Charts(np.arange(len(mesh.vertices)), mesh.faces,
                    mesh.texture.corners * len(mesh.texture.image), 1)
    image = shade_mesh(row, mesh.vertices, charts, drawn, halve(mesh.texture.image),
                       np.zeros((*drawn.owners.shape, 3), np.float32))
    return image[drawn.owners >= 0].astype(np.float64)


def psnr(colors: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Returns the PSNR of colours of 0 to 255 in dB."""
    return float(10 * np.log10(255**2 / ((colors - truth) ** 2).mean()))


def like(
    colors: NDArray[np.float64], truth: NDArray[np.float64], counts: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Returns colours with the gain of each channel that brings them nearest to a photo."""
    own, other = colors[counts], truth[counts]
    return colors * ((own * other).sum(axis=0) / np.maximum((own * own).sum(axis=0), 1e-9))


@click.command()
@workspace_argument
@click.option("--threads", default=2, show_default=True)
@click.option("--size", default=4096, show_default=True, help="Texels of a side.")
@click.option("--max-size", type=int, help="Longest side of the images.  [default: as trained]")
@click.option("--mesh", "kept", type=click.Path(path_type=Path), help="Keep the mesh here.")
def main(
    workspace: Path, threads: int, size: int, max_size: int | None, kept: Path | None
) -> None:
    """Prints the table."""
    config, scene, splats = open_trained(workspace)
    ctx = numba_context(threads)
    max_size = max_size or config.max_size
    views = load_views(scene.train, max_size, "not used", denoised=True)
    if kept is not None and kept.exists():
        found = np.load(kept)
        mesh = Mesh(found["vertices"], found["faces"], found["colors"])
    else:
        mesh = build_mesh(splats, views, None, ctx, max_triangles=300_000).mesh
        if kept is not None:
            np.savez(kept, vertices=mesh.vertices, faces=mesh.faces, colors=mesh.colors)
    start = time.process_time()
    textured = add_texture(mesh, views, size, "png", ctx.progress)
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    scores = []
    for view in load_views(scene.test, max_size, "not used"):
        drawn = draw_mesh(view.camera, mesh.vertices, mesh.faces)
        shown = drawn.owners >= 0
        counts = np.ones(shown.sum(), bool) if view.mask is None else view.mask[shown]
        truth = view.image[shown].astype(np.float64)
        both = (vertex_colors(mesh, view.camera, drawn),
                texture_colors(textured, view.camera, drawn))
        scores.append([[psnr(shade[counts], truth[counts]) for shade in shades]
                       for shades in (both, [like(each, truth, counts) for each in both])])
    print_head("photos", "vertex colours, dB", "texture, dB", "gain", "least", "CPU s", "peak MB")
    for name, rows in zip(("as filmed", "with a gain each"), np.swapaxes(scores, 0, 1),
                          strict=True):
        by_vertex, by_texture = rows.mean(axis=0)
        least = (rows[:, 1] - rows[:, 0]).min()
        print_row(f"{len(rows)}, {name}", f"{by_vertex:.2f}", f"{by_texture:.2f}",
                  f"{by_texture - by_vertex:+.2f}", f"{least:+.2f}", f"{seconds:.1f}",
                  f"{peak:.0f}")


if __name__ == "__main__":
    main()
