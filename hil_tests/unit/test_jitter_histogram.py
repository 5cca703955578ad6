"""Histograms: every sample is in exactly one bin, one sample can be seen, and the picture is sound SVG."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from tools.jitter.figures import Distribution
from tools.jitter.histogram import Panel, Series, bin_counts, svg_picture, text_axis, text_histogram

SEED = 20261122
SVG = "{http://www.w3.org/2000/svg}"


def test_bins_are_those_of_numpy():
    samples = np.random.default_rng(SEED).lognormal(4.0, 1.5, 5000).clip(1.0, 99_999.0)
    edges = np.logspace(0, 5, 41)
    assert np.array_equal(bin_counts(Distribution.of(samples), 8), np.histogram(samples, edges)[0])


def test_what_is_off_the_axis_counts_at_its_ends():
    counts = bin_counts(Distribution.of([0.0, 0.3, 1.0, 100_000.0, 3e7]), 8)
    assert counts[0] == 3
    assert counts[-1] == 2
    assert counts.sum() == 5


def test_weights_count():
    counts = bin_counts(Distribution.of_histogram({20.0: 7, 21.0: 5, 5000.0: 1}), 1)
    assert counts.tolist() == [0, 12, 0, 1, 0]


def test_text_shows_a_single_sample_and_nothing_where_there_is_none():
    line = text_histogram(Distribution.of_histogram({15.0: 100_000, 5000.0: 1}), 1)
    assert line[1] == "█"
    assert line[3] not in " █"
    assert line[0] == line[2] == line[4] == " "
    assert text_histogram(Distribution.of([]), 1) == " " * 5


@pytest.mark.parametrize("bins", [8, 10])
def test_axis_marks_where_decades_begin(bins: int):
    axis = text_axis(bins)
    assert [match.start() for match in re.finditer(r"\|", axis)] == [bins * decade for decade in range(5)]
    for time, label in ((1.0, "1 us"), (1000.0, "1 ms")):
        place = text_histogram(Distribution.of([time]), bins).index("█")
        assert axis[place:].startswith(f"|{label}")


def series(*times: float) -> Series:
    return Series("raceloop-obc", Distribution.of(times))


def test_picture_is_sound_and_holds_every_panel():
    panels = [
        Panel("Lateness < 1 & idle", (series(10.0, 20.0), Series("cyclictest", Distribution.of([15.0])))) for _ in "ab"
    ]
    root = ElementTree.fromstring(svg_picture("OBC & co", [panels, panels]))
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert texts.count("Lateness < 1 & idle") == 4
    assert texts.count("cyclictest") == 4
    assert "OBC & co" in texts
    width, height = float(root.get("width", "0")), float(root.get("height", "0"))
    places = [group.get("transform", "") for group in root.iter(f"{SVG}g")]
    assert len(set(places)) == 4
    for place in places:
        x, y = map(float, re.findall(r"[\d.]+", place))
        assert 0 <= x < width
        assert 0 <= y < height


def outlines(panel: Panel) -> list[str]:
    root = ElementTree.fromstring(svg_picture("", [[panel]]))
    return [path.get("d", "") for path in root.iter(f"{SVG}path") if path.get("fill-opacity")]


def test_outline_is_drawn_where_there_are_samples_only():
    (empty,) = outlines(Panel("", (series(),)))
    assert empty == ""
    (two,) = outlines(Panel("", (series(10.0, 10.0, 3000.0),)))
    assert two.count("M") == 2
    left, right = (float(x) for x in re.findall(r"M([\d.]+)", two))
    assert left < right
    heights = [float(y) for y in re.findall(r"V([\d.]+)h", two)]
    assert heights[0] < heights[1], "two samples stand higher than one; y points down"


def test_panel_without_series_is_drawn():
    ElementTree.fromstring(svg_picture("nothing", [[Panel("none", ())]]))
    ElementTree.fromstring(svg_picture("nothing", []))


@pytest.mark.parametrize(("time", "anchor"), [(50.0, "end"), (4000.0, "start")])
def test_names_stand_away_from_the_samples(time: float, anchor: str):
    root = ElementTree.fromstring(svg_picture("", [[Panel("", (series(time, time),))]]))
    (name,) = (text for text in root.iter(f"{SVG}text") if text.text == "raceloop-obc")
    assert name.get("text-anchor") == anchor
