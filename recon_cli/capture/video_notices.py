"""What is done to the frames of a video that its owner may not expect, in sentences.

A varying frame rate is no reason for one: frames are chosen by their times and places.
"""

from __future__ import annotations

from pathlib import Path

from recon_cli.capture.decoded_picture import Picture
from recon_cli.capture.video import moving_pictures, open_video


def done_to(path: Path, first: Picture, interlaced: int) -> tuple[str, ...]:
    """Returns what is done to a video, a sentence each; empty for plain SDR video.

    Args:
        path: the video.
        first: its first frame.
        interlaced: how many of its frames are.

    Raises:
        InputError: as `open_video`.
    """
    found = []
    with open_video(path) as (container, _):
        videos = len(moving_pictures(container))
    if videos > 1:
        found.append(f"{path.name} holds {videos} videos: the first that can be decoded is used.")
    if first.tags.transfer is not None:
        found.append(
            f"{path.name} is {first.tags.transfer.value} video: tone-mapped to SDR by one curve.")
    if interlaced:
        found.append(f"{path.name} is interlaced: {interlaced} frames are deinterlaced.")
    stored = first.frame.width, first.frame.height
    if first.square_size != stored:
        found.append(
            f"{path.name} has pixels of aspect {first.tags.aspect}: its frames of {_by(stored)} "
            f"are stretched to {_by(first.square_size)}.")
    return tuple(found)


def _by(size: tuple[int, int]) -> str:
    return "x".join(map(str, size))
