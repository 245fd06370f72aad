"""Charts as inline SVG: linear or logarithmic axes with units, lines, marks, a legend."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from recon_cli.io.svg import element, join_points, label

WIDTH, HEIGHT = 480, 300  # of the drawing; the page scales it
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 16, 12, 44
_TICK_CHARS = 62  # pixels that a label of the x axis takes
MARKS = ("circle", "square", "diamond", "triangle", "cross", "ring", "plus")

TICK_STEPS = (1.0, 2.0, 5.0, 10.0)  # a tick lies at a multiple of one of these and a power of ten
_NEAR_ZERO = 0.2  # of the highest value
_LEAST_DECADES = 1.0  # below, a logarithmic axis has too few round numbers and takes linear ticks


@dataclass(frozen=True)
class Axis:
    """An axis of a chart."""

    label: str  # with its unit
    log: bool = False  # values of 0 and below are left out


@dataclass(frozen=True)
class Series:
    """The points of one line or one group of marks."""

    label: str  # in the legend
    points: tuple[tuple[float, float], ...]  # (x, y) in the order in which a line joins them
    color: int = 0  # 0 to 7, of the page's palette
    mark: str = ""  # one of MARKS, or empty for a line alone
    line: bool = True
    dashed: bool = False
    big: bool = False  # draws larger marks


@dataclass(frozen=True)
class Scale:
    """Maps values from `low` to `high` to pixels from 0 to `length`."""

    low: float
    high: float
    log: bool
    length: float

    def __call__(self, value: float) -> float:
        """Returns pixels from the low end."""
        if self.log:
            return self.length * math.log(value / self.low) / math.log(self.high / self.low)
        return self.length * (value - self.low) / (self.high - self.low)

    def ticks(self, most: int) -> list[float]:
        """Returns the values that get a tick."""
        return (log_ticks if self.log else linear_ticks)(self.low, self.high, most)


def draw_chart(title: str, x: Axis, y: Axis, series: Sequence[Series]) -> Markup:
    """Returns a figure with caption and legend, or a sentence where there is nothing to draw.

    Later series are drawn over earlier ones.
    """
    lines = []
    for line in series:  # without the points that the axes cannot show
        points = tuple(point for point in line.points if all(map(math.isfinite, point))
                       and not (x.log and point[0] <= 0) and not (y.log and point[1] <= 0))
        if points:
            lines.append(dataclasses.replace(line, points=points))
    if not lines:
        return Markup('<figure class="chart"><figcaption>{}</figcaption>'
                      '<p class="empty">Nothing was recorded.</p></figure>').format(title)
    across = _fit_scale([p[0] for line in lines for p in line.points], x, WIDTH - _LEFT - _RIGHT)
    up = _fit_scale([p[1] for line in lines for p in line.points], y, HEIGHT - _TOP - _BOTTOM)

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return _LEFT + across(point[0]), HEIGHT - _BOTTOM - up(point[1])

    parts = _draw_axes(x, y, across, up)
    parts += [
        _line_path(line, join_points(map(place, line.points)))
        for line in lines if line.line]
    parts += [mark for line in lines if line.mark for mark in _draw_marks(line, place, x, y)]
    return Markup(
        '<figure class="chart"><figcaption>{}</figcaption>{}{}</figure>').format(
            title, element("svg", Markup("").join(parts), viewBox=f"0 0 {WIDTH} {HEIGHT}",
                           role="img", aria_label=title), _draw_legend(lines))


def draw_mark(shape: str, x: float, y: float, r: float, color: int, title: str = "") -> Markup:
    """Returns one mark of radius `r` pixels; the browser shows its title as a tooltip."""
    paths = {
        "circle": f"M{x - r:.1f},{y:.1f}a{r},{r} 0 1 0 {2 * r},0a{r},{r} 0 1 0 {-2 * r},0",
        "ring": f"M{x - r:.1f},{y:.1f}a{r},{r} 0 1 0 {2 * r},0a{r},{r} 0 1 0 {-2 * r},0",
        "square": f"M{x - r:.1f},{y - r:.1f}h{2 * r}v{2 * r}h{-2 * r}z",
        "diamond": f"M{x - 1.3 * r:.1f},{y:.1f}l{1.3 * r},{-1.3 * r} {1.3 * r},{1.3 * r} "
                   f"{-1.3 * r},{1.3 * r}z",
        "triangle": f"M{x:.1f},{y - 1.2 * r:.1f}l{1.1 * r},{2 * r}h{-2.2 * r}z",
        "cross": f"M{x - r:.1f},{y - r:.1f}l{2 * r},{2 * r}m{-2 * r},0l{2 * r},{-2 * r}",
        "plus": f"M{x - r:.1f},{y:.1f}h{2 * r}m{-r},{-r}v{2 * r}",
    }
    hollow = " hollow" if shape in ("ring", "cross", "plus") else ""
    return element("path", element("title", title) if title else "",
                   class_=f"mark c{color}{hollow}", d=paths[shape])


def draw_legend(entries: Iterable[tuple[str, Markup]]) -> Markup:
    """Returns the legend of drawings: each a meaning and a sample."""
    return element("ul", Markup("").join(
        element("li", element("svg", sample, viewBox="0 0 26 14", aria_hidden="true") + meaning)
        for meaning, sample in entries), class_="legend")


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Returns round numbers from `low` to `high`, at least two and at most `most` (3 or more)."""
    rough = (high - low) / (most - 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in TICK_STEPS if factor * power >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def log_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Returns 1, 2, 5 times powers of ten from `low` to `high`, or powers alone where many fit."""
    if math.log10(high / low) < _LEAST_DECADES:
        return [tick for tick in linear_ticks(low, high, most) if tick > 0]
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1, 2, 5), (1, 3), (1,)):
        ticks = [factor * 10.0 ** power for power in powers for factor in factors]
        inside = [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
        if len(inside) <= most:
            return inside
    return inside[::math.ceil(len(inside) / most)]


def axis_limits(values: Sequence[float], *, log: bool) -> tuple[float, float]:
    """Returns the ends of an axis that holds all values with a little room, never an empty one."""
    low, high = min(values), max(values)
    if log:
        room = max((high / low) ** 0.04, 1.05)
        return low / room, high * room
    room = max(0.05 * (high - low), 1e-3 * abs(high), 1e-9)
    # an axis whose values start near zero starts at zero, as counts and seconds do
    return (0.0 if 0 <= low < _NEAR_ZERO * high else low - room), high + room


def tick_label(value: float) -> str:
    """Returns a number in short form: 0.02, 1,500, 20k, 1.5M."""
    if value == 0 or abs(value) < 1e-12:
        return "0"
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if abs(value) >= size * (1 - 1e-9):
            return f"{value / (1e3 if letter == 'k' else size):.6g}{letter}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.6g}"


def _fit_scale(values: Sequence[float], axis: Axis, length: float) -> Scale:
    low, high = axis_limits(values, log=axis.log)
    return Scale(low, high, axis.log, length)


def _draw_axes(x: Axis, y: Axis, across: Scale, up: Scale) -> list[Markup]:
    floor, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    parts = []
    for tick in up.ticks(7):
        at = floor - up(tick)
        parts += [element("line", class_="grid", x1=_LEFT, x2=right, y1=at, y2=at),
                  label(_LEFT - 7, at + 4, tick_label(tick), class_="label", text_anchor="end")]
    for tick in across.ticks(round(across.length / _TICK_CHARS)):
        at = _LEFT + across(tick)
        parts += [element("line", class_="grid", x1=at, x2=at, y1=_TOP, y2=floor),
                  label(at, floor + 17, tick_label(tick), class_="label")]
    middle = (_TOP + floor) / 2
    return [
        *parts,
        element("path", class_="axis", d=f"M{_LEFT},{_TOP}V{floor}H{right}"),
        label((_LEFT + right) / 2, HEIGHT - 7, x.label, class_="label"),
        label(13, middle, y.label, class_="label", transform=f"rotate(-90 13 {middle})")]


def _line_path(series: Series, path: str) -> Markup:
    return element("path", class_=f"line c{series.color}{' dashed' if series.dashed else ''}",
                   d=f"M{path}")


def _draw_marks(
    series: Series, place: Callable[[tuple[float, float]], tuple[float, float]], x: Axis, y: Axis
) -> list[Markup]:
    return [draw_mark(series.mark, *place(point), 6.0 if series.big else 3.5, series.color, (
        f"{series.label}: {x.label} {point[0]:,.6g}, {y.label} {point[1]:,.6g}"))
        for point in series.points]


def _draw_legend(lines: Sequence[Series]) -> Markup:
    if len(lines) == 1:
        return Markup("")  # the caption and the axis say it
    items = []
    for line in lines:
        sample = _line_path(line, "1,7H25") if line.line else Markup("")
        if line.mark:
            sample += draw_mark(line.mark, 13, 7, 5 if line.big else 3.5, line.color)
        items.append((line.label, sample))
    return draw_legend(items)
