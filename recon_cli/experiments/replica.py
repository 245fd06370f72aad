"""The eight rooms of Replica in a folder, as NICE-SLAM distributes them."""

from __future__ import annotations

import logging
from pathlib import Path

from recon_cli.datasets.rgbd import is_replica
from recon_cli.errors import InputError, list_names
from recon_cli.experiments.paper_tables import TABLE_I

FRAMES = 200  # of the 2,000 of a room, evenly spread: the paper says nothing of its own
SIZE = 1200  # pixels, the width of Replica's frames
MAX_GAUSSIANS = 400_000  # the same limit for all methods

_LAYOUT = ("Each room is a folder such as room0 with results/frame000000.jpg, "
           "results/depth000000.png and traj.txt; cam_params.json lies in it or beside the rooms.")

logger = logging.getLogger("recon")


def find_rooms(folder: Path) -> tuple[Path, ...]:
    """Returns the rooms that a folder holds, in the order of the paper; names the missing ones.

    Raises:
        InputError: it holds none, or one lacks its frames or poses.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder.", hint=_LAYOUT)
    by_name = {path.name.lower(): path for path in sorted(folder.iterdir()) if path.is_dir()}
    rooms = [by_name[name] for name in TABLE_I if name in by_name]
    if not rooms and (is_replica(folder) or folder.name.lower() in TABLE_I):
        raise InputError(
            f"{folder} is one room.", hint=f"Give the folder that holds it: {folder.parent}")
    if not rooms:
        raise InputError(
            f"{folder} holds no room of the paper: {', '.join(TABLE_I)}.", hint=_LAYOUT)
    for room in rooms:
        if not is_replica(room):
            lacks = "traj.txt" if (room / "results").is_dir() else "results/"
            raise InputError(f"{room} has no {lacks}.", hint=_LAYOUT)
    missing = [name for name in TABLE_I if name not in by_name]
    if missing:
        logger.warning("%s does not hold %s; their rows show the printed scores alone",
                       folder, list_names(missing))
    return tuple(rooms)
