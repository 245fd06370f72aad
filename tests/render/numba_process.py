"""A process of its own that gets the kernels ready, renders a scene and writes down what it saw.

Run as `python numba_process.py OUT`. In OUT it leaves report.json, picture.npz and, of every kernel
that it had to compile, the machine code as KERNEL.s: numba can show only what it compiled itself.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba.core.registry import CPUDispatcher
from scenes import camera_at, leaves, random_splats

from recon_cli.kernels import kernel
from recon_cli.kernels.thread_pool import pool
from recon_cli.render import render
from recon_cli.render.numba import (
    backend,
    binning,
    composite_backward,
    compositing,
    loss,
    optimizer,
    project_backward,
    projection,
    soa,
    step,
)

STATISTICS = ("radii", "hits", "blend_sum", "blend_max", "means2d_grad", "variance",
              "loo")
_MODULES = (binning, loss, optimizer, projection, project_backward, composite_backward,
            compositing, step)


def picture(backend: str) -> dict[str, np.ndarray]:
    """Returns image, gradients and all statistics of one scene that no tile size divides."""
    splats = leaves(random_splats(300, seed=5, dtype=torch.float32))
    out = render(splats, camera_at(70, 53), torch.tensor([0.2, 0.5, 0.1]), 3, backend=backend,
                 scores=True)
    generator = torch.Generator().manual_seed(0)
    loss = sum((torch.randn(image.shape, generator=generator) * image).sum()
               for image in (out.rgb, out.alpha, out.depth))
    loss.backward()
    arrays = {name: getattr(out, name).detach().numpy() for name in ("rgb", "alpha", "depth")}
    arrays |= {f"grad.{name}": value.grad.numpy() for name, value in splats.parameters().items()}
    return arrays | {f"stat.{name}": getattr(out.statistics, name).numpy() for name in STATISTICS}


def kernels() -> dict[str, Any]:
    """Returns every kernel that is kept on disk and was used, by name."""
    return {
        name: value for module in _MODULES for name, value in vars(module).items()
        if isinstance(value, CPUDispatcher) and value.__module__ == module.__name__
        and value.targetoptions.get("forceinline") is None and value.signatures}


def main(out: Path) -> None:
    """Writes the report of this process to `out`."""
    torch.set_num_threads(1)
    pool.threads = 1
    ready: list[int] = []
    was_warm = backend.is_warm()
    seconds = backend.warm_up(lambda: ready.append(1))
    np.savez(out / "picture.npz", **picture("numba"))
    folder = kernel.cache_folder()
    used = kernels()
    (out / "report.json").write_text(json.dumps({
        "was_warm": was_warm, "is_warm": backend.is_warm(), "kernels_ready": len(ready),
        "seconds": seconds, "folder": str(folder) if folder else None,
        "lanes": soa.LANES, "tile": [soa.TILE_WIDTH, soa.TILE_HEIGHT],
        "hits": {name: sum(one.stats.cache_hits.values()) for name, one in used.items()},
        "misses": {name: sum(one.stats.cache_misses.values()) for name, one in used.items()},
    }), encoding="utf-8")
    for name, one in used.items():
        if not sum(one.stats.cache_hits.values()):
            code = "\n".join(one.inspect_asm().values())
            (out / f"{name}.s").write_text(code, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
