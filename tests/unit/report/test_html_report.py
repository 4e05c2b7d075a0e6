import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.report.page.charts import Axis, series_class
from ctlev_core.report.page.figures import animation_webp, image_grid_png
from ctlev_core.report.page.html import Animation, Curves, Folded, ImageGrid, Step, Table, Text, render_report
from ctlev_core.report.page.tables import format_column

HOSTILE = "<script>alert(\"1\")</script> & 'x' http://example.org"
VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Collects what a browser would see, and that every element is closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.ids: list[str] = []
        self.texts: dict[str, list[str]] = {}

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        for tag in self.open:
            self.texts[tag][-1] += data


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


def full_report(text: str = "plain") -> str:
    images = [np.full((8, 8, 3), value, np.uint8) for value in (0, 255)]
    return render_report(
        title=text,
        lead=text,
        verdict=text,
        sections=[
            Table(text, [text, "score"], [[text, 1.25], ["b", None]], caption=text, footnotes=[text]),
            ImageGrid(text, [(text, images), ("short", images[:1])], column_labels=[text, "b"], caption=text),
            Curves(text, {text: ([1, 2], [3.0, 4.0])}, text, text, caption=text),
            Curves("second", {"a": ([1, 10], [0.1, 100.0])}, "x", "y", log_x=True, log_y=True),
            Text(text, f"{text}\n\nsecond paragraph"),
        ],
        footer=text,
    )


def test_hostile_texts_stay_texts():
    plain, hostile = read(full_report()), read(full_report(HOSTILE))
    assert len(plain.texts["script"]) == len(hostile.texts["script"]) == 1
    tags = [(tag, name) for tag, name, _ in hostile.attributes]
    assert tags == [(tag, name) for tag, name, _ in plain.attributes]
    assert hostile.texts["h1"] == [HOSTILE] and HOSTILE in hostile.texts["td"] and HOSTILE in hostile.texts["svg"][0]
    assert hostile.texts["title"][:2] == [HOSTILE, f"{HOSTILE}: 3 at 1"]


def test_page_needs_nothing_from_outside():
    page = full_report()
    for _, name, value in read(page).attributes:
        if name in {"src", "href", "xlink:href", "action", "data", "poster", "srcset"}:
            assert value.startswith(("data:image/png;base64,", "#")), value
    assert "@import" not in page and not re.search(r"url\((?!#)", page)
    assert "default-src 'none'" in page


def test_equal_input_gives_equal_text_and_ids_are_unique():
    page = full_report()
    assert page == full_report()
    ids = read(page).ids
    links = re.findall(r'href="(#section-\d+)"', page)
    assert len(links) == 5 and all(link[1:] in ids for link in links)
    assert len([name for name in ids if name.startswith("section")]) == 5
    assert len(ids) == len(set(ids))


def test_backticks_become_code_after_escaping():
    reader = read(render_report(title="t", lead="Data: `<b>`.", verdict="v", sections=[]))
    assert reader.texts["code"] == ["<b>"]


def test_table_aligns_numbers_and_marks_uncertainty_and_bold():
    rows = [["recorded", "6.870 [6.5, 7.2]", 1400], ["both", "6.31 ± 0.02", None]]
    page = render_report(title="t", lead="", verdict="", sections=[Table("T", ["on", "px", "n"], rows, bold={(1, 1)})])
    for cell in (
        'class="number" data-sort="6.870" data-label="px">6.870<span class="uncertainty"> [6.5, 7.2]</span>',
        'class="number bold" data-sort="6.31" data-label="px">6.31<span class="uncertainty"> ± 0.02</span>',
        'class="number" data-sort="1400" data-label="n">1,400',
        'class="number" data-label="n">–',
    ):
        assert f"<td {cell}</td>" in page
    assert "<td>recorded</td>" in page


@pytest.mark.parametrize(
    ("cells", "texts"),
    [
        ([1234567, 5], ["1,234,567", "5"]),
        ([1.5, 2.25, 3.0], ["1.50", "2.25", "3.00"]),
        ([0.123456, float("nan"), None], ["0.1235", "–", "–"]),
        ([float("inf"), -float("inf"), 0.0], ["∞", "−∞", "0"]),
        ([1e-9, 2.5e12, 0.5], ["1.000e-09", "2.500e+12", "0.5"]),
        ([True, False], ["yes", "no"]),
        ([np.float32(0.5), np.int64(3), "text", ""], ["0.5", "3", "text", "–"]),
    ],
)
def test_columns_are_formatted_alike(cells, texts):
    assert format_column(cells) == texts


