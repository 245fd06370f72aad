"""Drawings as SVG: elements, paths, labels, a plan's place in its drawing and its scale bar."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

Points = NDArray[np.float64]


def element(name: str, content: object = "", /, **attributes: object) -> Markup:
    """Returns an element, its content and values escaped unless they are markup.

    Floats have one decimal; an underscore in the name of an attribute is a hyphen, or ends it.
    """
    parts = [Markup(' {}="{}"').format(key.strip("_").replace("_", "-"), _number(value))
             for key, value in attributes.items()]
    ending = Markup(">{}</{}>").format(content, name) if content != "" else Markup("/>")
    return Markup("<{}").format(name) + Markup("").join(parts) + ending


def label(x: float, y: float, text: object, /, **attributes: object) -> Markup:
    """Returns a text that is centred on `x` unless another `text_anchor` is given."""
    return element("text", text, x=x, y=y, **{"text_anchor": "middle"} | attributes)


def join_points(points: Iterable[Iterable[float]], joint: str = "L") -> str:
    """Returns the coordinates of a path through points of two coordinates each."""
    return joint.join(",".join(f"{value:.1f}" for value in point) for point in points)


def _number(value: object) -> object:
    return f"{value:.1f}" if isinstance(value, float) else value


@dataclass(frozen=True, eq=False)
class PlanLayout:
    """Maps the coordinates of a plan, right and up, to a drawing."""

    scale: float  # pixels a unit
    corner: Points  # [2] plan coordinates of the lower left corner
    height: float  # of the drawing in pixels

    def at(self, places: Points) -> Points:
        """Returns pixels from the left and from the top, [..., 2], of places [..., 2]."""
        pixels = (places - self.corner) * self.scale
        return np.stack([pixels[..., 0], self.height - pixels[..., 1]], axis=-1)

    def scale_bar(
        self, end: tuple[float, float], metres: float, rise: int, **style: object
    ) -> Markup:
        """Returns a bar of some metres that ends at the right at `end`, with its length over it."""
        length = metres * self.scale
        x, y = end[0] - length, end[1]
        bar = f"M{x:.1f},{y - rise:.1f}v{rise}h{length:.1f}v-{rise}"
        return element("path", d=bar, **style) + label(
            x + length / 2, y - rise - 3, f"{metres:g} m")
