"""The bar above a picture: title and time, below them what has been counted so far. Drawn by Pillow, crisp."""

import functools
import importlib.util
import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TEXT = (34, 38, 46)
MUTED = (104, 110, 120)
ALARM = (205, 24, 34)
PAPER = (255, 255, 255)
RULE = (214, 218, 224)


def bar_height(height: int) -> int:
    """Rows of the bar in a picture of that many rows; in a small picture the words stay legible."""
    return max(2 * round(0.05 * height + 2), min(36, height // 4))


class Caption:
    """Draws the bar; words are drawn anew only when they change, so in most pictures only the time is."""

    def __init__(self, *, title: str, width: int, bar: int) -> None:
        self.bar = bar
        self._width, self._title, self._pad = width, title, round(0.25 * self.bar)
        self._left = functools.lru_cache(maxsize=64)(self._draw_left)
        self._right = functools.lru_cache(maxsize=64)(self._draw_right)

    def paint(self, canvas: np.ndarray, *, time: str, counts: str, note: str = "", alarm: bool = False) -> None:
        """Fills the first `bar` rows of `canvas`, uint8 (H, W, 3); `alarm` writes the counts in red.

        Args:
          canvas: the whole picture.
          time: right of the title.
          counts: second line.
          note: at the right of the second line.
          alarm: whether somebody touches something.
        """
        half = (self.bar - 2) // 2
        self._line(canvas[:half], self._title, time, TEXT, True)
        self._line(canvas[half : self.bar - 2], counts, note, ALARM if alarm else MUTED, False)
        canvas[self.bar - 2 : self.bar] = RULE

    def _line(self, canvas: np.ndarray, left: str, right: str, color: tuple[int, int, int], strong: bool) -> None:
        rows, end = len(canvas), self._width - self._pad
        words = self._right(right, rows, strong)
        room = end - self._pad - (words.shape[1] + self._pad // 2 if right else 0)
        canvas[:] = self._left(left, rows, room, color, strong)
        canvas[:, max(end - words.shape[1], 0) : end] = words[:, -end:]

    def _draw_left(self, text: str, rows: int, room: int, color: tuple[int, int, int], strong: bool) -> np.ndarray:
        image = Image.new("RGB", (self._width, rows), PAPER)
        for size in (0.72, 0.64, 0.56):  # a long text is first set smaller, then cut
            font = _font(strong, size * rows)
            if font.getlength(text) <= room:
                break
        place = self._pad, _middle(rows, strong)
        ImageDraw.Draw(image).text(place, _shortened(text, font, room), fill=color, font=font, anchor="lm")
        return np.asarray(image)

    def _draw_right(self, text: str, rows: int, strong: bool) -> np.ndarray:
        font = _font(False, (0.70 if strong else 0.62) * rows)
        # Widths come in steps, so that the text on the left seldom gets another room.
        width = rows * math.ceil(font.getlength(text) / rows)
        image = Image.new("RGB", (width, rows), PAPER)
        color = TEXT if strong else MUTED
        ImageDraw.Draw(image).text((width, _middle(rows, strong)), text, fill=color, font=font, anchor="rm")
        return np.asarray(image)


def _middle(rows: int, strong: bool) -> float:
    """Where the middle of a line's words is [rows]: the first line hangs, the second stands close below it."""
    return (0.58 if strong else 0.44) * rows


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
