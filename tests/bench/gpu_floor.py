"""How far each stage of a training step is from what the device could do at best.

The floor of a stage is the time for the bytes that it must move, each input read once and each
output written once, at the bandwidth of a large copy; or for the operations that it must do, at the
peak of multiply-adds in float32, whichever is more. With N Gaussians of degree 3, S of them seen in
E instances, T tiles, P pixels and Q pairs of a Gaussian and a pixel:

    project             44 N + 192 S read; 8 N + 72 S written: two numbers of all, the record
                        (32 bytes), shape (20), centre (16) and depth (4) of those that are seen
    prefix sum, admit   4 N read, 4 N written
    list_tiles          4 N + 40 S read, key and Gaussian (12 bytes) of E written
    sort                8 E read; key and slot (12 bytes) of E written
    place               16 E + 28 S read, 12 E written
    tile ranges         8 E read, 8 T written
    composite           12 E + 32 S read; 12 bytes a pixel, 8 of each pixel of a tile written;
                        31 operations a pair
    loss                15 P read, 12 P written; (216 + 144) operations a number of the picture
    composite backward  16 E + 32 S + 12 P + 8 of each pixel of a tile read; 36 E written, nine
                        sums; 49 operations a pair
    project backward    36 E + 4 N + 268 S read, 244 N written
    adam                28 bytes for each of 59 numbers: four are read, three written

Q counts all 256 pixels of a tile for every instance up to the last one that any of them shows: what
anybody must look at who composites by tiles. What the forward pass keeps for the backward is no
part of the floor. How many of these pairs contribute is told beside.
Operations are counted as for CPUs (tests/bench/notes/rasterizers.md), a multiply-add as two; where
only bytes stand above, operations are fewer. Three of four steps leave the harmonics as they are
and take a fourth of adam's time.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from unittest import mock

import torch
import triton
from gpu_clock import StageClock, between, clear, hold, in_turn, middle, moment
from gpu_figures import Figures, Goal
from gpu_scene import AFTER, photometric, training, without_graphs

from recon_cli.experiments.bench_scene import SceneSize
from recon_cli.render import render
from recon_cli.render.contract import TILE, StepOptions
from recon_cli.render.triton import passes
from recon_cli.render.triton import step as triton_step
from recon_cli.train.gradient import gradient_step

SHARE = Goal(0, 40)  # percent of the floor; the least is to be known
_COPIED = 1 << 31  # bytes; many times any cache
_COPIED_HERE = 1 << 24
_LANES = {(7, 5): 64, (8, 0): 64}  # float32 units of a multiprocessor; 128 in all others


@dataclass(frozen=True)
class Counts:
    """What there is to do in a step, by the letters above."""

    N: int
    S: int
    E: int
    T: int
    P: int
    Q: int


@dataclass(frozen=True)
class Stage:
    """A stage, the functions whose calls it is made of, and what it must do.

    Attributes:
        functions: by module and name.
        bytes: to be moved.
        operations: to be done.
    """

    functions: tuple[tuple[object, str], ...]
    bytes: Callable[[Counts], float]
    operations: Callable[[Counts], float] = lambda _: 0.0

    def floor(self, counts: Counts, bandwidth: float, peak: float) -> float:
        """Returns the milliseconds that it takes at bytes and operations a second."""
        return 1e3 * max(self.bytes(counts) / bandwidth, self.operations(counts) / peak)


_AREA = TILE * TILE
STAGES = {
    "project": Stage(
        ((triton_step, "project_splats"),), lambda c: 52 * c.N + 264 * c.S),
    "prefix sum, admit": Stage(
        ((passes, "prefix_sums"), (triton_step, "admit_step")), lambda c: 8 * c.N),
    "list_tiles": Stage(((passes, "list_instances"),), lambda c: 4 * c.N + 40 * c.S + 12 * c.E),
    "sort": Stage(((passes, "sort_keys"),), lambda c: 20 * c.E),
    "place": Stage(((passes, "place_instances"),), lambda c: 28 * c.E + 28 * c.S),
    "tile ranges": Stage(((passes, "tile_ranges"),), lambda c: 8 * c.E + 8 * c.T),
    "composite": Stage(
        ((triton_step, "composite_tiles"),),
        lambda c: 12 * c.E + 32 * c.S + 12 * c.P + 8 * _AREA * c.T, lambda c: 31 * c.Q),
    "loss": Stage(
        ((triton_step, "loss_and_gradient"),), lambda c: 27 * c.P, lambda c: 3 * 360 * c.P),
    "composite backward": Stage(
        ((triton_step, "composite_tiles_backward"),),
        lambda c: 52 * c.E + 32 * c.S + 12 * c.P + 8 * _AREA * c.T, lambda c: 49 * c.Q),
    "project backward": Stage(
        ((triton_step, "project_splats_backward"),), lambda c: 36 * c.E + 248 * c.N + 268 * c.S),
    "adam": Stage((), lambda c: 28 * 59 * c.N),
}


def run(figures: Figures, size: SceneSize, rounds: int) -> None:
    """Times the stages of a step and prints them beside their floors."""
    bandwidth, peak = copy_bandwidth(figures, rounds), peak_operations(figures)
    ms, whole, counts, contributing = staged(figures, size, rounds)
    figures.say(f"N {counts.N:,}, S {counts.S:,}, E {counts.E:,}, T {counts.T:,}, P {counts.P:,}, "
                f"Q {counts.Q:,}, of which {contributing:,} contribute")
    figures.more["counts"] = {**vars(counts), "contributing": contributing}
    for name, stage in STAGES.items():
        moved, done = stage.bytes(counts), stage.operations(counts)
        floor = stage.floor(counts, bandwidth, peak)
        figures.add(f"stage {name}", ms[name], "ms", note=(
            f"floor {floor:.3f} ms ({moved / 1e6:,.0f} MB, {done / 1e9:,.1f} GFLOP): "
            f"{share(floor, ms[name]):.0f}%"))
    figures.add("between the stages", whole - sum(ms.values()), "ms",
                note="copies of view and photograph, and small operations")
    for name, one, goal in (
        ("share of the floor, all stages", counts, SHARE),
        ("the same by pairs that contribute", replace(counts, Q=contributing), None),
    ):
        floor = sum(stage.floor(one, bandwidth, peak) for stage in STAGES.values())
        figures.add(name, share(floor, whole), "%", goal, note=f"{floor:.2f} of {whole:.2f} ms")


def share(floor: float, ms: float) -> float:
    """Returns the percentage that the floor is of a time."""
    return 100 * floor / ms if ms > 0 else 0.0


def copy_bandwidth(figures: Figures, rounds: int) -> float:
    """Returns bytes a second, read and written, of a large copy on the device."""
    size = _COPIED if figures.device == "cuda" else _COPIED_HERE
    source = torch.randint(0, 255, (size,), dtype=torch.uint8, device=figures.device)
    target = torch.empty_like(source)
    ms = middle(in_turn({"": lambda: target.copy_(source)}, max(rounds, 5), figures.device)[""])
    figures.add("copy bandwidth", 2 * size / ms / 1e6, "GB/s", note="bytes read and written")
    clear(figures.device)
    return 2e3 * size / ms


def peak_operations(figures: Figures) -> float:
    """Returns the float32 operations a second that the device's properties promise."""
    if figures.device == "cpu":
        figures.say("no peak of the CPU is taken: 1 TFLOP/s stands for it")
        return 1e12
    found = torch.cuda.get_device_properties(0)
    lanes = _LANES.get((found.major, found.minor), 128)
    clock = 1e3 * triton.runtime.driver.active.utils.get_device_properties(
        torch.cuda.current_device())["sm_clock_rate"]  # kHz
    peak = found.multi_processor_count * lanes * 2 * clock
    figures.add("peak in float32", peak / 1e12, "TFLOP/s", note=(
        f"{found.multi_processor_count} multiprocessors x {lanes} x 2 x {clock / 1e9:.2f} GHz"))
    return peak


