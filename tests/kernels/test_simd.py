"""Operators and functions of SIMD lanes against numpy, one compiled probe for each family."""

import operator
import threading

import numba
import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.errors import TypingError

from recon_cli.kernels.simd import LANES
from recon_cli.kernels.simd_functions import (
    absolute,
    bits,
    broadcast,
    count_bits,
    exp2,
    fetch_add,
    fill,
    floor,
    fma,
    lane_numbers,
    largest,
    load,
    load_bytes,
    log2,
    lowest_bit,
    maximum,
    minimum,
    select,
    square_root,
    store,
    total,
    totals,
    transpose,
)

F32 = np.float32
EPSILON = float(np.finfo(F32).eps)  # 2^-23
# The polynomial's own error (7.5e-8, said beside it) and three roundings of Estrin's scheme.
EXP2_TOLERANCE = 7.5e-8 + 1.5 * EPSILON
# log2(1 + t) = t P(t) + whole: the polynomial's error and the rounding of P, t P and the sum.
LOG2_TOLERANCE = 2.6e-8 + 2 * EPSILON  # relative near 1, of max(1, |log2|) elsewhere
SPECIAL = [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-40, -1e-40, 3e38, 0.5, 2.5, -2.5,
           1e-20, 7.0, -3.75]

compiled = numba.njit(nogil=True, error_model="numpy")  # as kernels are


def vector(seed):
    return np.random.default_rng(seed).normal(size=LANES).astype(F32)


def mask_of(number):
    return np.array([bool(int(number) >> i & 1) for i in range(LANES)])


# ---- operators ----

@compiled
def arithmetic_probe(x, y, number, out):
    a, b = load(x, 0), load(y, 0)
    store(out, 0, a + b)
    store(out, LANES, a - b)
    store(out, 2 * LANES, a * b)
    store(out, 3 * LANES, a / b)
    store(out, 4 * LANES, -a)
    store(out, 5 * LANES, a + number)
    store(out, 6 * LANES, number - a)
    store(out, 7 * LANES, a * 2)
    store(out, 8 * LANES, 1.0 / b)
    store(out, 9 * LANES, minimum(a, b))
    store(out, 10 * LANES, maximum(a, b))
    store(out, 11 * LANES, absolute(a))
    store(out, 12 * LANES, square_root(a))
    store(out, 13 * LANES, floor(a))
    store(out, 14 * LANES, select(a < b, a, b))
    store(out, 15 * LANES, select(a < b, 1.0, number))


def expected_arithmetic(a, b, number):
    with np.errstate(all="ignore"):
        return [a + b, a - b, a * b, a / b, -a, a + number, number - a, a * F32(2), F32(1) / b,
                np.where(a < b, a, b), np.where(a > b, a, b), np.abs(a), np.sqrt(a), np.floor(a),
                np.where(a < b, a, b), np.where(a < b, F32(1), number)]


@pytest.mark.parametrize("shift", range(len(SPECIAL)))
def test_arithmetic_and_choice_equal_numpy_bit_by_bit_for_special_values(shift):
    x = np.resize(np.array(SPECIAL, F32), LANES)
    y = np.resize(np.roll(np.array(SPECIAL, F32), shift), LANES)
    number, out = F32(1.25), np.empty(16 * LANES, F32)
    arithmetic_probe(x, y, number, out)
    for row, truth in zip(out.reshape(16, LANES), expected_arithmetic(x, y, number), strict=True):
        assert np.array_equal(row, truth, equal_nan=True)
        numbers = ~np.isnan(truth)
        assert np.array_equal(np.signbit(row[numbers]), np.signbit(truth[numbers]))


@settings(max_examples=examples(50))
@given(st.lists(st.floats(width=32), min_size=2 * LANES, max_size=2 * LANES))
def test_arithmetic_and_choice_equal_numpy_bit_by_bit(values):
    x, y = np.array(values, F32).reshape(2, LANES)
    number, out = F32(-0.75), np.empty(16 * LANES, F32)
    arithmetic_probe(x, y, number, out)
    for row, truth in zip(out.reshape(16, LANES), expected_arithmetic(x, y, number), strict=True):
        assert np.array_equal(row, truth, equal_nan=True)


def test_minimum_and_maximum_return_the_second_operand_beside_nan():
    nan, one = np.full(LANES, np.nan, F32), np.ones(LANES, F32)
    out = np.empty(16 * LANES, F32)
    for x, y, keeps in ((nan, one, True), (one, nan, False)):
        arithmetic_probe(x, y, F32(0), out)
        assert np.isfinite(out[9 * LANES : 11 * LANES]).all() == keeps


@compiled
def comparison_probe(x, y, number, out):
    a, b = load(x, 0), load(y, 0)
    out[0], out[1], out[2] = bits(a < b), bits(a <= b), bits(a > b)
    out[3], out[4] = bits(a >= b), bits(a == b)
    out[5], out[6] = bits(a < number), bits(number >= a)
    out[7], out[8] = bits((a < b) & (a > number)), bits((a < b) | (a > number))


@pytest.mark.parametrize("shift", range(len(SPECIAL)))
def test_comparisons_are_false_wherever_nan_takes_part(shift):
    x = np.resize(np.array(SPECIAL, F32), LANES)
    y = np.resize(np.roll(np.array(SPECIAL, F32), shift), LANES)
    number, out = F32(0.5), np.zeros(9, np.uint64)
    comparison_probe(x, y, number, out)
    truths = [f(x, y) for f in (
        operator.lt, operator.le, operator.gt, operator.ge, operator.eq)]
    truths += [x < number, number >= x, (x < y) & (x > number), (x < y) | (x > number)]
    for found, truth in zip(out, truths, strict=True):
        assert np.array_equal(mask_of(found), truth)
        assert int(found) >> LANES == 0


