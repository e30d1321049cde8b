"""`mgs nbv` around the loop: what a run is started with, what is refused, what is printed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tiny
from rich.console import Console

from mgs.commands.nbv import start_run


@pytest.fixture
def dataset(tmp_path):
    return tiny.write_dataset(tmp_path / "dataset")


def started(dataset: Path, out: Path, prior: Path | None = None, **values) -> tuple[dict, str]:
    """Settings in the config.json of a run that `start_run` wrote, and what it printed."""
    console = Console(record=True, width=500)
    start_run(dataset, out, prior, None, values, console)
    return json.loads((out / "config.json").read_text())["settings"], console.export_text()


def test_the_datasets_own_prior_is_the_default(dataset, tmp_path):
    own, other = tiny.write_prior(dataset / "prior"), tiny.write_prior(tmp_path / "other")
    settings, shown = started(dataset, tmp_path / "run", budget=2)
    assert Path(settings["prior"]) == own.resolve()
    assert f"prior: {own}" in shown
    assert not (tmp_path / "run/prior").exists()
    settings, _ = started(dataset, tmp_path / "given", other, budget=2)
    assert Path(settings["prior"]) == other.resolve()
