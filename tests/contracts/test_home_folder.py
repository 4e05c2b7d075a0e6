"""A home is a folder, or a bucket with a folder of its own as its cache."""

from pathlib import Path

import pytest

from data_contracts.errors import DataError
from data_contracts.home_folder import bucket_url, home_folder


def test_a_folder_is_itself(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CTLEV_HOME", raising=False)
    assert home_folder() == tmp_path / ".ctlev"
    monkeypatch.setenv("CTLEV_HOME", "other")
    assert home_folder() == tmp_path / "other" and home_folder("third") == tmp_path / "third"
    assert home_folder("~/x") == Path.home() / "x"
    assert bucket_url(tmp_path) is None and not list(tmp_path.iterdir())


def test_a_bucket_has_one_folder_however_it_is_written(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_CACHE", str(tmp_path))
    monkeypatch.setenv("CTLEV_HOME", "s3://bucket/a/b")
    folder = home_folder()
    assert folder.parent == tmp_path and bucket_url(folder) == "s3://bucket/a/b"
    assert home_folder("s3://bucket//a/b/") == folder == home_folder(folder)
    others = {home_folder(url) for url in ("s3://bucket/a_b", "s3://bucket/a", "gs://bucket/a/b", "s3://bucket")}
    assert len(others | {folder}) == 5
    assert home_folder("abfs://box@account.dfs.core.windows.net/x").name.startswith("abfs_box_account.dfs.core")


def test_caches_are_in_the_users_cache_folder_by_default(monkeypatch, tmp_path):
    monkeypatch.delenv("CTLEV_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert home_folder("s3://bucket").parent == tmp_path / "cache" / "ctlev"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert home_folder("s3://bucket").parent == tmp_path / ".cache" / "ctlev"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("http://host/x", r"home 'http://host/x': expected a folder, or a bucket at s3://, gs://.*; got http://"),
        ("s3://", r"home 's3://': expected s3://BUCKET or s3://BUCKET/PREFIX"),
        ("s3://bucket/../x", r"home 's3://bucket/\.\./x': expected s3://BUCKET"),
    ],
)
def test_other_urls_are_refused(given, said, tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / "cache"))
    with pytest.raises(DataError, match=said):
        home_folder(given)
    assert not (tmp_path / "cache").exists()
