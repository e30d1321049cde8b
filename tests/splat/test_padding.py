"""Lists are padded to a round length."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mgs.splat import blocks


@pytest.mark.parametrize("count", [0, 1, 1023, 1024, 1025])
def test_pairs_of_any_number_are_sorted_and_padded(count):
    rng = np.random.default_rng(count)
    owner, number = rng.integers(0, 50, count), rng.integers(0, 256, count)
    pairs = (mi.UInt32(owner), mi.UInt32(number)) if count else (mi.UInt32(), mi.UInt32())
    arrays = blocks._by_block(*pairs, 256)
    splat, pair, start, end = (np.asarray(a).astype(int) for a in arrays)
    order = np.argsort(number, kind="stable")
    assert len(splat) == len(pair) == blocks._room(count)
    np.testing.assert_array_equal(splat, [*owner[order], *[0] * (len(splat) - count)])
    np.testing.assert_array_equal(pair[:count][order], np.arange(count))
    for k in range(256):
        expected = np.full((number == k).sum(), k)
        np.testing.assert_array_equal(np.sort(number)[start[k] : end[k]], expected)
    assert dr.width(arrays[0]) % 1024 == 0
