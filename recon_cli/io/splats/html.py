"""A page of its own that shows the scene: one .html without any other file, and without a network.

In it lie the scene as .spz, the cameras, and Spark and three.js as they were published (`web/`,
whose README names their versions and digests). A reader takes the scene out again; nothing of the
page is run for that.
"""

from __future__ import annotations

import base64
import binascii
import gzip
import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.splats.spz import spz_bytes, spz_splats
from recon_cli.io.splats.values import contents
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.workspace.atomic import write_bytes

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


Z_UP: NDArray[np.float64] = np.array([0.0, 0, 1])

_OPENED = re.compile(rb'<script id="scene" type="application/octet-stream" '
                     rb'data-format="([a-z]{1,9})" data-bytes="([0-9]{1,12})">')
_CLOSED = b"</script>"


def write_html(
    path: Path, splats: Splats, *, title: str = "scene", up: NDArray[np.float64] = Z_UP,
    views: Sequence[View] = (),
) -> None:
    """Writes a page that shows `splats`, whole or not at all.

    What becomes of values is what `write_spz` makes of them.

    Args:
        path: of the .html.
        splats: of any degree.
        title: of the page; any text.
        up: [3] unit vector.
        views: names and cameras that a visitor can step through, the first of which opens the
            page; without any it opens in front of the scene.

    Raises:
        FormatError: there are no Gaussians, one is too large or too far away, or a parameter is
            not finite.
    """
    packed = spz_bytes(path, splats, harmonic_step=1)  # beside the scripts size hardly counts
    scene = (f'<script id="scene" type="application/octet-stream" data-format="spz" '
             f'data-bytes="{len(packed)}">{base64.b64encode(packed).decode("ascii")}</script>')
    write_bytes(path, page(title, scene, views or [first_look(splats, up)], splats, up))


def read_html(path: Path) -> Splats:
    """Returns the Gaussians that lie in a page of `write_html`; none of its scripts is run.

    Raises:
        FormatError: the file is missing or damaged, or no page of that kind.
    """
    data = contents(path)
    found = list(_OPENED.finditer(data))
    if len(found) != 1:
        raise FormatError(
            f"{path} holds {len(found) or 'no'} scenes as `recon export --format html` writes "
            "them; one is needed.", hint="Give the page itself, not a copy that a browser saved.")
    start = found[0].end()
    end = data.find(_CLOSED, start)
    if end < 0:
        raise FormatError(f"{path} ends too early: it is truncated.", hint="Copy the file again.")
    kind, promised = found[0][1], int(found[0][2])
    if kind != b"spz":
        raise FormatError(f"{path} holds a scene as {kind.decode('ascii')}; spz can be read.")
    try:
        packed = binascii.a2b_base64(data[start:end], strict_mode=True)
    except binascii.Error as error:
        raise FormatError(f"{path} is damaged: its scene is no base64 ({error}).") from error
    if len(packed) != promised:
        raise FormatError(
            f"{path} promises a scene of {promised} bytes, but holds {len(packed)}: it is damaged.")
    return spz_splats(path, packed)
