import numpy as np
import pytest

from recon_cli.splats.codebooks import (
    fit_centres_on_line,
    fit_codebook,
    fit_palette,
    nearest_entries,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize("draw", [
    lambda rng: rng.normal(size=200_000), lambda rng: rng.uniform(-3, 9, 50_000),
    lambda rng: rng.laplace(size=70_000), lambda rng: np.append(rng.normal(size=5_000), 1e6)])
def test_a_codebook_errs_no_more_than_even_steps_would(rng, draw):
    values = draw(rng).astype(np.float32)
    book = fit_codebook(values, rng)
    error = values - book[nearest_entries(values, book)]
    even = (values.max() - values.min()) / 256 / np.sqrt(12)
    # Even numbers cannot be beaten on even values; a sample of them comes close.
    assert np.sqrt((error.astype(np.float64) ** 2).mean()) < 1.05 * even


def test_sorted_numbers_give_the_centres_of_lloyds_algorithm(rng):
    values = np.sort(rng.standard_t(2, size=2_000))
    centres = np.unique(np.append(np.linspace(*values[[0, -1]], 40), values[::100]))
    expected = centres
    for _ in range(5):
        nearest = np.abs(values[:, None] - expected).argmin(axis=1)
        expected = np.array([
            values[nearest == k].mean() if (nearest == k).any() else centre
            for k, centre in enumerate(expected)])
    np.testing.assert_allclose(fit_centres_on_line(values, centres, 5), expected, rtol=1e-12)


def test_as_many_values_as_numbers_are_kept_as_they_are(rng):
    values = np.repeat(rng.normal(size=100).astype(np.float32), 7)
    book = fit_codebook(values, rng)
    np.testing.assert_allclose(book[nearest_entries(values, book)], values, atol=1e-6)


@pytest.mark.parametrize("values", [[3.5], [0.0, 0.0], [-1e30, 1e30], [1e-30, 2e-30]])
def test_few_values_make_a_whole_codebook(rng, values):
    values = np.array(values, np.float32)
    book = fit_codebook(values, rng)
    assert book.shape == (256,)
    assert (np.diff(book) >= 0).all()
    np.testing.assert_allclose(book[nearest_entries(values, book)], values, rtol=1e-6)


def test_the_nearest_number_is_taken(rng):
    values, book = rng.normal(size=500).astype(np.float32), np.sort(rng.normal(size=256))
    book = book.astype(np.float32)
    found = np.abs(values - book[nearest_entries(values, book)])
    np.testing.assert_allclose(found, np.abs(values[:, None] - book).min(axis=1), atol=1e-7)


def test_rows_of_few_kinds_are_their_own_palette(rng):
    kinds = rng.normal(size=(20, 45)).astype(np.float32)
    rows = kinds[rng.integers(0, 20, 4000)]
    entries, labels = fit_palette(rows, 250, rng)
    assert len(entries) <= 250
    # the mean of equal float32 numbers is off by the rounding of their sum
    np.testing.assert_allclose(entries[labels], rows, atol=3e-5)


def test_a_larger_palette_errs_less_and_every_entry_is_used(rng):
    rows = rng.normal(size=(3000, 9)).astype(np.float32)
    errors = []
    for size in (1, 10, 100, 1000):
        entries, labels = fit_palette(rows, size, np.random.default_rng(1))
        assert len(entries) <= size
        assert set(labels) == set(range(len(entries)))
        errors.append(((rows - entries[labels]) ** 2).mean())
    assert errors[0] == pytest.approx(rows.var(axis=0).mean(), rel=1e-4)
    assert errors[0] > 1.1 * errors[1] > 1.2 * errors[2] > 1.4 * errors[3]


@pytest.mark.parametrize("rows", [
    np.zeros((1, 9)), np.zeros((50, 45)), np.eye(9), 1e25 * np.eye(9), 1e-25 * np.eye(9)])
def test_equal_rows_and_single_ones_have_a_palette(rng, rows):
    rows = rows.astype(np.float32)
    entries, labels = fit_palette(rows, len(rows), rng)
    np.testing.assert_allclose(entries[labels], rows, rtol=1e-6)


def test_the_same_seed_gives_the_same_palette():
    rows = np.random.default_rng(3).normal(size=(2000, 24)).astype(np.float32)
    one, other = (fit_palette(rows, 200, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])


def test_the_few_among_many_alike_have_entries_of_their_own(rng):
    rows = rng.normal(0, 1e-3, (4000, 9)).astype(np.float32)
    rows[::100] = rng.normal(size=(40, 9))
    entries, labels = fit_palette(rows, 250, rng)
    error = np.abs(entries[labels] - rows).max(axis=1)
    assert np.median(error[::100]) < 1e-6


def test_zeros_among_others_are_one_entry(rng):
    rows = np.zeros((20_000, 9), np.float32)
    rows[::100] = rng.normal(size=(200, 9))
    entries, labels = fit_palette(rows, 1000, rng)
    np.testing.assert_allclose(entries[labels], rows, atol=1e-6)
    assert len(entries) == 201


def test_rows_that_differ_by_the_sign_of_a_zero_are_one(rng):
    rows = np.tile(np.array([[0.0, 2.0], [-0.0, 2.0]], np.float32), (50, 1))
    entries, labels = fit_palette(rows, 10, rng)
    assert len(entries) == 1
    assert not labels.any()
