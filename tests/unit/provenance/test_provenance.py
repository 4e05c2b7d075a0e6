"""Records of everything behind an artefact, and the comparison of two experiments by them."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ctlev_core.provenance.records import (
    Record,
    behind,
    options_of,
    read_provenance,
    read_records,
    versions_of,
    write_provenance,
)
from ctlev_core.provenance.scores import SCORE_LINEAGE, paired_samples, trace_lineage
from ctlev_core.report.sections.costs import cost_table, versions_table
from ctlev_core.report.sections.lineage import record_tables
from ctlev_core.report.studies.run_comparison import Run, compare_runs, find_run, read_run
from data_contracts import tables
from data_contracts.errors import DataError

PLUGIN = {"plugin": "datasets/studio", "version": 3, "options": {"seed": 0, "sizes": [64, 64]}}
NAMES = [f"s{number}" for number in range(30)]


def put(store, stage, key, arguments, inputs=(), rows=2, seconds=1.0):
    """An artefact with nothing but its record and a table."""
    folder = store / stage / key
    folder.mkdir(parents=True)
    pq.write_table(pa.table({"a": list(range(rows))}), folder / "manifest.parquet")
    record = {
        "stage": stage, "stage_version": 1, "key": key, "digest": key * 32, "arguments": arguments,
        "upstream": {name: name * 32 for name in inputs}, "versions": {"ctlev": "1"}, "started": "now",
        "wall_seconds": seconds, "cpu_seconds": seconds / 2, "process_peak_memory_mib": 100.0, "more": "ignored",
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.fixture
def store(tmp_path):
    """Recordings, frames, a generator, its frames, a model of both, and its scores."""
    home = tmp_path / "home" / "artefacts"
    put(home, "ingest", "0a", {"dataset": PLUGIN}, rows=7)
    put(home, "encode", "0b", {"recordings": {"manifest": "0a"}, "windows": {"count": 5}}, ["0a"], seconds=3.0)
    put(home, "finetune", "0c", {"frames": {"manifest": "0b"}, "seed": 0}, ["0b"])
    put(home, "sample", "0d", {"checkpoint": {"manifest": "0c"}, "seed": 0}, ["0c"])
    put(home, "train_downstream", "0e", {"training_sets": [{"manifest": "0b"}, {"manifest": "0d"}]}, ["0b", "0d"])
    arguments = {
        "model": {"manifest": "0e"}, "data": {"manifest": "0b"}, "split": "test",
        "training_sets": [{"manifest": "0b"}, {"manifest": "0d"}], "metrics": [{**PLUGIN, "plugin": "metrics/x"}],
    }  # fmt: skip
    put(home, "score_model", "0f", arguments, ["0e", "0b", "0d"])
    return home


def records_of(store) -> list[Record]:
    return read_records([("frames", store / "encode" / "0b"), ("score", store / "score_model" / "0f")])


def test_everything_behind_is_found_once_and_named_over_the_shortest_way(store):
    found = {record.key: record for record in records_of(store)}
    assert {key: record.role for key, record in found.items()} == {
        "0b": "frames", "0f": "score", "0a": "frames / recordings", "0e": "score / model",
        "0d": "score / training_sets", "0c": "score / training_sets / checkpoint",
    }  # fmt: skip
    assert found["0a"].rows == 7 and found["0f"].upstream["0e"] == "0e" * 32
    assert {record.key for record in behind(list(found.values()), "0d")} == {"0d", "0c", "0b", "0a"}


def test_equal_roles_are_numbered(store):
    found = read_records(
        [("x", store / "ingest" / "0a"), ("x", store / "encode" / "0b"), ("x", store / "ingest" / "0a")]
    )
    assert [record.role for record in found] == ["x", "x (2)"]


def test_options_are_leaves_without_inputs_and_versions(store):
    found = {record.key: record for record in records_of(store)}
    assert options_of(found["0a"]) == {
        "dataset.plugin": "datasets/studio", "dataset.options.seed": 0, "dataset.options.sizes": "[64, 64]",
    }  # fmt: skip
    assert options_of(found["0b"]) == {"windows.count": 5}
    assert options_of(found["0f"])["metrics.0.plugin"] == "metrics/x"
    versions = versions_of(found.values())
    assert versions["plug-in datasets/studio"] == "3" and versions["stage encode"] == "1" and versions["ctlev"] == "1"


def test_what_was_written_is_read_again(store, tmp_path):
    found = records_of(store)
    write_provenance(tmp_path / "p.json", found)
    assert read_provenance(tmp_path / "p.json") == found
    (tmp_path / "bad.json").write_text('{"stages": [{}]}')
    for name in ("bad.json", "none.json"):
        with pytest.raises(DataError, match=r"is not the provenance file of a report"):
            read_provenance(tmp_path / name)


def test_missing_records_and_inputs_are_named(store):
    (store / "ingest" / "0a" / "run.json").unlink()
    with pytest.raises(DataError, match=r"0a: has no provenance record"):
        records_of(store)
    for path in (store / "ingest" / "0a").iterdir():
        path.unlink()
    (store / "ingest" / "0a").rmdir()
    with pytest.raises(DataError, match="was made from artefact 0a, which is not in the store any more"):
        records_of(store)


def test_an_option_that_is_null_in_one_of_two_runs_of_a_stage_is_traced(store):
    scores = pa.concat_tables([score_rows(5.0)])
    digests = []
    for rate in (None, 0.5, 0.25):
        records = records_of(store)
        twice = [replace(one, arguments={"a": 1, "rate": rate}) for one in records if one.key == "0a"]
        twice += [replace(one, key="0z", arguments={"a": 1, "rate": 0.5}) for one in records if one.key == "0a"]
        others = [replace(one, upstream=one.upstream | {"0z": "x"}) for one in records if one.key == "0b"]
        rest = [one for one in records if one.key not in ("0a", "0b")]
        table = trace_lineage([("0f", scores)], [*rest, *others, *twice])
        digests.append(table["config_digest"][0].as_py())
    assert len(set(digests)) == 3


def test_costs_are_added_up_by_stage_the_dearest_first(store):
    found = records_of(store)
    table = cost_table(found)
    assert table.rows[0] == ["Recorded event frames", 1, 3.0, "38%", 1.5, 3.0, 100]
    assert sum(row[1] for row in table.rows) == len(found)  # type: ignore[misc]
    assert "6 stages took 8 s and 4 CPU seconds" in table.caption
    assert "frames" in [row[0] for table in record_tables(found) for row in table.rows]
    assert ["`stage encode`", "1"] in versions_table(found).rows


def score_rows(value, subject="recorded", samples=30):
    return pa.Table.from_pylist(
        [
            {
                "task": "pose2d", "subject": subject, "seed": 0, "group": "all", "metric": "mpjpe2d_px", "value": value,
                "low": value - 0.1, "high": value + 0.1, "num_samples": samples, "num_train": 2,
                "model_digest": "0e" * 32, "data_digest": "0b" * 32,
            }
        ],
        schema=tables.SCORES.arrow(),
    )  # fmt: skip


def test_a_score_is_traced_to_training_sets_generators_recordings_config_and_code(store):
    records = records_of(store)
    table = trace_lineage([("0f", score_rows(5.0))], records)
    tables.check_table(table, SCORE_LINEAGE, "here")
    (row,) = table.to_pylist()
    assert row["score_digest"] == "0f" * 32 and row["split"] == "test"
    assert row["training_digests"] == ["0b" * 32, "0d" * 32]
    assert row["checkpoint_digests"] == ["0c" * 32] and row["recordings_digests"] == ["0a" * 32]

    def digests(changed):
        (other,) = trace_lineage([("0f", score_rows(5.0))], changed).to_pylist()
        return other["config_digest"] != row["config_digest"], other["code_digest"] != row["code_digest"]

    def change(key, **values):
        return [replace(record, **values) if record.key == key else record for record in records]

    assert digests(change("0b", arguments={"recordings": {"manifest": "0a"}, "windows": {"count": 6}})) == (True, False)
    assert digests(change("0a", stage_version=2)) == (False, True)
    assert digests(change("0c", wall_seconds=99.0)) == (False, False)


def run_of(store, name, value, *, digest="d", shift=0.0, **changes) -> Run:
    records = records_of(store)
    changed = [replace(record, **changes.get(record.key, {})) for record in records]
    values = value + np.random.default_rng(0).normal(0, 1, 30) + shift
    samples = pa.table({"sample_id": NAMES, "recording_id": NAMES, "value": values, "weight": np.ones(30)})
    scores = score_rows(float(values.mean()))
    samples = samples.append_column("metric", pa.array([scores["metric"][0].as_py()] * 30))
    folder = store.parent / "reports" / name
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(trace_lineage([("0f", scores)], records), folder / "scores.parquet")
    pq.write_table(paired_samples([(scores.to_pylist(), samples, digest)]), folder / "samples.parquet")
    write_provenance(folder / "provenance.json", changed)
    return read_run(name, folder)


def test_a_run_differs_from_itself_in_nothing(store):
    scores, *others = compare_runs(run_of(store, "a", 5.0), run_of(store, "b", 5.0))
    assert scores.rows[0][4:] == ["+0.000 [+0.000, +0.000]", "paired"] and not scores.bold
    assert [table.rows for table in others] == [[], [], []]


def test_differences_in_options_data_code_and_scores_are_listed(store):
    changed = {
        "0b": {
            "arguments": {"recordings": {"manifest": "0a"}, "windows": {"count": 6}},
            "digest": "other",
            "key": "bb",
        },
        "0a": {"stage_version": 2},
        "0c": {"digest": "rounded"},
    }
    first = run_of(store, "a", 5.0)
    scores, options, data, code = compare_runs(first, run_of(store, "b", 5.0, shift=-0.3, **changed))
    assert scores.rows[0][4:] == ["-0.300 [-0.300, -0.300]", "paired"] and scores.bold == {(0, 4)}
    assert options.rows == [["`windows.count`", "5", "6", "frames"]]
    causes = {row[0]: row[-1] for row in data.rows}
    assert causes["frames"] == "options" and causes["score / training sets / checkpoint"].startswith("nothing:")
    assert code.rows == [["stage ingest", "1", "2"]]


def test_other_test_samples_are_compared_separately(store):
    scores, *_ = compare_runs(run_of(store, "a", 5.0), run_of(store, "b", 5.0, digest="other", shift=-0.3))
    assert scores.rows[0][5] == "separate" and not scores.bold


def test_without_scores_of_samples_intervals_are_joined(store):
    first, second = (replace(run_of(store, name, value), trainings={}) for name, value in (("a", 5.0), ("b", 4.0)))
    scores, *_ = compare_runs(first, second)
    # Half widths of 0.1 each: 0.1 sqrt(2).
    assert scores.rows[0][4:] == ["-1.000 [-1.141, -0.859]", "intervals"]


def test_what_is_no_report_of_this_version_is_refused(store, tmp_path):
    with pytest.raises(DataError, match="a report of an earlier version must be made again"):
        read_run("old", tmp_path)
    run_of(store, "a", 5.0)
    folder = store.parent / "reports" / "a"
    pq.write_table(score_rows(5.0), folder / "scores.parquet")
    with pytest.raises(DataError, match=r"scores.parquet: table 'score_lineage': missing columns"):
        read_run("a", folder)
    (folder / "scores.parquet").write_bytes(b"no table")
    with pytest.raises(DataError, match=r"scores.parquet: is not a table of a report"):
        read_run("a", folder)


def test_runs_are_found_by_name_key_and_path(store, tmp_path):
    home = tmp_path / "home"
    run_of(store, "demo", 5.0)
    published = home / "reports" / "demo"
    published.with_suffix(".html").write_text("page")
    kept = home / "artefacts" / "report" / "0123456789abcdef0123456789abcdef"
    kept.mkdir(parents=True)
    (kept / "provenance.json").write_text("{}")
    for name in ("demo", str(published), f"{published}.html", str(published / "scores.parquet")):
        assert find_run(name, home) == published
    assert find_run("01234567", home) == kept == find_run(str(kept), home)
    for name in ("absent", "ffffffff", str(tmp_path)):
        with pytest.raises(DataError, match=r"which has reports demo and keys 0123456789ab"):
            find_run(name, home)
    (kept.parent / f"{'01234567':f<32}").mkdir()
    with pytest.raises(DataError, match="give more digits"):
        find_run("01234567", home)
