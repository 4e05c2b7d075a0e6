"""The report's sequences: the table, which stretches are played beside which, and what the films are made of."""

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pyarrow as pa
import pytest
from browser import CHROMIUM, run_in_browser
from report_artefacts import COUNT, STRETCH, Experiment

from ctlev_core.report.page.figures import film_strip
from ctlev_core.report.page.html import Films, render_report
from ctlev_core.report.page.tables import Table
from ctlev_core.report.sections.sequences import SHOWN_RATE_HZ, sequence_sections
from data_contracts.manifest import Manifest
from tasks.report import report
from tasks.stage import Output


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return Experiment(tmp_path_factory.mktemp("home"))


@pytest.fixture(scope="module")
def sections(experiment):
    generated = dict(zip(("synthetic", "gan"), experiment.generated, strict=True))
    return sequence_sections(experiment.sequences, experiment.frames, experiment.conditions, generated)


def test_numbers_stand_beside_recorded_ones_and_shuffled_time(sections):
    _, table, _ = sections
    assert isinstance(table, Table)
    assert table.columns == [
        "number", "recorded training (6)", "the same, time shuffled (6)", "recorded test (6)", "synthetic (6)",
        "GAN (6)",
    ]  # fmt: skip
    assert table.rows == [
        [
            "activity one frame later, correlation",
            "0.750 [0.625, 0.875]", "0.000 [-0.125, 0.125]", "0.500 [0.375, 0.625]", "0.125 [0.000, 0.250]", None,
        ],
        [
            "active pixels that stay, share",
            "0.500 [0.375, 0.625]", "0.250 [0.125, 0.375]", None, "0.375 [0.250, 0.500]", "0.125",
        ],
    ]  # fmt: skip
    assert "Stretches of 4 frames, each 0.001 ms" in table.caption


def test_the_two_sample_tests_are_of_stretches(sections):
    *_, tests = sections
    assert isinstance(tests, Table) and "which of two sets a stretch is from" in tests.caption
    assert tests.rows == [
        ["recorded training stretches: shuffled time from true", "0.875 [0.750, 1.000]", "0.062", "50 + 50", ""],
        ["synthetic from recorded test stretches", "0.750 [0.625, 0.875]", "0.062", "50 + 50", ""],
        ["GAN from recorded test stretches", None, None, "50 + 50", "fewer than 40 stretches in a set"],
    ]


def test_films_are_conditions_and_the_frames_made_for_them(experiment, sections):
    films, *_ = sections
    assert isinstance(films, Films) and films.rate_hz == SHOWN_RATE_HZ
    # Twelve labels 1 us apart: three stretches of four; no recording has more than a frame.
    assert [len(clips) for _, clips in films.rows] == [3, 3, 3]
    asked, made = experiment.conditions.array("images"), experiment.generated[0].array("frames")
    for number, (_, clips) in enumerate(films.rows):
        rows = slice(STRETCH * number, STRETCH * (number + 1))
        (first, conditions), (second, synthetic), (third, _) = clips
        assert (first, second, third) == ("condition", "synthetic", "GAN")
        assert np.array_equal(conditions, asked[rows]) and np.array_equal(synthetic, made[rows])


def test_recorded_films_show_the_same_moments_or_the_same_class(experiment):
    def shown(sources):
        made = replaced(experiment.generated[0], source_id=sources)
        films, *_ = sequence_sections(experiment.sequences, frames, experiment.conditions, {"synthetic": made})
        assert isinstance(films, Films)
        return [clips[0] for _, clips in films.rows]

    names, times = ["r"] * COUNT, pa.array(range(COUNT), pa.int64())
    classes = ["walk"] * COUNT
    frames = replaced(experiment.frames, recording_id=names, t_start_us=times, class_name=classes)
    images = experiment.frames.array("frames")
    # Training frames are the first six, held-out ones the others; a stretch has four.
    moments = shown(experiment.frames.column("sample_id"))
    assert [label for label, _ in moments] == ["recorded, same moments"] * 3
    for number, (_, film) in enumerate(moments):
        assert np.array_equal(film, images[STRETCH * number : STRETCH * (number + 1)])
    others = shown([f"elsewhere:{number}" for number in range(COUNT)])
    assert [label for label, _ in others] == ["recorded"] * 3, "the first frame of each is of the class walk"
    for (_, film), first in zip(others, (6, 0, 6), strict=True):
        assert np.array_equal(film, images[first : first + STRETCH])


