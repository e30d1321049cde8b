"""Lists are padded with zeros to a round length; an empty list, and one that needs no padding, once crashed."""

import drjit as dr
import mitsuba as mi
import pytest

from mgs.splat import blocks


@pytest.mark.parametrize(("length", "size"), [(0, 4), (3, 4), (4, 4)])
def test_padding_of_any_length(length, size):
    padded = blocks._padded(dr.arange(mi.UInt32, 7, 7 + length), size)
    assert list(padded) == list(range(7, 7 + length)) + [0] * (size - length)
