"""Spark, which the page of a scene brings along, as a second reader of files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.splats import html
from recon_cli.splats.ply import write_ply

if TYPE_CHECKING:
    from browser import WatchedPage
    from playwright.sync_api import Route

_WEB = Path(html.__file__).parent / "web"
_ADDRESS = "http://spark.test/"  # answered by the test itself
_PAGE = """<link rel="icon" href="data:,"><script type="importmap">{"imports": {
  "three": "./three.module.min.js", "three/addons/postprocessing/Pass.js": "./Pass.js"}}</script>
<script type="module">
import {SplatMesh} from "./spark.module.min.js";
window.decode = async url => {
  const mesh = new SplatMesh({url}), rows = [];
  await mesh.initialized;
  // with a tree, its Gaussians and those of the levels
  const all = mesh.packedSplats.lodSplats ?? mesh;
  all.forEachSplat((i, center, scales, quat, opacity, color) => rows.push(
    [...center.toArray(), ...scales.toArray(), ...quat.toArray(), opacity, ...color.toArray()]));
  const extra = Object.entries(mesh.packedSplats.extra).filter(
    ([name, words]) => /^sh\\d$/.test(name) && words);
  return [rows, Object.fromEntries(extra.map(([name, words]) => [name, [...words]]))];
};
</script>"""


def decode(page: WatchedPage, path: Path) -> Any:
    """Returns the rows and the coefficients that Spark reads from a file.

    A row is centre, sizes, quaternion xyzw, opacity and colour. Fails where Spark complains.
    """
    def answer(route: Route) -> None:
        name = route.request.url.removeprefix(_ADDRESS)
        if not name:
            route.fulfill(body=_PAGE, content_type="text/html")
        else:
            route.fulfill(path=path if name == path.name else _WEB / name)

    page.page.route(f"{_ADDRESS}**", answer)
    page.page.goto(_ADDRESS)
    page.page.wait_for_function("window.decode")
    found = page.page.evaluate("name => window.decode(name)", path.name)
    page.assert_silent()
    return found


def assert_spark_agrees(page: WatchedPage, path: Path, splats: Splats) -> None:
    """Fails unless Spark reads from a file what recon did: `splats`.

    Spark packs centres into float16, and sizes, rotations and colours into bytes; coefficients are
    compared bit for bit with those that it reads from a .ply of `splats`.
    """
    again = path.with_name("again.ply")
    write_ply(again, splats)
    rows, harmonics = decode(page, path)
    table = np.array(rows)
    quats = splats.quats.double().numpy()[:, [1, 2, 3, 0]]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    turn = abs((table[:, 6:10] * quats).sum(axis=1))
    means, log_scales = splats.means.numpy(), splats.log_scales.numpy()
    colors = SH_C0 * splats.sh_dc.numpy() + 0.5
    assert np.allclose(table[:, :3], means, rtol=1e-3, atol=1e-3)
    assert np.allclose(np.log(table[:, 3:6]), log_scales, atol=0.05)
    assert turn.min() > 0.9998
    assert np.allclose(table[:, 10], splats.opacities.numpy(), atol=0.005)
    assert np.allclose(table[:, 11:].clip(0, 1), colors.clip(0, 1), atol=0.005)
    assert len(harmonics) == splats.sh_degree
    assert harmonics == decode(page, again)[1]
