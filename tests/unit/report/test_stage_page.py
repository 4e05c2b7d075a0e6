"""What Prefect's pages show of an artefact."""

import base64
import re
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
from report_artefacts import Experiment

from ctlev_core.report.page.html import Curves
from ctlev_core.report.stage_page import CELL_PX, curves_svg, stage_page


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return Experiment(tmp_path_factory.mktemp("home"))


def pictures(page, kind):
    return [base64.b64decode(text) for text in re.findall(rf"\]\(data:{kind};base64,([^)]+)\)", page)]


def test_images_are_shown_as_they_are(experiment):
    page = stage_page(experiment.frames, "encode: frames [1]")
    (png,) = pictures(page, "image/png")
    sheet = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    frames = experiment.frames.array("frames")
    factor = -(-CELL_PX // frames.shape[1])
    cell = frames.shape[1] * factor
    np.testing.assert_array_equal(sheet[:cell:factor, :cell:factor], frames[0])
    assert f"{len(experiment.frames)} rows in `{experiment.frames.ref.path}`" in page


def test_losses_are_a_chart(experiment):
    (svg,) = pictures(stage_page(experiment.models[0], "train"), r"image/svg\+xml")
    root = ElementTree.fromstring(svg)
    lines = [item for item in root if item.tag.endswith("polyline")]
    assert len(lines) == len(set(experiment.models[0].column("curve")))


def test_names_are_text_in_a_chart():
    svg = curves_svg(Curves("", {"<b> & c": ([0, 1], [1, 2])}, "x", "y"))
    assert svg is not None and any(item.text == "<b> & c" for item in ElementTree.fromstring(svg))
    assert curves_svg(Curves("", {"none": ([], [])}, "x", "y")) is None


def test_scores_over_all_rows_are_a_table(experiment):
    page = stage_page(experiment.scores[0], "score")
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert "value" in rows[0]
    assert len(rows) - 2 == sum(row["group"] == "all" for row in experiment.scores[0].table.to_pylist())


def test_the_place_of_a_report_is_told(experiment):
    (experiment.event_realism.ref.path / "report.html").write_text("page")
    link = (experiment.event_realism.ref.path / "report.html").as_uri()
    assert f"]({link})" in stage_page(experiment.event_realism, "report")
