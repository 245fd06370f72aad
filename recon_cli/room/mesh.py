"""The mesh of a scene: depth maps, their fusion, and the cleaned surface.

A triangle stays where a view shows it: rims of the truncation band, backs of walls and layers
behind others are seen by none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recon_cli.context import StageContext
from recon_cli.errors import ReconstructionError, name_command
from recon_cli.io.meshes import Mesh, simplify
from recon_cli.kernels.thread_pool import pool
from recon_cli.kernels.viewpoint import viewpoint
from recon_cli.machine import free_memory_bytes
from recon_cli.room.depth_maps import DepthMaps, render_depth_maps, weigh_by_agreement
from recon_cli.room.inferred import infer_surface
from recon_cli.room.kernels import SEEN_THROUGH, SHOWN, observe
from recon_cli.room.mesh_planes import surface_planes, vertex_normals
from recon_cli.room.planes import Plane
from recon_cli.room.sensor_depths import with_sensor
from recon_cli.room.stereo_depths import with_stereo
from recon_cli.room.texture import TOLERANCE
from recon_cli.room.volume import BYTES, extract, find_blocks, fuse
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView

# Voxels in the median depth of all pixels, or as many as there are pixels in the focal length of
# small images: 2 cm in rooms seen from 2.6 m.
_RESOLUTION = 128.0
# Pixels that a voxel spans at least, beyond which depth says too little; and median depths.
_LEAST_PIXELS, _FARTHEST = 0.75, 4.0
_COARSER = 1.26  # of the voxel, for half the blocks to the area
_MOST_COARSER = 8.0  # times; a mesh of a room in voxels of 16 cm is none
_MOST_BYTES = 1_000_000_000  # of the volume
_SHARE = 0.3  # of the free memory that the volume may take
_LEAST_ISLAND = 50.0  # voxel faces; 2 dm^2 in rooms


@dataclass(frozen=True, eq=False)
class MeshResult:
    """A mesh and how it was made."""

    mesh: Mesh
    voxel: float  # world units
    triangles_before: int  # before they were simplified
    planes: list[tuple[Plane, Plane | None]]  # if looked for: large ones, also confirmed
    inferred: Mesh | None = None  # surface that closes holes in planes, if there is any

    def describe(self) -> str:
        """Returns triangles and voxels as part of a sentence."""
        triangles = len(self.mesh.faces) + (len(self.inferred.faces) if self.inferred else 0)
        count = f"{triangles:,} triangles"
        if self.triangles_before > triangles:
            count += f" of {self.triangles_before:,}"
        return f"{count}, made in voxels of {self.voxel:.3g} units"


def build_mesh(
    splats: Splats, views: Sequence[TrainView], points: NDArray[np.float64] | None,
    ctx: StageContext, *, max_triangles: int, voxel: float | None = None, infer: bool = False,
) -> MeshResult:
    """Returns the mesh of the surfaces that the views show.

    Args:
        splats: on the device of `ctx`.
        views: at least one, with cameras in the world of the splats, and sensor depth in its units.
        points: [P, 3] triangulated points, which confirm the planes that a room is measured by;
            None if it is not measured.
        ctx: backend, threads, progress, and notices.
        max_triangles: at most, of what views show and what closes holes together.
        voxel: side of a voxel in world units; None for 1/128 of the median depth.
        infer: whether to close holes in large planes.

    ReconstructionError if no surface is found, or it does not fit into memory.
    """
    with ctx.progress.bar("depth", len(views), unit="view") as bar:
        maps = render_depth_maps(splats, views, ctx.backend, bar.advance)
    if not maps.median > 0:
        raise ReconstructionError(
            "There is no surface to make a mesh of: no view shows an opaque one.",
            hint=f"Train longer, or look at the scene with {name_command('view')}.")
    if len(views) > 1:
        means = splats.means.detach().cpu().numpy().astype(np.float64)
        maps = with_stereo(maps, (means.min(axis=0), means.max(axis=0)), ctx.progress)
    maps = with_sensor(maps)
    with ctx.progress.bar("mesh", len(maps.views), unit="view") as bar:
        return mesh_of(maps, points, ctx, max_triangles=max_triangles, voxel=voxel,
                       infer=infer, on_view=bar.advance)


def mesh_of(
    maps: DepthMaps, points: NDArray[np.float64] | None, ctx: StageContext, *, max_triangles: int,
    voxel: float | None = None, infer: bool = False, on_view: Callable[[], None] = lambda: None,
) -> MeshResult:
    """Returns the mesh of depth maps; see `build_mesh`."""
    weigh_by_agreement(maps)
    voxel, farthest = _fit_voxel(maps, voxel, ctx)
    planes = [] if points is None else surface_planes(maps, voxel, farthest, points)
    vertices, faces = extract(fuse(maps, voxel, farthest, on_view))
    counts, _ = observe_all(maps, vertices, faces)
    shown = (counts[:, SHOWN] > 0) & (counts[:, SHOWN] >= 0.5 * counts[:, SEEN_THROUGH])
    faces = _drop_islands(vertices, faces[shown[faces].all(axis=1)], _LEAST_ISLAND * voxel**2)
    vertices, faces = _used(vertices, faces)
    if not len(faces):
        raise ReconstructionError(
            "There is no surface to make a mesh of: the views do not agree on any.",
            hint=f"Check the cameras with {name_command('report')}, or train longer.")
    before = len(faces)
    vertices, faces = _used(*simplify(vertices, faces, max_triangles, ctx.threads))
    if not len(faces):
        raise ReconstructionError(
            f"Of {before:,} triangles none is left at --max-triangles {max_triangles}.",
            hint="Allow more.")
    mesh = Mesh(vertices, faces, np.zeros((len(vertices), 3), np.uint8))
    inferred = infer_surface(mesh, maps, voxel) if infer else None
    if inferred is not None:
        mesh, inferred = _simplify_together(mesh, inferred, max_triangles, ctx.threads)
    return MeshResult(
        _paint(mesh, maps), voxel, before, planes, inferred and _paint(inferred, maps))


def _fit_voxel(
    maps: DepthMaps, voxel: float | None, ctx: StageContext
) -> tuple[float, float]:
    """Returns the voxel whose volume fits into memory, and the depth up to which it is used."""
    focal = float(np.median([max(camera.fx, camera.fy) for camera in maps.cameras]))
    voxel = voxel or maps.median / min(_RESOLUTION, focal)
    allowed, asked = min(_MOST_BYTES, _SHARE * free_memory_bytes()), voxel
    while voxel <= _MOST_COARSER * asked:
        farthest = min(focal * voxel / _LEAST_PIXELS, _FARTHEST * maps.median)
        needed = BYTES * len(find_blocks(maps, voxel, farthest))
        if needed <= allowed:
            if voxel > asked:
                ctx.notice(f"the mesh is made in voxels of {voxel:.3g} in place of {asked:.3g} "
                           "units, to fit into memory")
            return voxel, farthest
        voxel *= max(_COARSER, (needed / allowed) ** 0.5)
    raise ReconstructionError(
        f"The mesh does not fit into memory: even in voxels of {voxel:.3g} units its volume takes "
        f"more than {allowed / 1e6:,.0f} MB.",
        hint="Leave out the mesh, or cut the scene with --crop.")


def observe_all(
    maps: DepthMaps, vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Returns how often a vertex is shown and seen through [V, 2], and sums of colours [V, 4]."""
    normals = vertex_normals(vertices, faces)
    counts, colors = np.zeros((len(vertices), 2), np.int32), np.zeros((len(vertices), 4))
    for view, camera, depth in zip(maps.views, maps.cameras, maps.depths, strict=True):
        pool.run(
            observe, vertices, normals, viewpoint(camera), depth.reshape(-1),
            np.ascontiguousarray(view.image).reshape(-1), TOLERANCE, float(maps.near), counts,
            colors, scratch=False)
    return counts, colors


