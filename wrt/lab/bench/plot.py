"""A small log-log plot, drawn with Pillow: points and lines by series, and a front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Point = tuple[float, float]
SIZE = (900, 600)
LEFT, RIGHT, TOP, BOTTOM = 90, 200, 46, 64  # margins in pixels; the legend stands in the right one
SCALE = 3  # drawn larger and made smaller: lines without steps
INK, PALE, GRID = (30, 30, 30), (110, 110, 110), (228, 228, 228)
COLORS = ((31, 119, 180), (230, 120, 20), (44, 150, 60), (200, 40, 50), (140, 90, 190), (130, 85, 70), (220, 110, 190),
          (120, 120, 30), (20, 170, 190), (90, 90, 90))


@dataclass(frozen=True)
class Series:
    """Points in the order in which a line joins them. Series with the same label have one colour and one legend entry."""

    label: str
    points: Sequence[Point]


@dataclass
class LogLogPlot:
    """What is shown; x and y must be positive (points that are not, or not finite, are left out). front: a line on top."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    front: Sequence[Point] = ()
    front_label: str = "front"
    _range: tuple[Point, Point] = field(init=False, default=((0.0, 1.0), (0.0, 1.0)))

    def draw(self) -> np.ndarray:
        """(H, W, 3) uint8."""
        from PIL import Image, ImageDraw

        image = Image.new("RGB", (SIZE[0] * SCALE, SIZE[1] * SCALE), "white")
        canvas = ImageDraw.Draw(image)
        points = [point for series in self.series for point in series.points if drawable(point)]
        self._range = (log_range([x for x, _ in points]), log_range([y for _, y in points]))
        self._axes(image, canvas)
        colors = dict(zip(dict.fromkeys(series.label for series in self.series), COLORS * 100, strict=False))
        for series in self.series:
            self._line(canvas, series.points, colors[series.label], width=1)
            for point in filter(drawable, series.points):
                self._dot(canvas, point, colors[series.label], 3)
        self._line(canvas, self.front, INK, width=2)
        for point in filter(drawable, self.front):
            self._dot(canvas, point, None, 6)
        self._legend(canvas, colors)
        return np.asarray(image.resize(SIZE, Image.Resampling.LANCZOS))

    def _place(self, point: Point) -> Point:
        """Where a point is drawn, in pixels of the large picture."""
        (x0, x1), (y0, y1) = self._range
        x = LEFT + (math.log10(point[0]) - x0) / (x1 - x0) * (SIZE[0] - LEFT - RIGHT)
        y = SIZE[1] - BOTTOM - (math.log10(point[1]) - y0) / (y1 - y0) * (SIZE[1] - TOP - BOTTOM)
        return x * SCALE, y * SCALE

    def _line(self, canvas: Any, points: Sequence[Point], color: tuple[int, ...], width: int) -> None:
        places = [self._place(point) for point in points if drawable(point)]
        if len(places) > 1:
            canvas.line(places, fill=color, width=width * SCALE, joint="curve")

    def _dot(self, canvas: Any, point: Point, color: tuple[int, ...] | None, radius: int) -> None:
        """A disc, or where there is no colour a ring."""
        x, y = self._place(point)
        r = radius * SCALE
        canvas.ellipse((x - r, y - r, x + r, y + r), fill=color, outline=None if color else INK, width=2 * SCALE)

    def _axes(self, image: Any, canvas: Any) -> None:
        (x0, x1), (y0, y1) = self._range
        left, bottom, right, top = LEFT * SCALE, (SIZE[1] - BOTTOM) * SCALE, (SIZE[0] - RIGHT) * SCALE, TOP * SCALE
        for value in ticks(x0, x1):
            x = self._place((value, 10.0**y0))[0]
            canvas.line((x, top, x, bottom), fill=GRID, width=SCALE)
            canvas.text((x, bottom + 6 * SCALE), number(value), fill=PALE, font=font(12), anchor="mt")
        for value in ticks(y0, y1):
            y = self._place((10.0**x0, value))[1]
            canvas.line((left, y, right, y), fill=GRID, width=SCALE)
            canvas.text((left - 7 * SCALE, y), number(value), fill=PALE, font=font(12), anchor="rm")
        canvas.rectangle((left, top, right, bottom), outline=PALE, width=SCALE)
        canvas.text((left, 16 * SCALE), self.title, fill=INK, font=font(16))
        canvas.text((0.5 * (left + right), bottom + 34 * SCALE), self.x_label, fill=INK, font=font(14), anchor="mt")
        upright(image, self.y_label, (22 * SCALE, (top + bottom) // 2))

    def _legend(self, canvas: Any, colors: Mapping[str, tuple[int, ...]]) -> None:
        x, y = (SIZE[0] - RIGHT + 16) * SCALE, (TOP + 6) * SCALE
        for label, color in colors.items():
            canvas.line((x, y, x + 20 * SCALE, y), fill=color, width=2 * SCALE)
            canvas.ellipse((x + 7 * SCALE, y - 3 * SCALE, x + 13 * SCALE, y + 3 * SCALE), fill=color)
            canvas.text((x + 28 * SCALE, y), label, fill=INK, font=font(13), anchor="lm")
            y += 22 * SCALE
        if self.front:
            canvas.line((x, y, x + 20 * SCALE, y), fill=INK, width=2 * SCALE)
            canvas.ellipse((x + 4 * SCALE, y - 6 * SCALE, x + 16 * SCALE, y + 6 * SCALE), outline=INK, width=2 * SCALE)
            canvas.text((x + 28 * SCALE, y), self.front_label, fill=INK, font=font(13), anchor="lm")


def drawable(point: Point) -> bool:
    return all(math.isfinite(x) and x > 0.0 for x in point)


def log_range(values: Sequence[float]) -> Point:
    """Powers of ten that hold all values, with a little room; one decade where there is none."""
    if not values:
        return 0.0, 1.0
    low, high = math.log10(min(values)), math.log10(max(values))
    room = max(0.05 * (high - low), 0.15)
    return low - room, high + room


def ticks(low: float, high: float) -> list[float]:
    """Round numbers between two powers of ten: decades, with 2 and 5 between them where there are few."""
    for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        found = [step * 10.0**decade for decade in range(math.floor(low), math.ceil(high) + 1) for step in steps]
        found = [value for value in found if low <= math.log10(value) <= high]
        if len(found) >= 3:
            break
    every = math.ceil(len(found) / 8)
    return found[::every]


def number(value: float) -> str:
    if 1e-3 <= value < 1e4:
        return f"{value:g}"
    return f"{value:.1e}".replace(".0e", "e").replace("e-0", "e-").replace("e+0", "e")


def font(size: int) -> Any:
    """Pillow's own font at a size of the small picture."""
    from PIL import ImageFont

    return ImageFont.load_default(size * SCALE)


def upright(image: Any, text: str, middle: tuple[int, int]) -> None:
    """Text that runs from the bottom up, around a point."""
    from PIL import Image, ImageDraw

    left, top, right, bottom = (round(edge) for edge in font(14).getbbox(text))
    label = Image.new("RGB", (max(right - left, 1), max(bottom - top, 1)), "white")
    ImageDraw.Draw(label).text((-left, -top), text, fill=INK, font=font(14))
    label = label.rotate(90, expand=True)
    image.paste(label, (middle[0] - label.width // 2, middle[1] - label.height // 2))
