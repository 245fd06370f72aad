"""How near a mesh comes to a room whose depth is known.

`PYTHONPATH=. python tests/bench/bench_mesh.py WORKSPACE ROOM [--video]` with a workspace that was
trained on ROOM (living, office) with its poses, or from its video alone: then the mesh is moved by
the similarity of its cameras to the true ones. For each way to take the depth it prints
F-scores, precision and recall at 5 and 2 cm, triangles, seconds, CPU seconds and peak memory. The
reference are the exact depth maps, fused at 3 cm; 1.5 cm are allowed for that spacing, and only
what at least three training views show counts for the recall. Exact depth is there for every fifth
view of the path and for the test views: its recall is also printed for what three of those show.
A second table says how much of the room's walls, floor and ceiling (where they are, not furniture
before them) three training views show, how much of that stays open, with no surface within 5 cm,
without and with inferred surface, and how much of that surface lies near the truth.
Nothing is chosen here by test views: their exact depth is part of the reference alone.
"""

from __future__ import annotations

import dataclasses
import json
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import click
import cv2
import numpy as np
from numpy.typing import NDArray
from pose_errors import similarity
from scipy.spatial import cKDTree
from workbench import numba_context, open_trained, print_head, print_row, workspace_argument

from recon_cli.io.views import load_views
from recon_cli.room import mesh as build
from recon_cli.room.depth_maps import DepthMaps, render_depth_maps, weigh, weigh_by_agreement
from recon_cli.room.volume import extract, fuse, pixel_rays
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene
from recon_cli.scene.train_view import TrainView

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "data" / "rooms"
SPACING, DENSE = 0.03, 0.01  # metres
SAMPLES = 400_000
THRESHOLDS = (0.05, 0.02)
ON_WALL = 0.02  # metres, within which a point is one of a wall, floor or ceiling


def exact_depths(room: Path) -> list[tuple[NDArray[np.float32], NDArray[np.float64]]]:
    """Returns depth [H, W] in metres and viewmat [4, 4] of every view that has an exact depth."""
    rows = []
    for folder in (room, room / "test"):
        poses = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
        rows += [(cv2.imread(str(path), -1).astype(np.float32) / 6553.5,
                  np.linalg.inv(poses[int(path.stem[5:])]))
                 for path in sorted((folder / "results").glob("depth*.png"))]
    return rows


