"""A page that shows the scene: one .html that needs no other file and no network.

It embeds the scene as .spz, the cameras, and Spark and three.js as they were published (`web/`,
whose README lists versions and digests). The reader extracts the scene without running the page.
"""

from __future__ import annotations

import base64
import binascii
import gzip
import html
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path, PurePath
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.scene.statistics import FINE_SAMPLE, ROUNDING
from recon_cli.splats.axes import UP, turn_from
from recon_cli.splats.format import LoadedScene, SplatFormat, Tour, WriteSettings
from recon_cli.splats.spz import (
    FARTHEST,
    LARGEST_SCALE,
    POSITION_BITS,
    SMALLEST_SCALE,
    spz_bytes,
    spz_scene,
)
from recon_cli.splats.values import measure_extent, read_contents
from recon_cli.workspace.atomic import write_bytes

View = tuple[str, Camera]
ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E%3Crect "
    "width='32' height='32' rx='7' fill='%23223'/%3E%3Cellipse cx='12' cy='19' rx='8' ry='4' "
    "fill='%23e8a33d' transform='rotate(-25 12 19)'/%3E%3Cellipse cx='20' cy='13' rx='8' ry='4' "
    "fill='%234aa3df' fill-opacity='.85' transform='rotate(35 20 13)'/%3E%3C/svg%3E")
_DESCRIPTION = "A place in 3D: look around in it."
_PLAIN_TITLE = "A place in 3D"
_CAMERA_NAME = re.compile(
    r"(img|dsc[nf]?|pxl|vid|mov|mvi|gopr|gx|dji|p)?[-_ ]?[\d_-]{3,}", re.IGNORECASE)
Z_UP: NDArray[np.float64] = np.array([0.0, 0, 1])

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

# Files in `web/` by the module name that others import; "recon:" marks relative imports.
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
_STORED = "rub"  # axes that the page turns back; the turn is its own inverse
_LEVELS_FROM = 500_000  # Gaussians, of which Spark makes levels of detail
# At five, e^-10 units, the least scale, are .0015 units of the scene: in one of COLMAP, where some
# ten are a room, less than a millimetre.
_MOST_HALVINGS = 5
_FINE = 0.01  # share of the Gaussians that may be finer, by their second axis, than SPZ holds
_DEFAULT_LENS = (1200, 900, 1000.0)  # width, height and focal length in pixels


@dataclass(frozen=True, eq=False)
class PageStyle:
    """How a page looks besides its scene."""

    title: str = "scene"
    tour: Tour | None = None
    poster: bytes | None = None  # a .jpg that is shown while the scene loads
    preview: str | None = None  # address of the same picture, for links to the page
    credits: bool = False  # whether it says what made it


def default_view(splats: Splats | SplatArrays, up: NDArray[np.float64]) -> View:
    """Returns a camera in front of the scene and a little above it, looking at its middle."""
    middle, radius = measure_extent(splats.as_arrays().means)
    reach = radius or 1.0
    back = np.array([0.0, -1, 0]) if abs(up[1]) < 0.5 else np.array([0.0, 0, np.sign(up[1])])
    back -= (back @ up) * up
    offset = 2.5 * back / np.linalg.norm(back) + 0.5 * up
    viewmat = looking_at(middle + reach * offset, middle, up)
    width, height, focal = _DEFAULT_LENS
    return "", Camera(width, height, focal, focal, width / 2, height / 2, viewmat)


def build_page(
    style: PageStyle, scene: str, views: Sequence[View], splats: SplatArrays,
    up: NDArray[np.float64],
) -> bytes:
    """Returns the page, in which `scene` is the element with the Gaussians."""
    title = html.escape(style.title)
    poster = "" if style.poster is None else (
        '<img id="poster" alt="" src="data:image/jpeg;base64,'
        f'{base64.b64encode(style.poster).decode("ascii")}">')
    text = Template(_text("page.html")).substitute(
        title=title, preview=_preview(title, style.preview), icon=ICON, poster=poster,
        credits='<span id="credits">made with recon</span>' if style.credits else "",
        scene=scene, views=_views(views, splats, up, style.tour),
        licences="\n".join(f"{name}\n{_text(name)}" for name in LICENCES),
        modules="\n".join(_module(name, file) for name, file in MODULES.items()))
    return text.encode("utf-8", "replace")  # a file name may hold surrogates


