"""Probes of a backend while it renders: the time of each stage, and the pairs evaluated.

A probe changes nothing that is computed. A backend without one is timed from outside only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from recon_cli.experiments.instruments import Stopwatch
from recon_cli.render.contract import RenderOutput
from recon_cli.render.numba.thread_pool import pool
from recon_cli.render.torch import blocks, tiles

COMPOSITE, DECOMPOSE = "composite", "decompose"  # the stages whose pairs are counted
# what results on disk call these kernels
_STAGES = {"composite_backward": DECOMPOSE, "project_backward": "unproject"}


class Probe:
    """Measures a backend while `watch`."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}  # by stage, since `collect` was last called

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Measures within the block. This one sees nothing."""
        yield

    def collect(self) -> dict[str, float]:
        """Returns the milliseconds since the last call and starts anew."""
        collected, self.ms = self.ms, {}
        return collected

    def pairs(self, output: RenderOutput) -> tuple[int, int] | None:  # noqa: ARG002
        """Returns pairs forward and backward of an output that has been through both passes."""
        return None

    def _add(self, name: str, ms: float) -> None:
        self.ms[name] = self.ms.get(name, 0.0) + ms


class NumbaProbe(Probe):
    """Observes the thread pool, which runs every parallel kernel."""

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Measures kernels within the block."""
        pool.observer = lambda name, seconds: self._add(
            _STAGES.get(name, name), 1e3 * seconds)
        try:
            yield
        finally:
            pool.observer = None

    def pairs(self, output: RenderOutput) -> tuple[int, int] | None:
        """Returns what the kernels counted: a row of a tile counts all its pixels."""
        view_pass = output.rgb.grad_fn.lease.view_pass  # type: ignore[union-attr]
        return view_pass.pairs_forward, view_pass.pairs_backward


class TorchProbe(Probe):
    """Stands between the torch backend and its own functions."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self._device = device
        self._pairs = [0, 0]  # forward, backward
        self._backward = False

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Measures projection, binning and compositing within the block."""
        with ExitStack() as stack:
            for place, name, label in (
                (tiles, "project", "project"), (tiles, "bin_to_tiles", "bin_to_tiles"),
                (tiles._Rasterize, "forward", COMPOSITE),
                (tiles._Rasterize, "backward", DECOMPOSE),
            ):
                stack.enter_context(_replace(
                    place, name, self._time_calls(label, getattr(place, name))))
            stack.enter_context(_replace(
                tiles, "alphas", self._count_pairs(blocks.alphas)))
            yield

    def pairs(self, output: RenderOutput) -> tuple[int, int] | None:  # noqa: ARG002
        """Returns what the blocks held: every pixel of a tile for every instance."""
        return self._pairs[0], self._pairs[1]

    def _time_calls(self, label: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any) -> Any:
            if label in (COMPOSITE, DECOMPOSE):
                self._backward = label == DECOMPOSE
                self._pairs[self._backward] = 0
            watch = Stopwatch(self._device)
            result = work(*args)
            watch.mark(label)
            self._add(label, watch.ms[label])
            return result

        return run

    def _count_pairs(self, alphas: Callable[..., Any]) -> Callable[..., Any]:
        def run(table: Any, block: Any, *rest: Any) -> Any:
            self._pairs[self._backward] += block.rows.numel() * blocks.PIXELS
            return alphas(table, block, *rest)

        return run


@contextmanager
def _replace(place: Any, name: str, function: Callable[..., Any]) -> Iterator[None]:
    """Puts another function under a name of a module, or of a class as a static method."""
    original = vars(place)[name]
    setattr(place, name, staticmethod(function) if isinstance(place, type) else function)
    try:
        yield
    finally:
        setattr(place, name, original)


def probe_for(backend: str, device: str) -> Probe:
    """Returns the probe of a backend."""
    if backend == "numba":
        return NumbaProbe()
    return TorchProbe(device) if backend == "torch" else Probe()
