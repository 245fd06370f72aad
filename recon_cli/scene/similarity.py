"""A change of the world frame: scale, rotation, translation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.statistics import ROUNDING

if TYPE_CHECKING:
    from recon_cli.scene.camera import Camera

_ROUNDING = 1e-4  # of a matrix in float32 or in decimals that somebody wrote


@dataclass(frozen=True, eq=False)
class Similarity:
    """Takes old world coordinates to new ones: x' = scale * rotation @ x + translation."""

    scale: float = 1.0  # new units in one old unit, above 0
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))  # [3, 3]
    translation: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))  # [3]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"a similarity of scale {self.scale}")
        rotation, translation = np.asarray(self.rotation), np.asarray(self.translation)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"rotation {rotation.shape} and translation {translation.shape}")
        # Written so that a NaN fails too.
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not (off < ROUNDING and np.linalg.det(rotation) > 0):
            raise ValueError("the matrix of a similarity is not a rotation")
        if not np.isfinite(translation).all():
            raise ValueError("the translation of a similarity is not finite")

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing, to the last bit."""
        return (
            self.scale == 1.0 and np.array_equal(self.rotation, np.eye(3))
            and not self.translation.any())

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The same as a matrix [4, 4] on homogeneous coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def after(self, first: Similarity) -> Similarity:
        """Returns the similarity that does `first` and then this one."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation,
            self.points(first.translation))

    def inverse(self) -> Similarity:
        """Returns the similarity that leads back."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns points [..., 3] in new coordinates."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.translation)

    def viewmat(self, viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns the world-to-camera matrix [4, 4] of the same camera in the new world.

        Depths are in new units, so that each point keeps its pixel and the rotation stays one.
        """
        result = np.eye(4)
        result[:3, :3] = viewmat[:3, :3] @ self.rotation.T
        result[:3, 3] = self.scale * viewmat[:3, 3] - result[:3, :3] @ self.translation
        return result

    def camera(self, camera: Camera) -> Camera:
        """Returns the same camera in the new world."""
        return replace(camera, viewmat=self.viewmat(camera.viewmat))

    @classmethod
    def from_matrix(cls, matrix: NDArray[np.float64]) -> Similarity:
        """Returns the similarity of a matrix [4, 4], with rounding errors repaired.

        Raises:
            ValueError: it stretches, shears or mirrors, is not finite, or is not affine.
        """
        if not np.isfinite(matrix).all():
            raise ValueError("its numbers are not finite")
        if not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise ValueError("its last row is not 0 0 0 1")
        with np.errstate(over="ignore", invalid="ignore"):
            scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        if scale < 0:
            raise ValueError("it mirrors")
        rotation = matrix[:3, :3] / scale if 0 < scale < np.inf else np.zeros((3, 3))
        if not np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROUNDING:
            raise ValueError("it stretches or shears")
        if not np.array_equal(rotation, np.round(rotation)):
            left, _, right = np.linalg.svd(rotation)
            rotation = left @ right
        return cls(scale, rotation, matrix[:3, 3])

    def to_json(self) -> dict[str, Any]:
        """Returns scale, rotation (rows) and translation as JSON values, without loss."""
        return {
            "scale": float(self.scale), "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist()}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Similarity:
        """Returns the similarity that `to_json` wrote.

        Raises:
            ValueError: the values are not a similarity.
            KeyError: one is missing.
        """
        return cls(
            float(value["scale"]), np.array(value["rotation"], np.float64),
            np.array(value["translation"], np.float64))
