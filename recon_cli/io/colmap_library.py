"""pycolmap, which everything here imports from: its own import takes over SIGTERM.

The logging library in it then prints thirty lines of C++ stack where a command is asked to end.
"""

import errno
import os
from pathlib import Path

from recon_cli.signals import keeping_handlers
from recon_cli.workspace.disk import refuse_full_disk

with keeping_handlers():
    import pycolmap

__all__ = ["check_model", "pycolmap", "write_model"]


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Writes a model in binary into a folder; OSError where the disk is full.

    COLMAP's streams do not say so: they leave files that are too short.
    """
    model.write_binary(folder)
    check_model(model, folder)


def check_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Raises OSError where the files of a model are too short; COLMAP hangs when it reads them."""
    images = [model.image(number) for number in model.reg_image_ids()]
    # numbers, pose and camera, the name with a zero; x, y and the point of each feature
    of_images = 8 + sum(
        4 + 56 + 4 + len(os.fsencode(image.name)) + 1 + 8 + 24 * len(image.points2D)
        for image in images)
    # numbers, place, colour, error; image and feature of each element of the track
    of_points = 8 + 51 * model.num_points3D() + 8 * sum(
        point.track.length() for point in model.points3D.values())
    for name, size in (("images.bin", of_images), ("points3D.bin", of_points)):
        if (folder / name).stat().st_size < size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder / name))
    refuse_full_disk(folder)  # the other files are small