def _preview(title: str, picture: str | None) -> str:
    """Returns what programs show of a link to the page (the Open Graph protocol)."""
    lines = [f'<meta property="og:title" content="{title}">',
             '<meta property="og:type" content="website">',
             f'<meta property="og:description" content="{_DESCRIPTION}">']
    if picture:
        lines += [f'<meta property="og:image" content="{html.escape(picture)}">',
                  '<meta name="twitter:card" content="summary_large_image">']
    return "\n".join(lines)


def _views(
    views: Sequence[View], splats: SplatArrays, up: NDArray[np.float64], tour: Tour | None
) -> str:
    """Returns the element with the extent of the scene, the cameras and the tour."""
    means = splats.means.astype(np.float64)
    middle, radius = measure_extent(means)
    reach = radius or 1.0
    sample = means[::-(-len(means) // FINE_SAMPLE)]
    lenses: dict[tuple[float, ...], int] = {}

    def entry(camera: Camera) -> dict[str, Any]:
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        pose = np.hstack([camera.viewmat[:3, :3].T, camera.center[:, None]])
        return {"lens": lenses.setdefault(lens, len(lenses)), "pose": pose.ravel().tolist(),
                "distance": _distance(sample, camera) or reach}

    entries = [entry(camera) for _, camera in views]  # file names are nobody's business
    way = None if tour is None else {
        "seconds": tour.seconds, "start": tour.start,
        "views": [{**entry(camera), "margins": margins} for camera, margins in zip(
            tour.cameras, tour.margins.tolist(), strict=True)]}
    names = ("fx", "fy", "cx", "cy", "width", "height")
    value = {
        "up": up.tolist(), "middle": middle.tolist(), "reach": reach,
        "lod": len(splats) >= _LEVELS_FROM,
        "lenses": [dict(zip(names, lens, strict=True)) for lens in lenses], "views": entries,
        "tour": way}
    # No name can close the element.
    text = json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script id="views" type="application/json">{text}</script>'


def _distance(means: NDArray[np.float64], camera: Camera) -> float:
    """Returns the median depth of the centres that a camera sees; 0 if it sees none."""
    *_, depths = camera.find_visible(means)
    return float(np.median(depths)) if len(depths) else 0.0


@cache
def _module(name: str, file: str) -> str:
    # Level and time are fixed, so that the same files give the same page.
    packed = gzip.compress(_text(file).encode("utf-8"), 9, mtime=0)
    return (f'<script type="text/plain" data-module="{html.escape(name)}">'
            f'{base64.b64encode(packed).decode("ascii")}</script>')


def _text(name: str) -> str:
    return (files("recon_cli.splats") / "web" / name).read_text(encoding="utf-8")


_OPENED = re.compile(rb'<script id="scene" type="application/octet-stream" '
                     rb'data-format="([a-z]{1,9})" data-bytes="([0-9]{1,12})"'
                     rb'(?: data-halvings="(-?[0-9]{1,2})")?>')
_CLOSED = b"</script>"
_NUMBER = rb"(-?[0-9]{1,9}(?:\.[0-9]{1,20})?(?:e-?[0-9]{1,2})?)"
_UP = re.compile(rb'<script id="views" type="application/json">\{"up":\['
                 + b",".join([_NUMBER] * 3) + rb"\]")


def write_html(
    path: Path, splats: Splats | SplatArrays, *, style: PageStyle | None = None,
    up: NDArray[np.float64] = Z_UP, views: Sequence[View] = (),
) -> None:
    """Writes a page that shows `splats`, completely or not at all.

    Values are quantized as by `write_spz`, but coefficients to 1/128. `up` is a unit vector [3]. A
    visitor can step through the cameras of `views`; the page opens on its tour, at the first of
    them, or in front of the scene. The errors are those of `spz_bytes`.
    """
    splats = splats.as_arrays()
    halvings = _halvings(splats)
    # beside the scripts size hardly counts
    packed = spz_bytes(path, turn_from(_STORED, _enlarged(splats, -halvings)), harmonic_step=1,
                       least_bits=POSITION_BITS + max(0, halvings))
    tag = f' data-halvings="{halvings}"' if halvings else ""
    scene = (f'<script id="scene" type="application/octet-stream" data-format="spz" '
             f'data-bytes="{len(packed)}"{tag}>{base64.b64encode(packed).decode("ascii")}</script>')
    write_bytes(path, build_page(
        style or PageStyle(), scene, views or [default_view(splats, up)], splats, up))


def _halvings(splats: SplatArrays) -> int:
    """Returns how often the scene is halved until SPZ holds its largest Gaussian.

    Below 0 it is doubled, until SPZ holds its fine ones, as far as the others leave room.
    """
    if not len(splats):
        return 0
    scales = splats.scales
    needed = math.log2(float(scales.max()) / LARGEST_SCALE)
    if not math.isfinite(needed):
        return 0
    if needed > 0:
        return min(_MOST_HALVINGS, math.ceil(needed))
    fine = float(np.quantile(np.median(scales, axis=1), _FINE))
    farthest = float(np.abs(splats.means).max())
    room = min(-needed, math.log2(FARTHEST / max(farthest, fine)))
    wanted = math.ceil(math.log2(SMALLEST_SCALE / max(fine, float(np.finfo(np.float32).tiny))))
    return -max(0, min(wanted, math.floor(room)))


def _enlarged(splats: SplatArrays, doublings: int) -> SplatArrays:
    """Returns the scene in another unit: all lengths times two to the power of `doublings`."""
    if doublings == 0:
        return splats
    return replace(splats, means=splats.means * np.float32(2.0**doublings),
                   log_scales=splats.log_scales + np.float32(doublings * math.log(2)))


def load_html(path: Path) -> LoadedScene:
    """Returns the scene in a page of `write_html`, or raises FormatError; no script is run."""
    data = read_contents(path)
    matches = list(_OPENED.finditer(data))
    if len(matches) != 1:
        raise FormatError(
            f"{path} holds {len(matches) or 'no'} scenes as `recon export --format html` writes "
            "them; one is needed.", hint="Give the page itself, not a copy that a browser saved.")
    start = matches[0].end()
    end = data.find(_CLOSED, start)
    if end < 0:
        raise FormatError(f"{path} ends too early: it is truncated.", hint="Copy the file again.")
    kind, promised = matches[0][1], int(matches[0][2])
    if kind != b"spz":
        raise FormatError(f"{path} holds a scene as {kind.decode('ascii')}; spz can be read.")
    try:
        packed = binascii.a2b_base64(data[start:end], strict_mode=True)
    except binascii.Error as error:
        raise FormatError(f"{path} is damaged: its scene is not base64 ({error}).") from error
    if len(packed) != promised:
        raise FormatError(
            f"{path} promises a scene of {promised} bytes, but holds {len(packed)}: it is damaged.")
    stored = spz_scene(path, packed, axes=_STORED).arrays
    found = _UP.search(data)
    up = next((name for name, axis in UP.items() if found and np.allclose(
        axis, [float(number) for number in found.groups()], rtol=0, atol=ROUNDING)), None)
    return LoadedScene(_enlarged(stored, int(matches[0][3] or 0)), up)


def _write_with(path: Path, splats: SplatArrays, settings: WriteSettings) -> None:
    guide = settings.guide(splats.as_tensors()) if settings.guide is not None else None
    preview = path.with_suffix(".jpg")
    if guide is not None:
        write_bytes(preview, guide.poster)
    style = PageStyle(
        settings.options.get("title") or find_title(settings.title),
        guide.tour if guide else None, guide.poster if guide else None,
        preview.name if guide else None, bool(settings.options.get("credits")))
    write_html(
        path, splats.with_sphere(LARGEST_SCALE), style=style,
        up=Z_UP if settings.up is None else settings.up, views=settings.views)


def find_title(name: str) -> str:
    """Returns a title from the name of a capture's file or folder, unless a camera made it up."""
    stem = PurePath(name).stem
    words = re.sub(r"[\s_-]+", " ", stem).strip()
    if not words or _CAMERA_NAME.fullmatch(stem):
        return _PLAIN_TITLE
    return words[0].upper() + words[1:]


FORMAT = SplatFormat(load_html, _write_with)