@given(st.lists(st.floats(1e-4, 1e8), min_size=1, max_size=5))
def test_formatting_keeps_four_significant_digits(values):
    for value, text in zip(values, format_column(values), strict=True):
        assert float(text.replace(",", "")) == pytest.approx(value, rel=5.1e-4)


def test_grid_enlarges_without_smoothing_and_leaves_missing_cells_clear():
    checkers = np.array([[0, 255], [255, 0]], np.uint8)
    colour = np.zeros((4, 4, 3), np.uint8)
    colour[..., 0] = 200
    picture = cv2.imdecode(np.frombuffer(image_grid_png([[checkers, colour], [colour]], 8, 2), np.uint8), -1)
    assert picture.shape == (18, 18, 4)
    assert np.array_equal(picture[:8, :8, 0], np.kron(checkers, np.ones((4, 4), np.uint8)))
    # OpenCV decodes to blue, green, red, alpha.
    assert (picture[:8, 10:] == [0, 0, 200, 255]).all() and (picture[10:, :8] == [0, 0, 200, 255]).all()
    assert (picture[10:, 10:, 3] == 0).all() and (picture[8:10, :, 3] == 0).all()


def test_grid_fits_images_of_other_proportions():
    wide = np.full((2, 4), 9, np.uint8)
    tall = np.full((8, 8), 7, np.uint8)
    picture = cv2.imdecode(np.frombuffer(image_grid_png([[wide, tall]], 8, 0), np.uint8), -1)[..., 0]
    assert (picture[2:6, :8] == 9).all() and (picture[:2, :8] == 0).all() and (picture[:, 8:] == 7).all()


def test_grid_in_the_page_is_one_png():
    page = full_report()
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == 1
    assert base64.b64decode(pictures[0])[:8] == b"\x89PNG\r\n\x1a\n"


def chart(*arguments, **more) -> str:
    """The `<svg>` element of a page with one chart."""
    page = render_report(title="t", lead="", verdict="", sections=[Curves("C", *arguments, **more)])
    return page[page.index("<svg") : page.index("</svg>")]


def test_curves_are_drawn_where_their_values_are():
    svg = chart({"a": ([0, 10, 20], [1.0, float("nan"), 3.0])}, "step, $x$", "loss < 1")
    assert "step, $x$" in svg and "loss &lt; 1" in svg
    (line,) = re.findall(r'<polyline points="([^"]*)"', svg)
    (x0, y0), (x1, y1) = [[float(number) for number in pair.split(",")] for pair in line.split()]
    ticks = dict(re.findall(r'<text x="([\d.]+)" y="[^"]*" text-anchor="middle">(\d+)</text>', svg))
    places = {float(label): float(place) for place, label in ticks.items()}
    assert (places[0], places[20]) == pytest.approx((x0, x1), abs=0.06) and y0 > y1
    assert re.findall("<title>(.*?)</title>", svg) == ["a: 1 at 0", "a: 3 at 20"]


@pytest.mark.parametrize(
    ("low", "high", "logarithmic", "expected"),
    [
        (0, 1, False, ["0", "0.2", "0.4", "0.6", "0.8", "1"]),
        (-3, 37, False, ["0", "10", "20", "30"]),
        (1, 60, True, ["1", "2", "5", "10", "20", "50"]),
        (1e-6, 1e6, True, ["0.0001", "0.001"]),
        (2.1, 4.9, True, ["2.5", "3", "3.5", "4", "4.5"]),
        (7.0, 7.0, False, ["6.7", "6.8"]),
    ],
)
def test_ticks_are_round_numbers(low, high, logarithmic, expected):
    axis = Axis.around(np.array([low, high], float), 0, 100, logarithmic)
    labels = [label for _, label in axis.ticks()]
    assert set(expected) <= set(labels) and 2 <= len(labels) <= 14
    for place, label in axis.ticks():
        assert float(place) == pytest.approx(float(axis.place(float(label))), abs=0.06)


def test_curves_leave_out_what_a_logarithm_cannot_show():
    both = chart({"a": ([1, 2, 3], [1.0, 5.0, 2.0])}, "x", "y", log_y=True)
    assert chart({"a": ([1, 1.5, 2, 2.5, 3], [1.0, 0.0, 5.0, -1.0, 2.0])}, "x", "y", log_y=True) == both


def test_many_series_differ_in_colour_or_line():
    assert len({series_class(index) for index in range(24)}) == 24


def test_empty_sections_say_so():
    page = render_report(
        title="t", lead="", verdict="", sections=[Table("T", ["a"], []), ImageGrid("G", []), Curves("C", {}, "x", "y")]
    )
    assert [word in page for word in ("No rows.", "No images.", "No points.")] == [True] * 3


