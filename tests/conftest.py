"""Shared set-up: one processor for each worker, the variant before kernels, common fixtures."""

import gc
import os
import shutil
import signal
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import settings

from mgs import plotting, runtime
from mgs.cli import terminal

if WORKER := os.environ.get("PYTEST_XDIST_WORKER"):
    # Threads of two workers on the same two processors cost a third more seconds.
    processors = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {processors[int(WORKER[2:]) % len(processors)]})
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
runtime.start()
terminal.SECONDS_BETWEEN = float("inf")  # a busy machine would print lines of progress
# No deadline: the machine may be busy, and a first call loads libraries.
settings.register_profile("mgs", deadline=None)
settings.load_profile("mgs")

NEW_FIGURE = plotting.new_figure


def plain_figure(width, height, dpi=0):
    """A small figure, in which nothing is moved to fit: that takes most of the time to draw one."""
    from matplotlib.figure import Figure

    return Figure((width, height), 20)


plotting.new_figure = plain_figure

import tiny  # noqa: E402

from mgs.data.dataset import load_dataset  # noqa: E402

LONGEST = """
structure_from_motion photographs docs setups import suggest prior page view capture api agreement
sweep nbv chart refit end_to_end synth borders_data recordings poses hostile blender scene evaluate
world options directional survey bad_input compact detectors exposure stress fisher derivatives
kernels
"""


def pytest_collection_finish():
    gc.freeze()  # each evaluation collects garbage, and would look through all that is imported


def pytest_collection_modifyitems(items):
    """Files that take longest go first: otherwise one worker waits for the other at the end."""
    names = LONGEST.split()

    def place(item):
        name = item.path.stem.removeprefix("test_")
        return names.index(name) if name in names else len(names)

    items.sort(key=place)


@pytest.fixture(scope="session")
def pristine(tmp_path_factory):
    return tiny.write_dataset(tmp_path_factory.mktemp("pristine") / "dataset")


@pytest.fixture(scope="session")
def loaded(pristine):
    """A tiny dataset that no test changes."""
    return load_dataset(pristine)


@pytest.fixture(scope="session")
def whole(loaded, tmp_path_factory):
    """The folder of a run of three seeds and five views of it, to which tests only add files."""
    out = tmp_path_factory.mktemp("whole") / "run"
    tiny.run(out, loaded)
    return out


@pytest.fixture(scope="session")
def seeded(pristine, tmp_path_factory):
    """The folder of a run of its seeds alone, which no test changes."""
    root = tmp_path_factory.mktemp("seeded")
    return tiny.write_run(root / "run", pristine, tiny.write_prior(root / "prior"))


@pytest.fixture(scope="session")
def orbit(tmp_path_factory):
    """Twelve views of an ellipsoid, which no test changes."""
    import synthetic

    return synthetic.orbit(tmp_path_factory.mktemp("orbit"), 12, 96, 72)


@pytest.fixture
def dataset(pristine, tmp_path):
    """A copy of a tiny dataset, for this test alone."""
    return Path(shutil.copytree(pristine, tmp_path / "dataset"))


@pytest.fixture
def prior(tmp_path):
    """A tiny prior that fits the tiny dataset."""
    return tiny.write_prior(tmp_path / "prior")


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium."""
    from browser import chromium

    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def features_once():
    """Few features, and those of the same PNG once: they take most of a matcher's seconds."""
    import pycolmap

    extract, found = pycolmap.extract_features, {}

    def once(path, folder, image_names, **options):
        pixels = {name: (folder / name).read_bytes() for name in image_names}
        new = [name for name in image_names if name[-4:] != ".png" or pixels[name] not in found]
        if new:  # of no names it takes all
            extract(path, folder, image_names=new, **options)
        with closing(pycolmap.Database.open(path)) as database:
            numbers = {image.name: image.image_id for image in database.read_all_images()}
            for name in image_names:
                if name in new:
                    features = database.read_keypoints, database.read_descriptors
                    found[pixels[name]] = [read(numbers[name]) for read in features]
                else:
                    keypoints, descriptors = found[pixels[name]]
                    database.write_keypoints(numbers[name], keypoints)
                    database.write_descriptors(numbers[name], descriptors)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pycolmap, "extract_features", once)
        patched.setattr("mgs.data.structure.FEATURES", 600)
        yield


@pytest.fixture(scope="module")
def coarse_arena():
    """Ground of few vertices and texels, one stone in place of 16, and noise of few samples, since
    they are most of a scene's cost."""
    import numpy as np

    from mgs.synth import arena, rock

    stone = arena._stone(arena.Noise(np.random.default_rng(0)), 0.08)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(arena, "ROWS", 60)
        patched.setattr(arena, "TEXELS", 64)
        patched.setattr(rock, "LATTICE", 48)
        patched.setattr(arena, "_stone", lambda *_: stone)
        yield


@pytest.fixture(scope="module")
def coarse_rocks(coarse_arena):
    """Procedural rocks of few triangles and texels, on a coarse ground."""
    from mgs.synth import rendering

    make_rock = rendering.make_rock

    def coarse(rock, rng):
        return make_rock(rock.model_copy(update={"detail": rock.size / 30}), rng)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(rendering, "make_rock", coarse)
        yield


@pytest.fixture(scope="module")
def coarse_priors():
    """Surfaces of few cells, which are most of a prior's cost: for tests that do not look at it."""
    from mgs.prior import hull, surface

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(hull, "COARSE", 14)
        # pymeshlab's grid is full down to a depth of 5.
        patched.setattr(surface, "POISSON_DEPTHS", (4, 4))
        patched.setattr(surface, "CUBES", ((1, 0), (2, 0)))
        patched.setattr(surface, "TRUTH_SAMPLES", 2000)
        yield


@pytest.fixture
def figures(monkeypatch):
    """Figures as they are, for tests that look at them."""
    for module in ("mgs.plotting", "mgs.reports.video"):
        monkeypatch.setattr(f"{module}.new_figure", NEW_FIGURE)


@pytest.fixture
def short_fits(monkeypatch):
    """Fits of runs have at most two passes: for tests that do not look at their quality."""
    from mgs import scene

    fit = scene.fit_gaussians

    def short(gaussians, cameras, targets, train, *rest, **how):
        few = train.model_copy(update={"passes": min(train.passes, 2)})
        return fit(gaussians, cameras, targets, few, *rest, **how)

    monkeypatch.setattr(scene, "fit_gaussians", short)


@pytest.fixture
def ellipsoids(monkeypatch):
    """Studies render nothing: their rocks are ellipsoids."""
    import synthetic

    monkeypatch.setattr("studies.frame.case.make_dataset", synthetic.make_dataset)