def test_operators_of_lanes_refuse_what_is_no_number():
    @compiled
    def add_mask(x):
        return total(load(x, 0) + (load(x, 0) < 1.0))

    @compiled
    def and_lanes(x):
        return total(load(x, 0) & load(x, 0))

    for wrong in (add_mask, and_lanes):
        with pytest.raises(TypingError):
            wrong(np.zeros(LANES, F32))


# ---- functions ----

@compiled
def fill_probe(number, whole, out):
    store(out, 0, fill(number))
    store(out, LANES, fill(whole))
    store(out, 2 * LANES, lane_numbers())


def test_fill_and_lane_numbers():
    out = np.empty(3 * LANES, F32)
    fill_probe(1 / 3, 7, out)
    assert np.array_equal(out.reshape(3, LANES), [
        np.full(LANES, F32(1 / 3)), np.full(LANES, F32(7)), np.arange(LANES)])


@compiled
def fma_probe(x, y, z, out):
    store(out, 0, fma(load(x, 0), load(y, 0), load(z, 0)))
    store(out, LANES, fma(load(x, 0), 3.0, 1))


def test_fma_is_off_by_at_most_the_rounding_of_the_product_and_the_sum():
    x, y, z = (vector(seed) for seed in range(3))
    out = np.empty(2 * LANES, F32)
    fma_probe(x, y, z, out)
    product = x.astype(float) * y
    bound = EPSILON / 2 * (np.abs(product) + np.abs(product + z))
    assert (np.abs(out[:LANES] - (product + z)) <= bound).all()
    assert np.allclose(out[LANES:], 3 * x.astype(float) + 1, rtol=2 * EPSILON, atol=EPSILON)


@compiled
def exp2_all(values, out):
    for i in range(0, len(values), LANES):
        store(out, i, exp2(load(values, i)))


@compiled
def log2_all(values, out):
    for i in range(0, len(values), LANES):
        store(out, i, log2(load(values, i)))


def exp2_of(values):
    values = np.asarray(values, F32)
    padded = np.resize(values, -(-len(values) // LANES) * LANES)
    out = np.empty_like(padded)
    exp2_all(padded, out)
    return out[: len(values)]


def log2_of(values):
    values = np.asarray(values, F32)
    padded = np.resize(values, -(-len(values) // LANES) * LANES)
    out = np.empty_like(padded)
    log2_all(padded, out)
    return out[: len(values)]


def test_exp2_keeps_its_relative_error_over_the_whole_range():
    values = np.linspace(-126, 127, 2_000_000, dtype=F32)
    truth = np.exp2(values.astype(float))
    error = np.abs(exp2_of(values) - truth) / truth
    assert error.max() < EXP2_TOLERANCE


def test_exp2_is_good_to_two_units_at_whole_numbers_and_at_the_ends():
    whole = np.arange(-126, 128).astype(F32)
    assert np.allclose(exp2_of(whole), np.exp2(whole.astype(float)), rtol=EPSILON, atol=0)
    halves = np.concatenate([whole[:-1] + F32(0.5), np.nextafter(whole[:-1] + F32(0.5), F32(-200)),
                             np.nextafter(whole[1:], F32(-200))])
    truth = np.exp2(halves.astype(float))
    assert (np.abs(exp2_of(halves) - truth) / truth).max() < EXP2_TOLERANCE


def test_exp2_returns_outside_its_range_without_a_trap():
    out = exp2_of([-1000, 1000, 3e38, -3e38, np.inf, -np.inf, np.nan, -127.5, 128])
    assert len(out) == 9


def test_log2_keeps_its_error_over_all_normal_numbers():
    raw = np.linspace(0x00800000, 0x7F7FFFFF, 2_000_000).astype(np.uint32)
    values = raw.view(F32)
    truth = np.log2(values.astype(float))
    error = np.abs(log2_of(values) - truth) / np.maximum(1, np.abs(truth))
    assert error.max() < LOG2_TOLERANCE


def test_log2_near_one_keeps_its_relative_error():
    values = np.linspace(np.sqrt(0.5) + 1e-6, np.sqrt(2) - 1e-6, 1_000_000).astype(F32)
    values = values[values != 1]
    truth = np.log2(values.astype(float))
    assert (np.abs(log2_of(values) - truth) / np.abs(truth)).max() < LOG2_TOLERANCE
    assert log2_of([1.0])[0] == 0
    assert np.array_equal(log2_of([2.0**-126, 0.5, 2, 2.0**127]), [-126, -1, 1, 127])


@compiled
def number_probe(values, out):
    for i in range(len(values)):
        out[2 * i] = lowest_bit(values[i])
        out[2 * i + 1] = count_bits(values[i])


@settings(max_examples=examples(50))
@given(st.lists(st.integers(1, 2**64 - 1), min_size=1, max_size=8))
def test_lowest_bit_and_count_bits_of_any_uint64(values):
    out = np.zeros(2 * len(values), np.int64)
    number_probe(np.array(values, np.uint64), out)
    for value, lowest, count in zip(values, out[::2], out[1::2], strict=True):
        assert lowest == (value & -value).bit_length() - 1
        assert count == value.bit_count()


def test_bit_functions_refuse_signed_numbers():
    @compiled
    def wrong(value):
        return lowest_bit(value)

    with pytest.raises(TypingError):
        wrong(np.int64(4))


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
    store(out, 1 + 2 * LANES, broadcast(x, at))
    store(out, 1 + 3 * LANES, load(x, at))


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