def test_wrong_sections_are_named():
    def render(section):
        render_report(title="t", lead="", verdict="", sections=[section])

    with pytest.raises(ValueError, match="table 'T': row 1 has 1 cells for 2 columns"):
        render(Table("T", ["a", "b"], [[1, 2], [3]]))
    with pytest.raises(ValueError, match=r"uint8, got \(4, 4\) float64"):
        render(ImageGrid("G", [("r", [np.zeros((4, 4))])]))
    with pytest.raises(ValueError, match="1 column labels for 2 columns"):
        render(ImageGrid("G", [("r", [np.zeros((4, 4), np.uint8)] * 2)], column_labels=["a"]))
    with pytest.raises(ValueError, match="series 'a': x and y must have the same length"):
        render(Curves("C", {"a": ([1, 2], [1.0])}, "x", "y"))


def moving_square(count=5, side=16):
    frames = np.zeros((count, side, side, 3), np.uint8)
    for index, frame in enumerate(frames):
        frame[2:6, index : index + 4] = 255, 40 * index, 0
    return frames


def test_an_animation_plays_every_frame_in_its_time():
    frames = moving_square()
    encoded = np.frombuffer(animation_webp(frames, 12.5, min_side_px=32), np.uint8)
    read, animation = cv2.imdecodeanimation(encoded)
    assert read and len(animation.frames) == 5 and list(animation.durations) == [80] * 5
    for frame, shown in zip(frames, animation.frames, strict=True):
        colours = cv2.cvtColor(shown, cv2.COLOR_BGRA2RGB)
        np.testing.assert_array_equal(colours, frame.repeat(2, axis=0).repeat(2, axis=1))


def test_animations_stand_in_the_page_with_their_labels():
    page = render_report(
        title="t", lead="", verdict="", sections=[Animation("In motion", [("a <b>", moving_square())], 10.0)]
    )
    assert page.count("data:image/webp;base64,") == 1 and "a &lt;b&gt;" in page
    empty = render_report(title="t", lead="", verdict="", sections=[Animation("In motion", [], 10.0)])
    assert "No pictures." in empty


@pytest.mark.parametrize(
    ("frames", "rate_hz"),
    [
        (np.zeros((0, 4, 4, 3), np.uint8), 10),
        (np.zeros((2, 4, 4, 3)), 10),
        (moving_square(), 0),
        (moving_square(), np.nan),
    ],
)
def test_what_is_no_animation_is_refused(frames, rate_hz):
    with pytest.raises(ValueError, match="must be"):
        animation_webp(frames, rate_hz)


def test_folded_sections_are_closed_and_have_headings_of_their_own_where_there_are_several():
    one, two = Table("One", ["a"], [[1]]), Text("Two", "words")
    page = render_report(
        title="t", lead="", verdict="", sections=[Folded("Both", [one, two], "why"), Folded("B", [one])]
    )
    reader = read(page)
    assert reader.texts["h2"] == ["Both", "B"] and reader.texts["h3"] == ["One", "Two"]
    assert reader.texts["summary"] == ["Both", "B"] and not any(name == "open" for _, name, _ in reader.attributes)


def test_steps_are_pictures_or_words_with_arrows_where_one_leads_to_another():
    steps = [
        Step("1. <Label>", "“A photo of a cat”", "What is known."),
        Step("2. Image", np.full((4, 4, 3), 9, np.uint8), "What is made.", follows=True),
    ]
    reader = read(render_report(title="t", lead="", verdict="v", sections=[], steps=steps))
    assert reader.texts["figcaption"] == ["1. <Label> What is known.", "2. Image What is made."]
    assert "“A photo of a cat”" in reader.texts["p"] and len(reader.texts["li"]) == 2
    assert [value for tag, name, value in reader.attributes if tag == "li" and name == "class"] == ["follows"]
    pictures = [value for tag, name, value in reader.attributes if tag == "img" and name == "src"]
    assert len(pictures) == 1 and pictures[0].startswith("data:image/png;base64,")


def test_intervals_of_points_are_bars_where_they_are_known():
    series = {"a": ([0, 1, 2], [0.0, 2.0, 4.0])}
    nan = np.nan
    assert 'class="bar"' not in chart(series, "x", "y")
    svg = chart(series, "x", "y", spans={"a": ((nan, 1.5, 3.0), (nan, 2.5, 4.0))})
    assert svg.count('class="bar"') == 2 and "a: 2 [1.5, 2.5] at 1" in svg
