"""What holds on every page: ids, links, headings of tables, names that readers know, and colours that can be read."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from pooled_study import write_pooled_study
from report_artefacts import TRAINING_SETS, Experiment

from ctlev_core import plugins
from ctlev_core.report.page import html
from ctlev_core.report.page.display_names import SOURCES, metric_heading, metric_name, role_name, set_name, subject_name
from ctlev_core.report.page.report_files import publish_report
from data_contracts.manifest import Manifest, ManifestRef
from tasks.report import report
from tasks.stage import Output
from tasks.study_report import study_report

CODE_NAME = re.compile(r"\b[a-z0-9]+_[a-z0-9_]+\b")


class Page(HTMLParser):
    """What a reader sees of a page, and what leads where."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.texts: list[str] = []
        self.titles: list[str] = []
        self.captions: list[str] = []
        self.num_tables = 0
        self._open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.ids += [found["id"]] if "id" in found else []
        self.links += [found["href"]] if tag == "a" else []
        self.titles += [found["title"]] if "title" in found else []
        self.num_tables += tag == "table"
        self.captions += [""] if tag == "caption" else []
        if tag not in ("meta", "img", "br"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if "caption" in self._open:
            self.captions[-1] += data
        if not {"script", "style", "code", "head"} & set(self._open):
            self.texts.append(data)


@pytest.fixture(scope="module")
def reports(tmp_path_factory) -> Path:
    """The folder with the published pages of an experiment, a study, and a study of several draws."""
    home = tmp_path_factory.mktemp("home")
    experiment = Experiment(tmp_path_factory.mktemp("experiment"))
    alone, both, pooled = (experiment.home / name for name in ("alone", "both", "pooled"))
    for folder in (alone, both, pooled):
        folder.mkdir()
    report.function(Output(alone, alone), experiment.inputs, experiment.sequences)
    study_report.function(
        Output(both, both), [Manifest(ManifestRef(key="k", path=alone), None, (), ())] * 2, title="both",
        notice="Made up.", names=("first_one", "second_one"), training_sets=[list(TRAINING_SETS)] * 2,
        generator_names=[["synthetic", "gan"]] * 2,
    )  # fmt: skip
    write_pooled_study(pooled, (2, 5))
    for name, folder in (("tiny", alone), ("both", both), ("numbers", pooled / "made")):
        publish_report(ManifestRef(key="k", path=folder), home, name)
    return home / "reports"


PAGES = pytest.mark.parametrize("name", ["tiny", "both", "numbers"])


@PAGES
def test_ids_are_unique_links_lead_somewhere_and_tables_have_captions(reports, name):
    page = Page((reports / f"{name}.html").read_text())
    assert len(page.ids) == len(set(page.ids)) and page.links
    for link in page.links:
        assert link[1:] in page.ids if link.startswith("#") else (reports / link).is_file(), link
    assert page.num_tables == len(page.captions) > 0 and all(text.strip() for text in page.captions)


@PAGES
def test_names_of_code_are_not_in_the_text_but_behind_it(reports, name):
    page = Page((reports / f"{name}.html").read_text())
    assert {found for text in page.texts for found in CODE_NAME.findall(text)} == set()
    assert any("recorded+synthetic" in title for title in page.titles)


def test_boxes_of_the_lineage_lead_to_the_records_of_their_stage(reports):
    page = Page((reports / "tiny.html").read_text())
    leading = [link for link in page.links if link.startswith("#record-")]
    assert {"#record-ingest", "#record-finetune", "#record-sample", "#record-score_model"} <= set(leading)
    assert "What was made from what" in "".join(page.texts)


def test_every_declared_score_has_a_name():
    declared = [info for metric in plugins.names("metrics") for info in plugins.load("metrics", metric).SCORES]
    assert len(declared) > 10
    examples = (
        "mpjpe2d_px", "mpjpe2d_dhp19_known_px", "mpjpe2d_sensor_px", "mpjpe3d_pelvis_mm", "pve_pa_mm",
        "pck_torso0.2", "pck3d_pa_25mm", "pckh3d_0.5", "auc3d_pelvis_150mm", "oks_ap50", "oks_mean", "accuracy",
        "macro_f1", "binary_accuracy_mean",
        "fd_event_classifier_d1c3057e", "fid", "fid_infinity", "kid_event_x_0", "fd_infinity_event_x_0",
        "mmd_event_x_0", "mmd_sigma10_event_x_0",
        "precision_k5_event_x_0", "recall_k5", "density_k5", "coverage_k5", "calibration_error_ece15",
        "chance_accuracy", "macro_recall",
    )  # fmt: skip
    for info in declared:
        assert any(example.startswith(info.start) for example in examples), f"{info.start}: has no example here"
    for example in examples:
        told = metric_name(example)
        assert not CODE_NAME.search(told) and (told.code or told) == example
    assert metric_heading("mpjpe2d_px") == "2D joint error (MPJPE), px ↓" and metric_heading("accuracy").endswith("↑")
    assert metric_heading("chance_accuracy") == "accuracy by chance", "neither more nor less is better"


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("recorded+synthetic@0.25", "recorded + 25 % of synthetic"),
        ("recorded+event_gan", "recorded + Event-GAN"),
        ("random_50", "synthetic (random weights, 50 steps)"),
        ("shuffled label agreement of synthetic", "synthetic (shuffled labels)"),
        ("held-out recorded", "held-out recorded"),
        ("my_own_thing", "my own thing"),
    ],
)
def test_subjects_are_named(code, told):
    assert subject_name(code) == told and (subject_name(code).code or told) == code


def test_sources_differ_in_their_names_and_roles_name_them():
    assert len({set_name(code) for code in SOURCES}) == len(SOURCES)
    assert role_name("model of recorded+event_gan, seed 0 / training_sets") == (
        "model of recorded + Event-GAN, seed 0 / training sets"
    )


def luminance(colour: str) -> float:
    """WCAG 2.2, relative luminance of `#rgb` or `#rrggbb`."""
    digits = colour.lstrip("#")
    digits = "".join(2 * digit for digit in digits) if len(digits) == 3 else digits
    shares = [int(digits[place : place + 2], 16) / 255 for place in (0, 2, 4)]
    red, green, blue = (share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_texts_and_lines_have_a_contrast_of_at_least_4_5_in_both_schemes():
    style = (Path(html.__file__).parent / "templates" / "page.css").read_text()
    roots = re.findall(r":root \{(.*?)\}", style, re.DOTALL)
    schemes = [dict(re.findall(r"--([a-z0-9]+): (#[0-9a-f]{3,6})", root)) for root in roots]
    assert len(schemes) == 2
    for scheme in schemes:
        for name in ("ink", "soft", "accent", "good", "bad", "open", *(f"s{number}" for number in range(8))):
            for ground in ("page", "tint"):
                light, dark = sorted((luminance(scheme[name]), luminance(scheme[ground])), reverse=True)
                assert (light + 0.05) / (dark + 0.05) >= 4.5, (name, ground, scheme)
