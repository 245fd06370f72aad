"""A COLMAP model in another world frame."""

from __future__ import annotations

import pycolmap

from recon_cli.scene import Similarity


def place(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Moves cameras and points of `model`; each observation keeps its reprojection error."""
    model.transform(pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))
