"""Shared test set-up: the variant is set once, before any test module that imports kernels; and a
tiny dataset to spoil."""

import importlib
import shutil
from pathlib import Path

import pytest
from hypothesis import settings

from mgs import runtime

runtime.start()
settings.register_profile(
    "mgs", deadline=None
)  # no test is timed: the machine may be busy, and a first call loads libraries
settings.load_profile("mgs")

import tiny  # noqa: E402


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    return tiny.write_dataset(tmp_path_factory.mktemp("pristine") / "dataset")


@pytest.fixture
def dataset(pristine, tmp_path):
    """A copy of a tiny dataset, for this test alone."""
    return Path(shutil.copytree(pristine, tmp_path / "dataset"))


@pytest.fixture
def prior(tmp_path):
    """A tiny prior that fits the tiny dataset."""
    return tiny.write_prior(tmp_path / "prior")


@pytest.fixture(scope="module")
def coarse_arena():
    """A ground of few vertices and texels: how fine it is decides most of a scene's cost and
    nothing that is tested."""
    from mgs.synth import arena

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(arena, "ROWS", 60)
        patched.setattr(arena, "TEXELS", 64)
        yield


@pytest.fixture(scope="session")
def photographs():
    """tools/photographs.py, which is no part of the package."""
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(Path(__file__).parent.parent / "tools")
        return importlib.import_module("photographs")