def staged(
    figures: Figures, size: SceneSize, rounds: int
) -> tuple[dict[str, float], float, Counts, int]:
    """Returns medians by stage, of the whole step, the counts, and the pairs that contribute."""
    device, clock = figures.device, StageClock(figures.device)
    state, task = training(size, device, still=True)
    optimizer, view, schedule = state.optimizer, task.train[0], task.schedule
    with photometric([], graphs=without_graphs()):
        compute = gradient_step("triton", task.device)
    found: dict[str, list[float]] = {name: [] for name in STAGES}
    wholes: list[float] = []
    with ExitStack() as stack:
        for name, stage in STAGES.items():
            for place, function in stage.functions:
                stack.enter_context(mock.patch.object(
                    place, function, clock.wrapped(name, getattr(place, function))))
        move = clock.wrapped("adam", optimizer.step)
        for number in range(rounds + 2):
            hold(device)
            first = moment(device)
            compute.start(optimizer, view, StepOptions(3, schedule.config.ssim_weight))
            move(schedule.means_rate(AFTER), sh_rest=True, counted=compute.counted)
            last = moment(device)
            whole, now = between(first, last), clock.collect()
            account = compute.close()  # makes room where there was too little
            if number < 2 or account.stopped is not None:
                continue
            wholes.append(whole)
            for name in STAGES:
                found[name].append(now[name])
    last_of = clock.results["composite"].last
    with torch.no_grad():
        seen = render(optimizer.splats.map(lambda tensor: tensor.detach()), view.camera,
                      torch.zeros(3, device=device), 3, backend="triton", scores=True).statistics
    tiles = last_of.shape[0]
    counts = Counts(
        size.gaussians, int((seen.radii > 0).sum()), account.instances, tiles,
        size.width * size.height, int(last_of.amax(1).sum()) * _AREA)
    medians = {name: middle(times) for name, times in found.items()}
    return medians, middle(wholes), counts, int(seen.hits.sum())
