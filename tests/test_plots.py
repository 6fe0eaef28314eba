import re

from gsplat_tools.plots import Series, scatter


def circles(svg: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', svg)]


def test_scatter__places_points_by_the_logarithm_of_x_and_upwards_in_y() -> None:
    svg = scatter([Series("a", [(10, 1, "", True), (100, 2, "", True), (1000, 3, "", False)])], x_label="x", y_label="y")

    (x0, y0), (x1, y1), (x2, y2) = circles(svg)
    assert abs((x1 - x0) - (x2 - x1)) < 0.2
    assert y0 > y1 > y2
    assert svg.count('fill="none" fill-opacity') == 1


def test_scatter__leaves_out_what_has_no_place() -> None:
    inf, nan = float("inf"), float("nan")

    svg = scatter(
        [Series("a", [(0, 1, "", True), (1, inf, "", True), (nan, 1, "", True), (2, 1, "<b>", True)])], x_label="", y_label=""
    )

    assert len(circles(svg)) == 1
    assert "&lt;b&gt;" in svg
    assert circles(scatter([], x_label="x", y_label="y")) == []