def replaced(manifest: Manifest, **columns) -> Manifest:
    """A manifest with some columns of its table changed."""
    table = manifest.table
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return replace(manifest, table=table)


def test_a_film_is_a_strip_that_the_style_sheet_moves_frame_by_frame():
    frames = np.random.default_rng(0).integers(0, 255, (5, 48, 40, 3)).astype(np.uint8)
    page = render_report(title="t", lead="", verdict="", sections=[Films("F", [("row", [("clip", frames)])], 4.0)])
    (film,) = re.findall(
        r'<figure style="--width:(\d+)px;--count:5"><div.*?src="data:image/png;base64,([^"]+)" style="([^"]+)"', page
    )
    width, png, style = film
    assert int(width) == 3 * 40, "the smallest whole factor with 128 px and more on the longer side"
    assert "animation-duration:1.25s" in style and "steps(5)" in style
    strip = cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    for number, frame in enumerate(frames):
        assert np.array_equal(strip[:, 40 * number : 40 * (number + 1)], frame)
    assert "prefers-reduced-motion: reduce" in page and "image-rendering: pixelated" in page


def test_large_films_are_made_smaller_and_what_is_no_film_is_refused():
    assert film_strip(np.full((3, 600, 520, 3), 7, np.uint8)).shape == (200, 3 * 173, 3)
    for wrong in (np.zeros((0, 4, 4, 3), np.uint8), np.zeros((2, 4, 4), np.uint8), np.zeros((2, 4, 4, 3))):
        with pytest.raises(ValueError, match=r"frames must be \[T, H, W, 3\] uint8"):
            film_strip(wrong)
    with pytest.raises(ValueError, match="rate_hz must be positive"):
        films = Films("F", [("row", [("clip", np.zeros((2, 4, 4, 3), np.uint8))])], 0.0)
        render_report(title="t", lead="", verdict="", sections=[films])


def test_the_report_has_sequences_where_they_were_measured_and_no_second_animation(experiment, tmp_path):
    pages = []
    for sequences in (None, experiment.sequences):
        folder = tmp_path / str(len(pages))
        folder.mkdir()
        report.function(Output(folder, folder), experiment.inputs, sequences)
        pages.append((folder / "report.html").read_text())
        assert ("activity one frame later" in (folder / "tables.md").read_text()) == bool(sequences)
    assert ["Sequences in motion" in page for page in pages] == [False, True]
    assert ["In motion" in page for page in pages] == [True, False]


PROBE = """
const frame = document.createElement("iframe");
frame.style = "border: 0; width: 900px; height: 800px";
frame.src = "page.html";
frame.addEventListener("load", () => {
  const inner = frame.contentDocument, view = frame.contentWindow;
  const film = inner.querySelector(".films img"), window = film.parentElement.getBoundingClientRect();
  const found = {shown: window.width, height: window.height, whole: film.getBoundingClientRect().width};
  const [animation] = film.getAnimations();
  found.animated = Boolean(animation);
  if (animation) {
    animation.pause();
    found.places = [0, 290, 310, 590, 610, 890, 910].map(time => {
      animation.currentTime = time;
      return film.getBoundingClientRect().left - window.left;
    });
  }
  document.querySelector("pre").textContent = JSON.stringify(found);
});
document.body.append(frame);
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_one_frame_after_the_other_or_all_where_no_motion_is_wanted(tmp_path):
    frames = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3)).astype(np.uint8)
    page = render_report(title="t", lead="", verdict="", sections=[Films("F", [("row", [("clip", frames)])], 1 / 0.3)])
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    found, _ = run_in_browser(PROBE, tmp_path, tmp_path)
    assert (found["shown"], found["height"], found["whole"]) == (128, 128, 4 * 128)
    assert found["animated"] and found["places"] == [0, 0, -128, -128, -256, -256, -384]
    still, _ = run_in_browser(PROBE, tmp_path, tmp_path, "--force-prefers-reduced-motion")
    assert not still["animated"] and still["whole"] == still["shown"] > 4 * 128
    assert still["height"] == pytest.approx(still["shown"] / 4, abs=1)
