"""What ingest and place left of a capture: each record is read once, at the door of a stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, Hint
from recon_cli.io import depth_maps
from recon_cli.io.colmap import read_images, read_points, read_scene
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.workspace.records import FrameList, read_frame_list
from recon_cli.workspace.summaries import WorldSummary


@dataclass(frozen=True, eq=False)
class PlacedCapture:
    """The frames of a capture, and the world in which their cameras stand."""

    ingest: Path  # folder
    place: Path  # folder
    frames: FrameList
    world: WorldSummary | None  # None where it is the world of the mapper

    @staticmethod
    def read(folders: Mapping[str, Path]) -> PlacedCapture:
        """Returns the capture; `folders` are those of ingest and place.

        FormatError if a record is damaged, ManifestError if it is of another version.
        """
        ingest, place = folders["ingest"], folders["place"]
        return PlacedCapture(ingest, place, read_frame_list(ingest), WorldSummary.read(place))

    @property
    def z_up(self) -> bool:
        """Whether the z axis of the world is known to be up."""
        return self.world is not None and self.world.evidence.up_found

    @property
    def similarity(self) -> Similarity:
        """From the world of the capture's own cameras; FormatError if its record is damaged."""
        try:
            return Similarity.from_json(self.world.similarity) if self.world else Similarity()
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"{self.place / WorldSummary.FILE} holds no similarity: {error}.",
                hint=Hint("sfm", again=True)) from error

    @property
    def sparse(self) -> Path:
        """The folder of the COLMAP model."""
        return self.place / "undistorted" / "sparse"

    @cached_property
    def viewmats(self) -> dict[str, NDArray[np.float64]]:
        """World to camera [4, 4] of each view by its name."""
        return {name: viewmat for name, _, viewmat in read_images(self.sparse / "images.bin")}

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The sparse points [P, 3]."""
        return read_points(self.sparse / "points3D.bin")[0]

    def load_scene(
        self, *, validation: float | frozenset[str], sparse: Path | None = None
    ) -> Scene:
        """Returns the views and points, split by their permitted use.

        `validation` are the names of views to look at only, or their share; `sparse` is the folder
        of a model with a part of the views and points.
        """
        scene = read_scene(self.place / "undistorted", held_out=self.frames.held_out,
                           validation=validation, sparse=sparse)
        return dataclasses.replace(
            scene, up=np.array([0.0, 0.0, 1.0]) if self.z_up else None,
            depth=self.ingest if (self.ingest / depth_maps.LIST).exists() else None)


def load_scene(
    folders: Mapping[str, Path], *, validation: float | frozenset[str], sparse: Path | None = None
) -> Scene:
    """Returns the scene of a capture of which nothing else is asked, see `PlacedCapture`."""
    return PlacedCapture.read(folders).load_scene(validation=validation, sparse=sparse)
