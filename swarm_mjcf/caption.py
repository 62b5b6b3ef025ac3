"""The bar above a picture: title and time, and below them what has been counted so far. Drawn by Pillow, crisp."""

import functools
import importlib.util
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TEXT = (34, 38, 46)
MUTED = (104, 110, 120)
ALARM = (205, 24, 34)
PAPER = (255, 255, 255)
RULE = (214, 218, 224)


def bar_height(height: int) -> int:
    """Rows of the bar in a picture of that many rows."""
    return 2 * round(0.05 * height + 2)


class Caption:
    """Draws the bar; a line is drawn anew only when its words change."""

    def __init__(self, *, title: str, width: int, bar: int) -> None:
        self.bar = bar
        self._width, self._title, self._pad = width, title, round(0.25 * self.bar)
        self._line = functools.lru_cache(maxsize=64)(self._draw)

    def paint(self, canvas: np.ndarray, *, time: str, counts: str, alarm: bool) -> None:
        """Fills the first `bar` rows of `canvas`, uint8 (H, W, 3); `alarm` writes the counts in red."""
        half = (self.bar - 2) // 2
        canvas[:half] = self._line(self._title, time, half, True, False)
        canvas[half : self.bar - 2] = self._line(counts, "", self.bar - 2 - half, False, alarm)
        canvas[self.bar - 2 : self.bar] = RULE

    def _draw(self, left: str, right: str, rows: int, strong: bool, alarm: bool) -> np.ndarray:
        image = Image.new("RGB", (self._width, rows), PAPER)
        draw = ImageDraw.Draw(image)
        plain = _font(False, (0.70 if strong else 0.66) * rows)
        middle = (0.58 if strong else 0.44) * rows
        room = self._width - 2 * self._pad - (plain.getlength(right) + self._pad if right else 0.0)
        color = ALARM if alarm else TEXT if strong else MUTED
        for size in (0.72, 0.64, 0.56):  # a long title is first set smaller, then cut
            font = _font(strong, size * rows)
            if font.getlength(left) <= room:
                break
        draw.text((self._pad, middle), _shortened(left, font, room), fill=color, font=font, anchor="lm")
        draw.text((self._width - self._pad, middle), right, fill=TEXT, font=plain, anchor="rm")
        return np.asarray(image)


def _shortened(text: str, font: ImageFont.FreeTypeFont, room: float | int) -> str:
    text = " ".join(text.split())
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "…") > room:
        text = text[:-1]
    return text.rstrip() + "…"


@functools.cache
def _font(bold: bool, size: float) -> ImageFont.FreeTypeFont:
    # DejaVu lies in matplotlib's folder on every system; finding it does not import matplotlib (0.3 s).
    package = importlib.util.find_spec("matplotlib")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("matplotlib, which carries the captions' font")
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(package.origin).parent / "mpl-data/fonts/ttf" / name), size)
