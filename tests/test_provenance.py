"""What results say about the command that made them."""

from __future__ import annotations

import sys

import pytest

from mgs.provenance import command_line


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["/usr/bin/mgs", "chart", "out"], "mgs chart out"),
        (["/lib/mgs/__main__.py", "chart", "out dir"], "mgs chart 'out dir'"),  # python -m mgs
        (["benchmarks/planning.py", "a.json"], "planning.py a.json"),
    ],
)
def test_the_command_that_is_recorded_is_the_one_that_was_typed(monkeypatch, typed, said):
    monkeypatch.setattr(sys, "argv", typed)
    assert command_line() == said
