"""Tracks: where corners of a scene were followed through the frames of a video.

Ingest writes them beside the frames, in one safetensors file: tensors `image`, `track` and `xy`
with a row an observation, and the names of the images as a JSON list in the metadata.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from recon_cli.errors import FormatError, Hint
from recon_cli.workspace import atomic

TRACKS = "tracks.safetensors"


@dataclass(frozen=True, eq=False)
class Tracks:
    """O observations of tracks in images, sorted by image, then by track."""

    names: tuple[str, ...]  # of the images
    image: NDArray[np.int32]  # [O], index into the names
    track: NDArray[np.int32]  # [O], number of the track; once per image
    xy: NDArray[np.float32]  # [O, 2], as shares of width and height, from the outer corner

    def select(self, chosen: Mapping[int, str]) -> Tracks:
        """Returns the tracks that reach two of the images `chosen` by index, under new names."""
        order = {index: place for place, index in enumerate(sorted(chosen))}
        place = np.full(len(self.names), -1, np.int32)
        place[list(order)] = list(order.values())
        image = place[self.image]
        reach = np.bincount(self.track[image >= 0], minlength=self.track.max(initial=-1) + 1)
        rows = (image >= 0) & (reach[self.track] >= 2)
        numbers = np.cumsum(reach >= 2, dtype=np.int32) - 1
        names = tuple(chosen[index] for index in order)
        return Tracks(names, image[rows], numbers[self.track[rows]], self.xy[rows])

    def outside(self, area: NDArray[np.bool_]) -> Tracks:  # [h, w], at any size
        """Returns the tracks without their observations in an area that all images share."""
        return self.where(~self.inside(area))

    def inside(self, area: NDArray[np.bool_]) -> NDArray[np.bool_]:  # [h, w], at any size; [O]
        """Returns which observations lie in an area of their images."""
        size = np.array(area.shape[::-1])
        x, y = np.clip((self.xy * size).astype(int), 0, size - 1).T
        return np.asarray(area[y, x])

    def where(self, rows: NDArray[np.bool_]) -> Tracks:  # [O]
        """Returns the tracks with these observations alone."""
        return Tracks(self.names, self.image[rows], self.track[rows], self.xy[rows])

    def matches(self, first: int, second: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns the observations, by row, of the tracks that two images share, [M] each."""
        rows = [np.arange(*np.searchsorted(self.image, (index, index + 1)))
                for index in (first, second)]
        _, ours, theirs = np.intersect1d(
            self.track[rows[0]], self.track[rows[1]], assume_unique=True, return_indices=True)
        return rows[0][ours], rows[1][theirs]

    def write(self, path: Path) -> None:
        """Writes the file atomically."""
        with atomic.replacing(path) as temporary:
            save_file({"image": self.image, "track": self.track, "xy": self.xy}, temporary,
                      metadata={"names": json.dumps(self.names)})

    @classmethod
    def read(cls, path: Path) -> Tracks:
        """Returns the tracks of a file; FormatError if it is damaged or holds none."""
        try:
            with safe_open(path, "numpy") as file:
                names = atomic.parse_json(file.metadata()["names"], list)
                image, track, xy = (file.get_tensor(name) for name in ("image", "track", "xy"))
        except (KeyError, TypeError, ValueError, OSError, SafetensorError) as error:
            raise FormatError(
                f"{path} holds no tracks.", hint=Hint("ingest", again=True)) from error
        return cls(tuple(names), image, track, xy)


def merge_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Returns the tracks of several videos as those of one; the names of their images differ."""
    images = np.cumsum([0, *(len(part.names) for part in parts)])
    tracks = np.cumsum([0, *(part.track.max(initial=-1) + 1 for part in parts)])
    return Tracks(
        tuple(name for part in parts for name in part.names),
        np.concatenate([np.zeros(0, np.int32), *(
            part.image + np.int32(offset) for part, offset in zip(parts, images, strict=False))]),
        np.concatenate([np.zeros(0, np.int32), *(
            part.track + np.int32(offset) for part, offset in zip(parts, tracks, strict=False))]),
        np.concatenate([np.zeros((0, 2), np.float32), *(part.xy for part in parts)]))
