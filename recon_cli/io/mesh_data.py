"""A triangle mesh in memory: surface that views show, and surface that is inferred from planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

TINT = (0.55, 0.75, 1.0)  # that inferred surface is multiplied by with `--inferred tint`


@dataclass(frozen=True, eq=False)
class Texture:
    """The image of a mesh, and where its vertices lie in it."""

    image: NDArray[np.uint8]  # [T, T, 3] RGB
    # [V, 2] to the right and down from the upper left corner of the image, 1 at its other sides
    corners: NDArray[np.float64]
    kind: str = "png"  # format of the image in files: png or jpg


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh."""

    vertices: NDArray[np.float64]  # [V, 3]
    faces: NDArray[np.int64]  # [F, 3], counter-clockwise from outside
    colors: NDArray[np.uint8]  # [V, 3] RGB
    inferred: NDArray[np.bool_] | None = None  # [V], None: no view's evidence is missing anywhere
    texture: Texture | None = None

    @property
    def inferred_faces(self) -> NDArray[np.bool_]:
        """Which triangles [F] no view shows; they have vertices of their own."""
        if self.inferred is None:
            return np.zeros(len(self.faces), bool)
        return np.asarray(self.inferred[self.faces].all(axis=1))

    def parts(self) -> Iterator[tuple[str, Mesh]]:
        """Yields the surface and what is inferred, each as a mesh with its name; none is empty."""
        inferred = self.inferred_faces
        if not inferred.any():
            yield "surface", self
            return
        for name, chosen in (("surface", ~inferred), ("inferred", inferred)):
            if not chosen.any():
                continue
            rows, faces = np.unique(self.faces[chosen], return_inverse=True)
            texture = self.texture and replace(self.texture, corners=self.texture.corners[rows])
            yield name, Mesh(
                self.vertices[rows], faces.reshape(-1, 3).astype(np.int64), self.colors[rows],
                np.full(len(rows), name == "inferred"), texture)

    def area(self, chosen: NDArray[np.bool_] | None = None) -> float:
        """Returns the area of the triangles, or of some of them [F]."""
        corners = self.vertices[self.faces if chosen is None else self.faces[chosen]]
        return float(np.linalg.norm(np.cross(
            corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2)


def joined(first: Mesh, second: Mesh) -> Mesh:
    """Returns two meshes without textures as one."""
    marks = [np.zeros(len(mesh.vertices), bool) if mesh.inferred is None else mesh.inferred
             for mesh in (first, second)]
    return Mesh(np.concatenate([first.vertices, second.vertices]),
                np.concatenate([first.faces, second.faces + len(first.vertices)]),
                np.concatenate([first.colors, second.colors]), np.concatenate(marks))
