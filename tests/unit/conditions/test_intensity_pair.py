"""Pairs of grey pictures as condition images."""

import numpy as np
import pytest

from ctlev_core.conditions import intensity_pair
from data_contracts.errors import DataError
from data_contracts.labels import Labels

LABELS = Labels(("walk", "run"), np.zeros(2, np.int64))
PAIRS = np.random.default_rng(0).integers(0, 256, (2, 6, 8, 2)).astype(np.uint8)


def test_start_and_end_become_red_and_green():
    made = intensity_pair.render(LABELS, (8, 6), intensity_pair.Options(), [0, 1], PAIRS)
    assert made.prompts == ("A moving human",) * 2 and made.images.shape == (2, 6, 8, 3)
    np.testing.assert_array_equal(made.images[..., 0], PAIRS[..., 0])
    np.testing.assert_array_equal(made.images[..., 1], PAIRS[..., 1])
    assert not made.images[..., 2].any()


@pytest.mark.parametrize("pairs", [PAIRS[:1], PAIRS.astype(np.int16), PAIRS[..., :1], PAIRS.swapaxes(1, 2)])
def test_pairs_of_another_kind_are_refused(pairs):
    with pytest.raises(DataError, match=r"pairs must be \[2, 6, 8, 2\] uint8, got"):
        intensity_pair.render(LABELS, (8, 6), intensity_pair.Options(), [0, 1], pairs)


def test_seeds_must_fit():
    with pytest.raises(DataError, match="2 labels but 1 seeds"):
        intensity_pair.render(LABELS, (8, 6), intensity_pair.Options(), [0], PAIRS)
