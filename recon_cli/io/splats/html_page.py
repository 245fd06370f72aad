"""What the page of `html` is put together from: its frame, the modules, and what they are told."""

from __future__ import annotations

import base64
import gzip
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

View = tuple[str, Camera]

# Modules by the names under which others import them, in `web/`. Those with "recon:" stand beside
# the module that asks for them.
MODULES = {
    "three": "three.module.min.js",
    "recon:three.core.min.js": "three.core.min.js",
    "three/addons/controls/OrbitControls.js": "OrbitControls.js",
    "three/addons/postprocessing/Pass.js": "Pass.js",
    "@sparkjsdev/spark": "spark.module.min.js",
    "harmonics": "harmonics.js",
    "viewer": "viewer.js",
}
LICENCES = ("LICENSE-three.txt", "LICENSE-spark.txt", "LICENSE-fflate.txt")
_MOST_OF_IT = 0.9  # share of the Gaussians that count for how large the scene is
_LOOKED_AT = 20_000  # Gaussians, at most, that say how far away things are
_FIRST = (1200, 900, 1000.0)  # width, height and focal length of the first look, in pixels


@dataclass(frozen=True, eq=False)
class Extent:
    """Where most of a scene is: its middle [3], and how far it reaches from there."""

    middle: NDArray[np.float64]
    reach: float


def extent(means: NDArray[np.floating[Any]]) -> Extent:
    """Returns the extent of centres [N, 3]; the median, because a few lie far outside."""
    middle = np.median(means.astype(np.float64), axis=0)
    reach = float(np.quantile(np.linalg.norm(means - middle, axis=1), _MOST_OF_IT))
    return Extent(middle, reach or 1.0)


def first_look(splats: Splats, up: NDArray[np.float64]) -> View:
    """Returns a camera in front of the scene, a little above it, that looks at its middle."""
    found = extent(splats.means.detach().cpu().numpy())
    back = np.array([0.0, -1, 0]) if abs(up[1]) < 0.5 else np.array([0.0, 0, np.sign(up[1])])
    back -= (back @ up) * up
    offset = 2.5 * back / np.linalg.norm(back) + 0.5 * up
    forward = -offset / np.linalg.norm(offset)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ (found.middle + found.reach * offset)
    width, height, focal = _FIRST
    return "", Camera(width, height, focal, focal, width / 2, height / 2, viewmat)


def page(
    title: str, scene: str, views: Sequence[View], splats: Splats, up: NDArray[np.float64]
) -> bytes:
    """Returns the page.

    Args:
        title: any text.
        scene: the element that holds the Gaussians.
        views: names and cameras, at least one.
        splats: the Gaussians, which say where the scene is.
        up: [3] unit vector.
    """
    text = Template(_text("page.html")).substitute(
        title=html.escape(title), scene=scene, views=_views(views, splats, up),
        licences="\n".join(f"{name}\n{_text(name)}" for name in LICENCES),
        modules="\n".join(_module(name, file) for name, file in MODULES.items()))
    return text.encode("utf-8", "replace")  # a file's name need not be text


def _views(views: Sequence[View], splats: Splats, up: NDArray[np.float64]) -> str:
    """Returns the element that tells the viewer where the scene is and from where it is seen."""
    means = splats.means.detach().cpu().double().numpy()
    found = extent(means)
    some = means[::-(-len(means) // _LOOKED_AT)]
    lenses: dict[tuple[float, ...], int] = {}
    told = []
    for name, camera in views:
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        pose = np.hstack([camera.viewmat[:3, :3].T, camera.center[:, None]])
        told.append({
            "name": name, "lens": lenses.setdefault(lens, len(lenses)),
            "pose": pose.ravel().tolist(), "distance": _distance(some, camera) or found.reach})
    names = ("fx", "fy", "cx", "cy", "width", "height")
    value = {
        "up": up.tolist(), "middle": found.middle.tolist(), "reach": found.reach,
        "lenses": [dict(zip(names, lens, strict=True)) for lens in lenses], "views": told}
    # Whatever a name holds, it cannot end the element.
    text = json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script id="views" type="application/json">{text}</script>'


def _distance(means: NDArray[np.float64], camera: Camera) -> float:
    """Returns the median depth of the centres that a camera shows; 0 where it shows none."""
    x, y, z = camera.viewmat[:3, :3] @ means.T + camera.viewmat[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    seen = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return float(np.median(z[seen])) if seen.any() else 0.0


@cache
def _module(name: str, file: str) -> str:
    # Level and time are said, so that the same files give the same page.
    packed = gzip.compress(_text(file).encode("utf-8"), 9, mtime=0)
    return (f'<script type="text/plain" data-module="{html.escape(name)}">'
            f'{base64.b64encode(packed).decode("ascii")}</script>')


def _text(name: str) -> str:
    return (files("recon_cli.io.splats") / "web" / name).read_text(encoding="utf-8")
