"""The same picture, gradients and statistics, bit by bit, whatever the threads and the order."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from backends import BLACK, CASES, GREENISH, at_size, every_backend_at_size
from scenes import camera_at, random_splats

from recon_cli.render import Statistics

THREADS = (1, 2, 3, 7)
# Sums of matrix products may be taken in another order by another number of torch's threads.
THREADS_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-12}
# Ties apart, the order of the input changes no term and no order of composition.
ORDER_TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-12}


def everything(case, splats, camera):
    """The images, all gradients and all statistics of a picture, by name."""
    tracked = case.leaves(splats)
    out = case.render(tracked, camera, GREENISH, 3, scores=True)
    (out.rgb.square().sum() + out.depth.sum() + out.alpha.square().sum()).backward()
    found = {"rgb": out.rgb, "alpha": out.alpha, "depth": out.depth}
    found |= {f"gradient of {name}": p.grad for name, p in tracked.parameters().items()}
    found |= {field.name: getattr(out.statistics, field.name) for field in fields(Statistics)
              if isinstance(getattr(out.statistics, field.name), torch.Tensor)}
    return {name: value.detach().cpu() for name, value in found.items()}


def scene_for(case):
    """Returns a scene and its camera, smaller for an interpreter, which takes minutes else."""
    count, width, height = (150, 35, 20) if case.interpreted else (3000, 90, 70)
    return random_splats(count, seed=2), camera_at(width, height)


@pytest.fixture
def threads():
    """Sets the number of threads, and puts it back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@every_backend_at_size
def test_the_same_input_gives_the_same_bits(case):
    splats, camera = scene_for(case)
    first, second = (everything(case, splats, camera) for _ in range(2))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@pytest.mark.integration
@pytest.mark.parametrize("case", at_size([c for c in CASES if c.device == "cpu"]), ids=str)
def test_the_number_of_threads_changes_nothing(case, threads):
    splats, camera = scene_for(case)
    found, counts = {}, THREADS if case.backend == "numba" else THREADS[:2]
    for count in counts:
        threads(count)
        found[count] = everything(case, splats, camera)
    for count in counts[1:]:
        for name, value in found[count].items():
            expected = found[1][name]
            if case.backend == "numba":
                assert torch.equal(value, expected), f"{name} with {count} threads"
            else:
                error = (value - expected).double().norm() / expected.double().norm()
                assert error <= THREADS_TOLERANCE[case.dtype], f"{name} with {count} threads"


@every_backend_at_size
def test_the_order_of_the_gaussians_does_not_matter(case):
    count = 100 if case.interpreted else 200
    splats, camera = random_splats(count, seed=3), camera_at(33, 20)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    first = everything(case, splats, camera)
    second = everything(case, splats.select(order), camera)
    for name, value in second.items():
        expected = first[name] if name in ("rgb", "alpha", "depth") else first[name][order]
        scale = max(1.0, expected.abs().max().item())
        error = (value - expected).abs().max().item()
        assert error <= ORDER_TOLERANCE[case.dtype] * scale, name


@every_backend_at_size
def test_a_picture_does_not_remember_the_one_before_it(case):
    splats, small = random_splats(100, seed=4), camera_at(20, 20)
    alone = everything(case, splats, small)
    everything(case, *scene_for(case))  # leaves larger buffers
    again = everything(case, splats, small)
    for name, value in alone.items():
        assert torch.equal(value, again[name]), name


@every_backend_at_size
def test_two_pictures_may_wait_for_their_backward_passes(case):
    splats, camera, other = random_splats(60, seed=4), camera_at(33, 20), camera_at(31, 23)
    alone = everything(case, splats, camera)
    tracked = case.leaves(splats)
    first = case.render(tracked, camera, GREENISH, 3, scores=True)
    second = case.render(case.leaves(random_splats(100, seed=6)), other, BLACK, 3, scores=True)
    second.rgb.sum().backward()
    (first.rgb.square().sum() + first.depth.sum() + first.alpha.square().sum()).backward()
    for name, parameter in tracked.parameters().items():
        assert torch.equal(parameter.grad.cpu(), alone[f"gradient of {name}"]), name
