"""Histograms of times on a logarithmic axis: for the terminal, and as an SVG picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from tools.jitter.figures import Distribution

#: The axis: 1 us to 100 ms, as powers of ten of microseconds. What lies outside counts at its end.
FIRST_DECADE, LAST_DECADE = 0, 5

_BLOCKS = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class Series:
    """What one line of a histogram shows; times in microseconds."""

    label: str
    distribution: Distribution


@dataclass(frozen=True)
class Panel:
    """One histogram: series that belong together, on one axis."""

    title: str
    series: tuple[Series, ...]


def bin_counts(distribution: Distribution, bins_per_decade: int) -> NDArray[np.int64]:
    """Samples per bin of the axis."""
    bins = (LAST_DECADE - FIRST_DECADE) * bins_per_decade
    decades = np.log10(np.maximum(distribution.values, 10.0**FIRST_DECADE)) - FIRST_DECADE
    places = np.clip((decades * bins_per_decade).astype(np.int64), 0, bins - 1)
    counts: NDArray[np.int64] = np.bincount(places, weights=distribution.counts, minlength=bins).astype(np.int64)
    return counts


def text_histogram(distribution: Distribution, bins_per_decade: int = 8) -> str:
    """A line of blocks, one per bin; their height is the logarithm of the count, so that one sample can be seen."""
    counts = bin_counts(distribution, bins_per_decade)
    height = np.log10(counts, out=np.full(len(counts), -1.0), where=counts > 0) + 1.0
    top = max(float(height.max()), 1.0)
    return "".join(_BLOCKS[int(np.ceil(level / top * (len(_BLOCKS) - 1)))] for level in height)


def text_axis(bins_per_decade: int = 8) -> str:
    """The axis under lines of `text_histogram`: a mark and a label where each decade begins."""
    return "".join(f"|{label}".ljust(bins_per_decade) for label in ("1 us", "10", "100", "1 ms", "10")).rstrip()


# The picture, in SVG units.
_BINS_PER_DECADE = 12
_PANEL_WIDTH, _PANEL_HEIGHT = 470, 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 26, 26, 30
_ONE = 0.2  # height of a single sample, in decades
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000")  # apart from each other for colour-blind people too
_TICK_LABELS = ("1 us", "10 us", "100 us", "1 ms", "10 ms", "100 ms")


def svg_picture(title: str, columns: Sequence[Sequence[Panel]]) -> str:
    """Draw panels: a column per condition, panels of one kind side by side.

    Parameters
    ----------
    title : of the picture.
    columns : of as many panels each.
    """
    rows = max((len(column) for column in columns), default=0)
    width, height = _PANEL_WIDTH * len(columns), 34 + _PANEL_HEIGHT * rows
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
        ' font-family="sans-serif" font-size="11">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<text x="{_LEFT}" y="22" font-size="15" font-weight="bold">{escape(title)}</text>',
    ]
    for across, column in enumerate(columns):
        for down, panel in enumerate(column):
            out.append(f'<g transform="translate({across * _PANEL_WIDTH},{34 + down * _PANEL_HEIGHT})">')
            out += _draw_panel(panel)
            out.append("</g>")
    out.append("</svg>\n")
    return "\n".join(out)


def _draw_panel(panel: Panel) -> list[str]:
    counts = [bin_counts(series.distribution, _BINS_PER_DECADE) for series in panel.series]
    decades = max(1, int(np.ceil(np.log10(max((int(count.max()) for count in counts), default=1) + 1))))
    plot_width, plot_height = _PANEL_WIDTH - _LEFT - _RIGHT, _PANEL_HEIGHT - _TOP - _BOTTOM
    base = _TOP + plot_height
    out = [
        f'<text x="{_LEFT}" y="{_TOP - 9}" font-weight="bold">{escape(panel.title)}</text>',
        f'<path d="M{_LEFT} {base}H{_LEFT + plot_width}" stroke="#888"/>',
    ]
    for decade, label in enumerate(_TICK_LABELS):
        x = _LEFT + plot_width * decade / (LAST_DECADE - FIRST_DECADE)
        out.append(f'<path d="M{x:.1f} {_TOP}V{base + 4}" stroke="#ddd"/>')
        out.append(f'<text x="{x:.1f}" y="{base + 16}" text-anchor="middle" fill="#444">{label}</text>')
    for decade in range(decades + 1):
        y = base - plot_height * (decade + _ONE) / (decades + _ONE)
        out.append(f'<path d="M{_LEFT - 4} {y:.1f}H{_LEFT + plot_width}" stroke="#ddd"/>')
        out.append(f'<text x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end" fill="#444">{10**decade}</text>')
    bin_width = plot_width / len(counts[0]) if counts else 0.0
    for number, count in enumerate(counts):
        colour = _COLOURS[number % len(_COLOURS)]
        fill = colour if number == 0 else "none"
        tops = base - plot_height * (np.log10(np.maximum(count, 1)) + _ONE) / (decades + _ONE)
        outline = []
        for run in _runs_of_samples(count):
            outline.append(f"M{_LEFT + run.start * bin_width:.1f} {base}")
            outline += [f"V{top:.1f}h{bin_width:.2f}" for top in tops[run]]
            outline.append(f"V{base}")
        out.append(
            f'<path d="{"".join(outline)}" fill="{fill}" fill-opacity="0.25" stroke="{colour}" stroke-width="1.2"/>'
        )
    return out + _draw_legend(panel, counts, plot_width)


def _draw_legend(panel: Panel, counts: Sequence[NDArray[np.int64]], plot_width: int) -> list[str]:
    """Names of the series, on the side away from the highest bin."""
    highest = max((int(np.argmax(count)) for count in counts), default=0)
    left = bool(counts) and highest >= len(counts[0]) // 2
    x, beside, anchor = (_LEFT + 6, 13, "start") if left else (_LEFT + plot_width - 8, -5, "end")
    out = []
    for number, series in enumerate(panel.series):
        y, colour = _TOP + 14 + 15 * number, _COLOURS[number % len(_COLOURS)]
        out.append(f'<rect x="{x}" y="{y - 8}" width="8" height="8" fill="{colour}"/>')
        out.append(
            f'<text x="{x + beside}" y="{y}" text-anchor="{anchor}" paint-order="stroke" stroke="white"'
            f' stroke-width="3">{escape(series.label)}</text>'
        )
    return out


def _runs_of_samples(count: NDArray[np.int64]) -> Iterator[slice]:
    """Stretches of bins that hold samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], count > 0, [0]])))
    for start, stop in edges.reshape(-1, 2).tolist():
        yield slice(start, stop)
