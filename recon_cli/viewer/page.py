"""viser's page made recon's own: title, icon, a panel that leaves a phone's picture free.

viser has no settings for these, so they are changed in the HTML as it is served.
"""

from __future__ import annotations

import gzip
import html
from functools import lru_cache

from websockets.http11 import Response

from recon_cli.splats.html import ICON

# The panel of a narrow window opens over the picture: a click folds it, as one on its head does.
# three complains that viser's quad of a Gaussian has two coordinates; every picture is right.
_SCRIPT = """<script>
(() => {
  const plain = console.error;
  console.error = (...words) => {
    if (!String(words[0]).includes("computeBoundingSphere(): Computed radius is NaN")) {
      plain(...words);
    }
  };
  const icon = document.querySelector("link[rel=icon]");
  if (icon) icon.href = ICON;
  if (!matchMedia("(max-width: 36em)").matches) return;
  const fold = new MutationObserver(() => {
    const head = document.querySelector(
      "#root [style*='bottom: 0px'][style*='position: fixed'] [style*='cursor: pointer']");
    if (!head) return;
    fold.disconnect();
    head.click();
  });
  fold.observe(document, { childList: true, subtree: true });
})();
</script>"""


def rename_page(response: Response | None, title: str) -> Response | None:
    """Returns the answer to a request, as recon's where it is viser's page."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    packed = response.headers.get("Content-Encoding") == "gzip"
    response.body = _rewrite(bytes(response.body or b""), packed, title)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


@lru_cache(maxsize=4)
def _rewrite(body: bytes, packed: bool, title: str) -> bytes:
    page = (gzip.decompress(body) if packed else body).decode("utf-8")
    own = f"<title>{html.escape(title)}</title>{_SCRIPT.replace('ICON', repr(ICON))}"
    page = page.replace("<title>Viser</title>", own, 1)
    data = page.encode("utf-8", "replace")
    return gzip.compress(data) if packed else data
