import numpy as np

from recon_cli.sfm.checks import Histogram


def test_every_count_falls_into_one_of_ten_bins():
    histogram = Histogram.of(np.array([0, 9, 10, 99, 99]))
    assert histogram.edges == (0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100)
    assert histogram.counts == (2, 1, 0, 0, 0, 0, 0, 0, 0, 2)
    assert histogram.median == 10


def test_no_counts_are_an_empty_histogram():
    histogram = Histogram.of(np.zeros(0, np.int64))
    assert sum(histogram.counts) == 0
    assert histogram.median == 0
