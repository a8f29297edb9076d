"""The curve in the panel."""

import base64
from xml.etree import ElementTree

import pytest

from abcd_ns.viewer.chart import HEIGHT, WIDTH, curve_image, curve_svg

SVG = "{http://www.w3.org/2000/svg}"


def line_of(svg: str) -> list[tuple[float, float]]:
    polyline = ElementTree.fromstring(svg).find(f"{SVG}polyline")
    return [tuple(map(float, pair.split(","))) for pair in polyline.get("points").split()]


def test_the_curve_rises_as_its_values_do_and_stays_in_the_picture():
    line = line_of(curve_svg([(0.0, 10.0), (10.0, 15.0), (30.0, 20.0)]))
    (x0, y0), (x1, y1), (x2, y2) = line
    assert x1 - x0 == pytest.approx((x2 - x0) / 3, abs=0.1)
    assert y1 - y0 == pytest.approx((y2 - y0) / 2, abs=0.1)
    assert y2 < y1 < y0  # SVG's y points down
    assert all(0 <= x <= WIDTH and 0 <= y <= HEIGHT for x, y in line)


def test_axes_have_round_numbers_in_range():
    svg = curve_svg([(0.0, 12.34), (97.0, 23.4)])
    labels = [float(text.text) for text in ElementTree.fromstring(svg).iter(f"{SVG}text")]
    assert labels == [15.0, 20.0, 0.0, 50.0]


def test_a_constant_is_drawn():
    line = line_of(curve_svg([(0.0, 20.0), (1.0, 20.0)]))
    assert line[0][1] == line[1][1]


def test_as_markdown():
    image = curve_image([(0.0, 1.0), (1.0, 2.0)], "quality")
    assert image.startswith("![quality](data:image/svg+xml;base64,")
    encoded = image.removesuffix(")").partition("base64,")[2]
    assert base64.b64decode(encoded).decode() == curve_svg([(0.0, 1.0), (1.0, 2.0)])
    assert curve_image([(0.0, 1.0)], "quality") == "Nothing to show yet."
