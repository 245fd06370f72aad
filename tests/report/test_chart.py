"""Axes and marks in closed form, and that nothing in a chart is taken for markup."""

import re

import pytest
from markupsafe import Markup

from recon_cli.report.chart import (
    HEIGHT,
    MARKS,
    WIDTH,
    Axis,
    Scale,
    Series,
    axis_limits,
    draw_chart,
    draw_mark,
    linear_ticks,
    log_ticks,
    tick_label,
)

X, Y = Axis("step"), Axis("PSNR, dB")


def marks(figure):
    return [(float(x), float(y)) for x, y in re.findall(
        r'class="mark[^"]*" d="M([-\d.]+),([-\d.]+)a', figure.split("</svg>")[0])]


def test_ticks_are_round_and_lie_within():
    assert linear_ticks(0, 3000, 6) == [0, 1000, 2000, 3000]
    assert linear_ticks(0.12, 0.88, 6) == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert linear_ticks(-7, 7, 6) == pytest.approx([-5, 0, 5])
    assert log_ticks(1, 100, 7) == pytest.approx([1, 2, 5, 10, 20, 50, 100])
    assert log_ticks(1e-4, 1e4, 5) == pytest.approx([1e-4, 1e-2, 1, 1e2, 1e4])
    assert log_ticks(20, 60, 6) == pytest.approx([20, 30, 40, 50, 60])


@pytest.mark.parametrize(("low", "high"), [
    (0, 1e-9), (1e6, 1e6 + 1), (3, 1e9), (0.001, 0.0011), (17.3, 34.9)])
def test_an_axis_has_two_to_seven_ticks_whatever_its_range(low, high):
    for ticks in (linear_ticks(low, high, 7), log_ticks(max(low, 1e-12), high, 7)):
        assert 2 <= len(ticks) <= 7
        assert ticks == sorted(ticks)


def test_numbers_are_short():
    assert [tick_label(value) for value in (0, 0.02, 7.5, 1500, 20_000, 1.5e6, 2e9)] == [
        "0", "0.02", "7.5", "1,500", "20k", "1.5M", "2G"]


def test_an_axis_is_never_empty_and_counts_begin_at_zero():
    assert axis_limits([100, 3000], log=False)[0] == 0
    low, high = axis_limits([17, 35], log=False)
    assert 15 < low < 17 < 35 < high
    for values, log in (([5], False), ([0, 0], False), ([-3, -3], False), ([2], True)):
        low, high = axis_limits(values, log=log)
        assert low < high
        assert low <= min(values) <= max(values) <= high


def test_a_value_lies_where_its_scale_says():
    linear, log = Scale(0, 10, False, 200.0), Scale(1, 100, True, 200.0)
    assert [linear(value) for value in (0, 5, 10)] == [0, 100, 200]
    assert [log(value) for value in (1, 10, 100)] == pytest.approx([0, 100, 200])


def test_more_is_further_right_and_higher():
    figure = draw_chart("t", X, Y, [Series("a", ((1, 10), (2, 20), (3, 30)), mark="circle")])
    (x1, y1), (x2, y2), (x3, y3) = marks(figure)
    assert 0 < x1 < x2 < x3 < WIDTH
    assert HEIGHT > y1 > y2 > y3 > 0
    assert x2 - x1 == pytest.approx(x3 - x2, abs=0.2)
    assert y1 - y2 == pytest.approx(y2 - y3, abs=0.2)


def test_a_point_lies_on_the_lines_of_its_ticks():
    figure = draw_chart("t", X, Y, [Series("a", ((0, 0), (10, 10)), mark="circle")])
    lines = [{name: float(value) for name, value in re.findall(r'(\w+)="([-\d.]+)"', line)}
             for line in re.findall(r'<line class="grid"[^>]*>', figure)]
    lowest = max(line["y1"] for line in lines if line["y1"] == line["y2"])
    first = min(line["x1"] for line in lines if line["x1"] == line["x2"])
    (x, y), _ = marks(figure)
    assert y == pytest.approx(lowest, abs=0.1)
    assert x + 3.5 == pytest.approx(first, abs=0.1)  # its path begins a radius to the left


def test_decades_are_equally_far_apart_on_a_logarithmic_axis():
    figure = draw_chart("t", Axis("s", log=True), Y, [
        Series("a", ((0, 5), (1, 10), (10, 20), (100, 30)), mark="circle")])
    (x1, _), (x2, _), (x3, _) = marks(figure)  # 0 has no place there
    assert x2 - x1 == pytest.approx(x3 - x2, abs=0.2)


def test_what_is_not_finite_is_left_out_and_nothing_left_is_said():
    points = ((1.0, float("nan")), (float("inf"), 2.0))
    assert "Nothing was recorded" in draw_chart("t", X, Y, [Series("a", points)])
    assert len(marks(draw_chart("t", X, Y, [Series("a", (*points, (1, 2)), mark="circle")]))) == 1


def test_axes_have_labels_with_units_and_a_legend_names_every_series():
    figure = draw_chart("A title", X, Y, [
        Series("one", ((1, 10), (2, 20))), Series("two", ((1, 11), (2, 19)), 1, "square")])
    assert "<figcaption>A title</figcaption>" in figure
    for text in (">step<", ">PSNR, dB<", "</svg>one</li>", "</svg>two</li>"):
        assert text in figure


@pytest.mark.parametrize("shape", MARKS)
def test_every_mark_is_drawn_around_its_place(shape):
    drawn = draw_mark(shape, 50, 40, 4, 0)
    x, y = map(float, re.search(r"M([-\d.]+),([-\d.]+)", drawn).groups())
    assert abs(x - 50) <= 6
    assert abs(y - 40) <= 6


def test_names_are_escaped():
    figure = draw_chart("<b>t</b>", Axis("<i>"), Axis('"'), [
        Series("<script>a", ((1, 1),), mark="circle"), Series("b", ((2, 2),))])
    assert isinstance(figure, Markup)
    for harm in ("<b>", "<i>", "<script>"):
        assert harm not in figure
    assert "&lt;script&gt;a" in figure
