"""The scene as place left it: its views and points, split by their permitted use."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from recon_cli.io import depth_maps
from recon_cli.io.colmap import read_scene
from recon_cli.scene.scene import Scene
from recon_cli.workspace.records import read_frame_list
from recon_cli.workspace.summaries import WorldSummary


def held_out_names(ingest: Path) -> frozenset[str]:
    """Returns the names of the frames that ingest held out for the score."""
    return frozenset(frame.name for frame in read_frame_list(ingest).frames if frame.held_out)


def load_scene(
    folders: Mapping[str, Path], *, validation: float | frozenset[str], sparse: Path | None = None
) -> Scene:
    """Returns the views and points that place left, split by their permitted use.

    `folders` are those of ingest and place. `validation` are the names of views to look at only, or
    their share; `sparse` is the folder of a model with a part of the views and points.
    """
    place, held_out = folders["place"], held_out_names(folders["ingest"])
    scene = read_scene(
        place / "undistorted", held_out=held_out, validation=validation, sparse=sparse)
    world = WorldSummary.read(place)
    up = np.array([0.0, 0.0, 1.0]) if world is not None and world.evidence.up_found else None
    ingest = folders["ingest"]
    return dataclasses.replace(
        scene, up=up, depth=ingest if (ingest / depth_maps.LIST).exists() else None)
