"""Sums across lanes, loads, stores and the counter that threads share, against numpy."""

import threading

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError

from recon_cli.render.numba.simd import LANES
from recon_cli.render.numba.simd_functions import largest, total, totals
from recon_cli.render.numba.simd_memory import (
    copy,
    fetch_add,
    load,
    load_bytes,
    spread,
    store,
    transpose,
)

F32 = np.float32
EPSILON = float(np.finfo(F32).eps)  # 2^-23

compiled = numba.njit(nogil=True, error_model="numpy")  # as kernels are


# ---- across lanes ----

@compiled
def across_probe(x):
    return total(load(x, 0)), largest(load(x, 0))


def pairwise(values):
    """The order of `total`: halves are added until one number is left."""
    values = values.copy()
    while len(values) > 1:
        half = len(values) // 2
        values = values[:half] + values[half:]
    return values[0]


@pytest.mark.parametrize("seed", range(5))
def test_total_adds_pairwise_and_largest_finds_every_lane(seed):
    x = np.random.default_rng(seed).normal(0, 100, LANES).astype(F32)
    found, greatest = across_probe(x)
    assert found == pairwise(x)
    assert greatest == x.max()
    for lane in range(LANES):
        one = np.zeros(LANES, F32)
        one[lane] = 3
        assert across_probe(one) == (3, 3)
        assert across_probe(-one) == (-3, 0)


if LANES == 16:
    @compiled
    def totals_probe(x, out):
        store(out, 0, totals((
            load(x, 0), load(x, 16), load(x, 32), load(x, 48), load(x, 64), load(x, 80),
            load(x, 96), load(x, 112), load(x, 128), load(x, 144), load(x, 160), load(x, 176),
            load(x, 192), load(x, 208), load(x, 224), load(x, 240))))
else:
    @compiled
    def totals_probe(x, out):
        store(out, 0, totals((
            load(x, 0), load(x, 8), load(x, 16), load(x, 24), load(x, 32), load(x, 40),
            load(x, 48), load(x, 56))))


def test_totals_sums_each_vector_of_a_tuple_into_its_lane():
    whole = np.random.default_rng(0).integers(-1000, 1000, (LANES, LANES)).astype(F32)
    out = np.empty(LANES, F32)
    totals_probe(whole.reshape(-1), out)
    assert np.array_equal(out, whole.sum(1))  # whole numbers: exact in any order
    x = np.random.default_rng(1).normal(size=(LANES, LANES)).astype(F32)
    totals_probe(x.reshape(-1), out)
    bound = LANES * EPSILON * np.abs(x).sum(1)
    assert (np.abs(out - x.astype(float).sum(1)) <= bound).all()


# ---- memory ----

@compiled
def memory_probe(x, raw, at, out):
    store(out, 1, load(x, at))
    store(out, 1 + LANES, load_bytes(raw, at))
    store(out, 1 + 2 * LANES, spread(x, at))
    copy(x, at, out, 1 + 3 * LANES)


@pytest.mark.parametrize("at", [0, 1, 5, 16])
def test_loads_and_stores_begin_anywhere_and_touch_nothing_beside(at):
    x = np.arange(40, dtype=F32) / 3
    raw = np.arange(250, 210, -1).astype(np.uint8)
    out = np.full(2 + 4 * LANES, -7, F32)
    memory_probe(x, raw, at, out)
    assert out[0] == out[-1] == -7
    assert np.array_equal(out[1:-1].reshape(4, LANES), [
        x[at : at + LANES], raw[at : at + LANES].astype(F32), np.full(LANES, x[at]),
        x[at : at + LANES]])


def test_memory_functions_refuse_arrays_of_another_kind():
    @compiled
    def wrong(x):
        return total(load(x, 0))

    for array in (np.zeros(LANES), np.zeros((2, LANES), F32), np.zeros(LANES, np.int32)):
        with pytest.raises(TypingError):
            wrong(array)


@compiled
def transpose_probe(x, at, out, to):
    transpose(x, at, out, to)


@pytest.mark.parametrize(("at", "to"), [(0, 0), (3, 5)])
def test_transpose_moves_every_number_and_nothing_beside(at, to):
    square = LANES * LANES
    x = np.arange(square + 8, dtype=F32)
    out = np.full(square + 8, -1, F32)
    transpose_probe(x, at, out, to)
    block = x[at : at + square].reshape(LANES, LANES)
    assert np.array_equal(out[to : to + square].reshape(LANES, LANES), block.T)
    assert (out[:to] == -1).all()
    assert (out[to + square :] == -1).all()


def test_transpose_works_in_place():
    x = np.arange(LANES * LANES, dtype=F32)
    transpose_probe(x, 0, x, 0)
    assert np.array_equal(x.reshape(LANES, LANES).T.reshape(-1), np.arange(LANES * LANES))


@compiled
def claim(counter, times, taken):
    for _ in range(times):
        taken[fetch_add(counter, 1, 1)] += 1
    fetch_add(counter, 2, -times)


def test_threads_that_add_to_one_counter_lose_nothing():
    times, crowd = 200_000, 4
    counter = np.zeros(3, np.int64)
    taken = np.zeros(times * crowd, np.int64)
    claim(counter, 0, taken)  # compiled before the race
    threads = [threading.Thread(target=claim, args=(counter, times, taken)) for _ in range(crowd)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counter.tolist() == [0, times * crowd, -times * crowd]
    assert (taken == 1).all()  # every number was handed out once
