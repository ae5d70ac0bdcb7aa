"""A raster of a wall as a page to print: picture, scale bar and text, as PNG and as PDF, both to scale."""

from dataclasses import dataclass
from math import ceil, floor, log10
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sfm_app.files import replace_atomically
from sfm_app.types.arrays import ByteArray, Float32Array
from sfm_app.wording import format_length

INCH_M = 0.0254
PAPER_M = (0.420, 0.297)
"""A3, by ISO 216."""
MARGIN_M, LINE_M = 0.010, 0.004
"""Margin of the page and height of its text on paper. Chosen by hand: readable at arm's length."""
LEAST_DPI = 150.0
"""Coarser pictures are enlarged, since text on them would be jagged. Chosen by hand."""
MOST_PX = 8192
"""Longest side of a picture: larger ones are reduced, and the GeoTIFF has all pixels. By hand: most viewers open it."""
BAR_SHARE, BAR_PARTS = 0.3, 4
"""Longest scale bar as a share of the picture's width, and its black and white parts. Chosen by hand."""
RELIEF_PERCENT = (1.0, 99.0)
"""Heights at the ends of the colors, in percent of all pixels. Chosen by hand: borders have outliers."""
LIGHT = np.array([-1.0, 1.0, 1.5])
"""Direction to the light that shades reliefs: from the upper left, as is usual on maps."""
PDF_QUALITY = 95
"""JPEG quality of the picture in a PDF: texts have no halos. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Caption:
    """What a page says about its picture."""

    product: str
    title: str
    unit_m: float
    """Meters per unit; 0 if the size is unknown."""


def write_sheet(raster: Path, caption: Caption) -> tuple[Path, Path]:
    """Write a raster of `geotiff` as a PNG and a PDF beside it; return both."""
    import rasterio
    from rasterio.enums import Resampling

    with rasterio.open(raster) as file:
        shrink = ceil(max(file.width, file.height) / MOST_PX)
        size = max(file.height // shrink, 1), max(file.width // shrink, 1)
        bands = file.read(out_shape=(file.count, *size), resampling=Resampling.average, masked=file.count == 1)
        pixel = (file.bounds.right - file.bounds.left) / size[1]
    legend = ""
    if len(bands) == 1:
        picture, (low, high) = shade(bands[0].astype(np.float32).filled(np.nan), pixel)
        legend = f"heights from {_length(low, caption.unit_m)} (dark) to {_length(high, caption.unit_m)} (bright)"
    else:
        opacity = bands[3:].astype(np.float64) / 255.0
        picture = np.moveaxis(np.round(255.0 + (bands[:3] - 255.0) * opacity).astype(np.uint8), 0, 2)
    page, dpi = compose(picture, pixel, caption, legend)
    png, pdf = raster.with_suffix(".png"), raster.with_suffix(".pdf")
    with replace_atomically(png) as draft:
        page.save(draft, "PNG", dpi=(dpi, dpi))
    with replace_atomically(pdf) as draft:  # no dates: the same picture gives the same bytes
        page.save(draft, "PDF", resolution=dpi, quality=PDF_QUALITY, creationDate=None, modDate=None, title=None)
    return png, pdf


def shade(heights: Float32Array, pixel: float) -> tuple[ByteArray, tuple[float, float]]:
    """Return heights (H, W), NaN in holes, as a shaded relief (H, W, 3), and the heights at the ends of its colors."""
    import cv2

    low, high = np.nanpercentile(heights, RELIEF_PERCENT)
    share = np.clip((heights - low) / max(high - low, 1e-12), 0.0, 1.0)
    colors = cv2.applyColorMap(np.nan_to_num(255.0 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[:, :, ::-1]
    padded = np.pad(heights.astype(np.float64), 1, mode="edge")
    right = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2.0 * pixel)
    up = (padded[:-2, 1:-1] - padded[2:, 1:-1]) / (2.0 * pixel)
    light = (LIGHT[2] - LIGHT[0] * right - LIGHT[1] * up) / np.sqrt(right**2 + up**2 + 1.0) / np.linalg.norm(LIGHT)
    light = np.nan_to_num(np.clip(light, 0.0, 1.0), nan=float(LIGHT[2] / np.linalg.norm(LIGHT)))
    lit = np.round(colors * (0.35 + 0.65 * light[:, :, None]))
    return np.where(np.isnan(heights)[:, :, None], 255, lit).astype(np.uint8), (float(low), float(high))


def compose(picture: ByteArray, pixel: float, caption: Caption, legend: str) -> tuple[Image.Image, float]:
    """Return the page and its dots per inch; `pixel` is the side of a pixel of the picture (H, W, 3) in units."""
    height, width = picture.shape[:2]
    scale, dpi = _paper_scale(width, height, pixel * caption.unit_m)
    enlarge = ceil(LEAST_DPI / dpi)
    dpi, pixel = dpi * enlarge, pixel / enlarge
    image = Image.fromarray(picture)
    if enlarge > 1:
        image = image.resize((width * enlarge, height * enlarge), Image.Resampling.BICUBIC)
    margin, line = (max(round(length / INCH_M * dpi), 1) for length in (MARGIN_M, LINE_M))
    font = ImageFont.load_default(line)
    bar = floor_to_usual(BAR_SHARE * image.width * pixel)
    texts = [f"{caption.product}, {caption.title}, pixels of {_length(pixel * enlarge, caption.unit_m)}"]
    texts[0] += f", 1 : {scale} on this page" if scale else ", size unknown"
    texts += [legend] if legend else []
    room = max(image.width, *(ceil(font.getlength(text)) for text in texts))
    rows = [(3 + 3 * number) * line // 2 for number in range(len(texts))]
    page = Image.new("RGB", (room + 2 * margin, image.height + 2 * margin + 3 * line + rows[-1]), "white")
    page.paste(image, (margin, margin))
    pen, top = ImageDraw.Draw(page), margin + image.height + line
    for part in range(BAR_PARTS):
        left, right = (margin + round(bar / pixel * end / BAR_PARTS) for end in (part, part + 1))
        fill = "black" if part % 2 == 0 else "white"
        pen.rectangle((left, top, right, top + line // 2), fill=fill, outline="black")
    end = margin + round(bar / pixel) + line
    pen.text((end, top + line // 4), _length(bar, caption.unit_m), fill="black", font=font, anchor="lm")
    for row, text in zip(rows, texts, strict=True):
        pen.text((margin, top + row), text, fill="black", font=font)
    return page, dpi


def _paper_scale(width: int, height: int, pixel_m: float) -> tuple[int, float]:
    """Return N of the largest usual scale 1 : N with which a picture fits on the paper, and its dots per inch.

    N is 0 where the size of a pixel in meters is 0, which stands for unknown; the picture then fills the paper.
    """
    room = [side - 2.0 * MARGIN_M for side in PAPER_M]
    sides = sorted((width, height), reverse=True)
    if not pixel_m:
        return 0, max(side / part for side, part in zip(sides, room, strict=True)) * INCH_M
    least = max(side * pixel_m / part for side, part in zip(sides, room, strict=True))
    scale = max(round(_ceil_to_usual(least)), 1)
    return scale, INCH_M * scale / pixel_m


def _ceil_to_usual(value: float) -> float:
    """Return the least 1, 2 or 5 times a power of ten that is not below a value > 0."""
    power = 10.0 ** floor(log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9)))


def floor_to_usual(most: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above a value > 0."""
    return 1.0 / _ceil_to_usual(1.0 / most)


def _length(value: float, unit_m: float) -> str:
    """Return a length in units as text."""
    if not unit_m:
        return f"{value:.3g} units"
    return ("-" if value < 0.0 else "") + format_length(abs(value) * unit_m)
