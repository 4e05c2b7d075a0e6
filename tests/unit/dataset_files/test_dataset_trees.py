"""What the datasets share: roots found, folders listed safely, choices that stay."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.dataset_files import trees
from data_contracts.errors import DataError

TREE = "expected the tree"
NAMES = st.lists(st.text("abc01.", min_size=1, max_size=5), unique=True, min_size=2, max_size=30)


@given(NAMES, st.integers(0, 2**70), st.randoms(use_true_random=False))
def test_an_order_ignores_the_listing_and_survives_a_lost_file(names, seed, random):
    order = trees.shuffled(names, seed, "salt")
    assert sorted(order) == sorted(names)
    again = random.sample(names, len(names))
    assert trees.shuffled(again, seed, "salt") == order
    lost = again.pop()
    assert trees.shuffled(again, seed, "salt") == [name for name in order if name != lost]


def test_orders_depend_on_seed_and_salt_and_are_balanced():
    names = [str(number) for number in range(8)]
    orders = [trees.shuffled(names, seed, "a") for seed in range(2000)]
    firsts = [sum(order[0] == name for order in orders) for name in names]
    assert max(firsts) < 2 * min(firsts)  # 250 each if all are alike: a coin this unfair has p < 1e-6
    assert trees.shuffled(names, 1, "a", "b") != trees.shuffled(names, 1, "ab")


def test_first_of_takes_all_or_some():
    assert trees.first_of("abc", None) == ["a", "b", "c"]
    assert trees.first_of("abc", 2) == ["a", "b"] and trees.first_of("abc", 9) == ["a", "b", "c"]


def test_recording_ids_are_paths_with_underscores(tmp_path):
    paths = [tmp_path / "A" / "B3 - walk (1)_poses.npz", tmp_path / "c.d" / "e.f.npz"]
    assert trees.recording_ids(paths, tmp_path) == ["A/B3_-_walk_1__poses", "c.d/e.f"]
    with pytest.raises(
        DataError, match=r"B3_-_walk_1__poses.* would get the recording id .* of .*B3 - walk \(1\)_poses"
    ):
        trees.recording_ids([*paths, tmp_path / "A" / "B3_-_walk_1__poses.npz"], tmp_path)


def test_lines_come_without_blanks_ends_and_byte_order_mark(tmp_path):
    file = tmp_path / "list.txt"
    file.write_bytes("\ufeffone\r\n\n  \ntwo three \nfour".encode())
    assert trees.read_lines(file) == [(1, "one"), (4, "two three"), (5, "four")]
    with pytest.raises(DataError, match="cannot be read as text"):
        trees.read_lines(tmp_path)


def is_root(folder: Path) -> bool:
    return (folder / "mark").is_file()


def test_a_root_is_found_two_levels_away_but_no_home_folder_is_searched(tmp_path):
    root = tmp_path / "a" / "b"
    (root / "c" / "d").mkdir(parents=True)
    (root / "mark").touch()
    assert trees.check_root(root, TREE, is_root) == root
    for wrong in (tmp_path, tmp_path / "a", root / "c", root / "c" / "d"):
        with pytest.raises(DataError, match=f"the root is {root}; {TREE}"):
            trees.check_root(wrong, TREE, is_root)
    asked = []
    for number in range(3 * trees.MAX_SEARCHED):
        (tmp_path / "home" / f"{number}").mkdir(parents=True)
    with pytest.raises(DataError, match=f"not the expected folder; {TREE}"):
        trees.check_root(tmp_path / "home", TREE, lambda folder: bool(asked.append(folder)))
    assert len(asked) <= trees.MAX_SEARCHED + 3


@pytest.mark.parametrize("place", ["link", "stuff/link"])
def test_a_wrong_root_is_told_whatever_lies_in_it(tmp_path, place):
    (tmp_path / "stuff").mkdir()
    (tmp_path / place).symlink_to(tmp_path / "gone")

    def lists_what_it_is_asked_of(folder):
        return folder != tmp_path and any(path.name == "mark" for path in trees.list_folder(folder))

    for ask in (is_root, lists_what_it_is_asked_of):
        with pytest.raises(DataError, match=f"not the expected folder; {TREE}"):
            trees.check_root(tmp_path, TREE, ask)


def test_hidden_entries_are_not_listed_and_links_are_checked(tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    for name in (".hidden", "b.bin", "a.bin", "c.txt"):
        (root / name).touch()
    assert [path.name for path in trees.list_folder(root)] == ["a.bin", "b.bin", "c.txt"]
    assert [path.name for path in trees.list_files(root, root, ".bin")] == ["a.bin", "b.bin"]
    (root / "d.bin").symlink_to(root / "a.bin")
    assert len(trees.list_files(root, root, ".bin")) == 3
    (tmp_path / "outside.bin").touch()
    (root / "e.bin").symlink_to(tmp_path / "outside.bin")
    with pytest.raises(DataError, match=r"e\.bin: links to .*outside\.bin, outside the dataset folder"):
        trees.list_files(root, root, ".bin")
    (root / "e.bin").unlink()
    (root / "f.bin").symlink_to(root / "gone")
    with pytest.raises(DataError, match=r"f\.bin: a link to nothing"):
        trees.list_folder(root)


def test_names_that_cannot_be_part_of_an_id(tmp_path):
    assert trees.check_name(tmp_path / "a.b-c_1") == "a.b-c_1"
    with pytest.raises(DataError, match="expected a name of letters, digits"):
        trees.check_name(tmp_path / "two words")
