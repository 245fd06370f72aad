"""A page of its own that shows the scene: one .html without any other file, and without a network.

In it lie the scene as .spz, the cameras, and Spark and three.js as they were published (`web/`,
whose README names their versions and digests). A reader takes the scene out again; nothing of the
page is run for that.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.atomic import write_bytes
from recon_cli.errors import FormatError
from recon_cli.io.splats.html_page import View, first_look, page
from recon_cli.io.splats.spz import spz_bytes, spz_splats
from recon_cli.io.splats.values import contents
from recon_cli.scene.splats import Splats

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