def thinned(points: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Returns in every cell of a grid the point that is nearest to the mean of all."""
    cells = np.floor(points / spacing).astype(np.int64)
    _, rows, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    rows = rows.reshape(-1)
    means = np.stack([np.bincount(rows, column) for column in points.T], 1) / counts[:, None]
    order = np.lexsort((np.linalg.norm(points - means[rows], axis=1), rows))
    return points[order[np.searchsorted(rows[order], np.arange(len(counts)))]]


def reference(
    room: Path, camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points of all exact depth maps, 3 cm and 1 cm apart; `camera` has their size."""
    clouds = []
    for depth, viewmat in exact_depths(room):
        own = dataclasses.replace(camera, viewmat=viewmat)
        places = pixel_rays(own) * depth[..., None] @ viewmat[:3, :3] + own.center
        clouds.append(places[depth > 0])
    every = np.concatenate(clouds)
    return thinned(every, SPACING), thinned(every, DENSE)


def shown_by(
    cameras: Sequence[Camera], points: NDArray[np.float64], dense: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Returns which points at least three views show, none of the dense ones being before them."""
    views = np.zeros(len(points), int)
    for camera in cameras:
        small = camera.resized(150, 85)
        depth, inside, at = project(small, dense)
        nearest = np.full(small.width * small.height, np.inf)
        np.minimum.at(nearest, at[inside], depth[inside])
        depth, inside, at = project(small, points)
        views += inside & (depth <= 1.02 * nearest[at] + 0.03)
    return views >= 3


def project(
    camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.int64]]:
    """Returns depths, which points are in the image, and their pixels."""
    x, y, z = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
    with np.errstate(all="ignore"):
        u = np.floor(camera.fx * x / z + camera.cx)
        v = np.floor(camera.fy * y / z + camera.cy)
    inside = (z > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    return z, inside, np.where(inside, v * camera.width + u, 0).astype(np.int64)


def sampled(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], float]:
    """Returns points evenly over triangles, and the area of the triangles."""
    generator = np.random.default_rng(0)
    a, b, c = np.swapaxes(vertices[faces], 0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rows = generator.choice(len(faces), SAMPLES, p=areas / areas.sum())
    r, s = np.sqrt(generator.random((SAMPLES, 1))), generator.random((SAMPLES, 1))
    return (a[rows] * (1 - r) + b[rows] * r * (1 - s) + c[rows] * r * s,
            float(areas.sum()) / 2)


def wall_points(room: Path, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the points [W, 3] that are of walls, floor and ceiling, one in 3 cm of each."""
    kept = []
    for axis, length in enumerate(json.loads((room / "meta.json").read_text())["size_m"]):
        for offset in (0.0, length):
            wall = points[np.abs(points[:, axis] - offset) < ON_WALL]
            cells = np.floor(np.delete(wall, axis, axis=1) / SPACING).astype(np.int64)
            kept.append(wall[np.unique(cells, axis=0, return_index=True)[1]])
    return np.concatenate(kept)


def print_walls(
    walls: NDArray[np.float64], points: NDArray[np.float64], result: build.MeshResult,
    moved: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> None:
    """Prints what of the walls that three views show stays open, and what was closed.

    `walls` [W, 3] are points of walls, `points` [P, 3] of everything that can be seen.
    """
    click.echo()
    print_head("walls, m2", "open", "open with inferred surface", "of that closed",
               "inferred, m2", "within 5 cm", "within 10 cm")
    surface, _ = sampled(moved(result.mesh.vertices), result.mesh.faces)
    far = _is_far(walls, surface)
    cells = [f"{len(walls) * SPACING**2:.1f}", f"{far.mean():.3f}"]
    if result.inferred is not None:
        inferred, area = sampled(moved(result.inferred.vertices), result.inferred.faces)
        left = far & _is_far(walls, inferred)
        errors = cKDTree(points).query(inferred, distance_upper_bound=0.3)[0]
        cells += [f"{left.mean():.3f}", f"{1 - left.sum() / far.sum():.2f}", f"{area:.2f}",
                  *(f"{(errors <= limit + SPACING / 2).mean():.3f}" for limit in (0.05, 0.1))]
    print_row(*cells)


def _is_far(points: NDArray[np.float64], surface: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns which points have no surface within the first threshold."""
    return np.asarray(cKDTree(surface).query(
        points, distance_upper_bound=0.3)[0] > THRESHOLDS[0])


def f_scores(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], points: NDArray[np.float64],
    shown: NDArray[np.bool_],
) -> str:
    """Returns F-score, precision and recall at each threshold as cells of a table."""
    samples, _ = sampled(vertices, faces)
    to_reference = cKDTree(points).query(samples, distance_upper_bound=0.3)[0]
    to_mesh = cKDTree(samples).query(points[shown], distance_upper_bound=0.3)[0]
    cells = []
    for threshold in THRESHOLDS:
        precision = float((to_reference <= threshold + SPACING / 2).mean())
        recall = float((to_mesh <= threshold).mean())
        cells.append(f"{2 * precision * recall / (precision + recall):.3f} "
                     f"({precision:.3f}, {recall:.3f})")
    return " | ".join(cells)


def true_scene(
    scene: Scene, room: Path
) -> tuple[Scene, Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
    """Returns a scene of a video with the true cameras, and what moves its places to theirs."""
    poses = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)
    true = [poses[int(Path(view.name).stem)] for view in scene.train]
    ours = np.stack([view.camera.center for view in scene.train])
    scale, motion = similarity(np.stack([pose[:3, 3] for pose in true]), ours)
    moved = tuple(dataclasses.replace(view, camera=Camera(
        600, 340, 300.0, 300.0, 300.0, 170.0, np.linalg.inv(pose)))
        for view, pose in zip(scene.train, true, strict=True))
    return dataclasses.replace(scene, train=moved), lambda places: (
        places - motion[:3, 3]) @ motion[:3, :3] / scale


def copy(maps: DepthMaps) -> DepthMaps:
    """Returns maps that may be changed."""
    return dataclasses.replace(
        maps, depths=list(maps.depths), gains=[gain.copy() for gain in maps.gains])


@click.command()
@workspace_argument
@click.argument("room")
@click.option("--threads", default=2, show_default=True)
@click.option("--triangles", default=300_000, show_default=True)
@click.option("--size", default=600, show_default=True, help="Longest side of the images.")
@click.option("--video", is_flag=True, help="The workspace was made from the video of ROOM.")
@click.option("--short", is_flag=True, help="Only the whole export.")
def main(
    workspace: Path, room: str, threads: int, triangles: int, size: int, video: bool, short: bool
) -> None:
    """Prints the table."""
    _, scene, splats = open_trained(workspace)
    ctx = numba_context(threads)
    true, moved = true_scene(scene, ROOMS / room) if video else (scene, lambda places: places)
    points, dense = reference(ROOMS / room, true.train[0].camera)
    shown = shown_by([view.camera for view in true.train], points, dense)
    print_head("depth", "F (precision, recall) at 5 cm", "at 2 cm", "triangles", "s", "CPU s", "MB")

    def row(
        name: str, make: Callable[[], tuple[NDArray[np.float64], NDArray[np.int64]]],
        shown: NDArray[np.bool_] = shown,
    ) -> None:
        start, cpu = time.perf_counter(), time.process_time()
        vertices, faces = make()
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        scores = f_scores(moved(vertices), faces, points, shown)
        print_row(name, scores, f"{len(faces):,}", f"{seconds:.1f}", f"{cpu:.1f}", f"{peak:.0f}")

    views = load_views(scene.train, size, "not used")

    def fused(some: DepthMaps, *, agreement: bool) -> tuple[
            NDArray[np.float64], NDArray[np.int64]]:
        if agreement:
            weigh_by_agreement(some)
        voxel, farthest = build._fit_voxel(some, None, ctx)
        return extract(fuse(some, voxel, farthest))

    results: list[build.MeshResult] = []

    def exported() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        results.append(build.build_mesh(
            splats, views, None, ctx, max_triangles=triangles, infer=True))
        return results[0].mesh.vertices, results[0].mesh.faces

    row("whole export, with rendering and stereo", exported)
    walls = wall_points(ROOMS / room, points[shown])
    if short:
        print_walls(walls, points, results[0], moved)
        return

    maps = render_depth_maps(splats, views, "numba")
    row("median along the ray, fused", lambda: fused(copy(maps), agreement=False))
    row("and weighed by agreement", lambda: fused(copy(maps), agreement=True))

    def without_stereo() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        mesh = build.mesh_of(copy(maps), None, ctx, max_triangles=triangles).mesh
        return mesh.vertices, mesh.faces

    row("and only what views show: all but stereo", without_stereo)

    if not video:
        rows = exact_depths(ROOMS / room)
        cameras = [dataclasses.replace(scene.train[0].camera, viewmat=pose) for _, pose in rows]

        def exact() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
            depths = [depth for depth, _ in rows]
            blank = [TrainView(camera, np.zeros((camera.height, camera.width, 3), np.uint8))
                     for camera in cameras]
            whole = weigh(blank, cameras, depths, [np.ones_like(depth) for depth in depths])
            mesh = build.mesh_of(whole, None, ctx, max_triangles=triangles).mesh
            return mesh.vertices, mesh.faces

        row("exact depth of a fifth of the views, the same way", exact)
        row("the same, where three of those views look", exact, shown_by(cameras, points, dense))

    print_walls(walls, points, results[0], moved)


if __name__ == "__main__":
    main()
