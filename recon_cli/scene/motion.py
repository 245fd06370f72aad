"""How the camera moved while it took a view, from the poses of the views before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.scene.camera import Camera

# Seconds to a neighbour, at most. A hand turns back and forth about twice a second: the mean of a
# longer stretch says nothing of the moment.
_NEAR = 0.6


@dataclass(frozen=True)
class Moment:
    """When a frame was taken."""

    source: str  # name of its video; times of different ones are not compared
    seconds: float


@dataclass(frozen=True, eq=False)
class Motion:
    """The velocity of a camera."""

    turn: NDArray[np.float64]  # [3] rad/s, rotation vector about the camera's own axes
    move: NDArray[np.float64]  # [3] world units/s, of the centre

    def at(self, camera: Camera, seconds: float) -> Camera:
        """Returns the camera that many seconds later, or earlier where they are negative."""
        to_world = camera.viewmat[:3, :3].T @ Rotation.from_rotvec(
            seconds * self.turn).as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3] = to_world.T
        viewmat[:3, 3] = -to_world.T @ (camera.center + seconds * self.move)
        return replace(camera, viewmat=viewmat)

    def flow(
        self, camera: Camera, points: NDArray[np.float64]  # [P, 3], in front of it
    ) -> NDArray[np.float64]:
        """Returns the velocity of points in the image, [P, 2] in pixels/s."""
        seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        # of the points in the axes of the camera, which moves under them
        speed = -np.cross(self.turn, seen) - camera.viewmat[:3, :3] @ self.move
        ray = seen[:, :2] / seen[:, 2:]
        slope = (speed[:, :2] - ray * speed[:, 2:]) / seen[:, 2:]
        return np.asarray(slope * [camera.fx, camera.fy])


def camera_motions(
    cameras: Mapping[str, Camera], moments: Mapping[str, Moment]
) -> dict[str, Motion]:
    """Returns the velocity of each camera that has a neighbour in time, by name.

    It is that of the parabola through the camera and its two neighbours, or of the line where only
    one of them is near.
    """
    motions = {}
    timed = [name for name in cameras if name in moments]
    for source in sorted({moments[name].source for name in timed}):
        names = sorted((name for name in timed if moments[name].source == source),
                       key=lambda name: (moments[name].seconds, name))
        for place, name in enumerate(names):
            around = [*names[max(0, place - 1):place], *names[place + 1:place + 2]]
            motion = _join([
                _between(cameras[name], cameras[other], seconds) for other in around
                if 0 < abs(seconds := moments[other].seconds - moments[name].seconds) <= _NEAR])
            if motion is not None:
                motions[name] = motion
    return motions


def _between(camera: Camera, other: Camera, seconds: float) -> tuple[float, Motion]:
    """Returns the distance in time, and the mean velocity on the way to another camera."""
    turned = camera.viewmat[:3, :3] @ other.viewmat[:3, :3].T
    turn = Rotation.from_matrix(turned).as_rotvec() / seconds
    return abs(seconds), Motion(turn, (other.center - camera.center) / seconds)


def _join(sides: Sequence[tuple[float, Motion]]) -> Motion | None:
    """Returns the velocity between the mean ones of up to two sides; the shorter counts more."""
    if not sides:
        return None
    if len(sides) == 1:
        return sides[0][1]
    (first, before), (second, after) = sides
    share = second / (first + second)
    return Motion(share * before.turn + (1 - share) * after.turn,
                  share * before.move + (1 - share) * after.move)