def _drop_islands(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], least: float
) -> NDArray[np.int64]:
    """Returns the triangles of connected parts of at least an area."""
    if not len(faces):
        return faces
    links = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(links), np.int8), links.T), shape=(len(vertices),) * 2)
    part = connected_components(graph, directed=False)[1][faces[:, 0]]
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(
        corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return np.asarray(faces[np.bincount(part, areas)[part] >= least])


def _used(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns vertices that triangles use, and the triangles that have three corners."""
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])
                  & (faces[:, 2] != faces[:, 0])]
    rows, inverse = np.unique(faces, return_inverse=True)
    return vertices[rows], inverse.reshape(faces.shape).astype(np.int64)


def _simplify_together(
    mesh: Mesh, inferred: Mesh, most: int, threads: int
) -> tuple[Mesh, Mesh | None]:
    """Returns both with at most `most` triangles together, shared out by their areas."""
    if len(mesh.faces) + len(inferred.faces) <= most:
        return mesh, inferred
    share = mesh.area() / (mesh.area() + inferred.area())
    count = min(max(int(share * most), 1), most - 1)
    parts = [_used(*simplify(part.vertices, part.faces, allowed, threads))
             for part, allowed in ((mesh, count), (inferred, most - count))]
    if not all(len(faces) for _, faces in parts):
        return mesh, None
    simple, closing = (
        Mesh(vertices, faces, np.zeros((len(vertices), 3), np.uint8)) for vertices, faces in parts)
    return simple, replace(closing, inferred=np.ones(len(closing.vertices), bool))


def _paint(mesh: Mesh, maps: DepthMaps) -> Mesh:
    """Returns a mesh in the colours that views show."""
    _, sums = observe_all(maps, mesh.vertices, mesh.faces)
    return replace(mesh, colors=_fill(mesh.vertices, sums))


def _fill(vertices: NDArray[np.float64], sums: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Returns mean colours [V, 3]; a vertex that no view shows takes that of the nearest."""
    known = sums[:, 3] > 0
    colors = np.full((len(vertices), 3), 128.0)
    colors[known] = sums[known, :3] / sums[known, 3:]
    if known.any() and not known.all():
        nearest = cKDTree(vertices[known]).query(vertices[~known])[1]
        colors[~known] = colors[known][nearest]
    return np.asarray(np.rint(colors.clip(0, 255)), np.uint8)
