"""What the cells of all studies begin with: a dataset and a prior, each made once and whole after
an interruption."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mgs.data.dataset import Dataset, load_dataset
from mgs.errors import InputError
from mgs.files import atomic_folder
from mgs.prior.build import Prior, build_prior, load_prior, save_prior
from mgs.prior.settings import PriorSettings

if TYPE_CHECKING:
    from mgs.synth.rendering import RenderPreset
    from mgs.synth.scene_file import SceneFile


def made_dataset(
    folder: Path,
    scene: str | SceneFile,
    preset: RenderPreset,
    seed: int = 0,
    test_views: int = 0,
    mesh: str | None = None,
) -> Dataset:
    """The dataset of a scene, as `mgs synth-orbit` renders it: read where it is there, else
    rendered. Raises InputError as `mgs.synth.rendering.synthesise` and
    `mgs.data.dataset.load_dataset`."""
    from mgs.synth.rendering import synthesise  # which needs a variant of Mitsuba

    if not (folder / "transforms.json").is_file():
        synthesise(folder, scene, preset, seed, mesh, test_views=test_views)
    return load_dataset(folder)


def made_prior(folder: Path, dataset: Path, **settings: Any) -> Prior:
    """The prior of a dataset: read where it is there, else built. settings: of
    `mgs.prior.settings.PriorSettings`. Raises InputError as `mgs.prior.build.build_prior` and
    `load_prior`."""
    if not (folder / "prior.json").is_file():  # which is written last
        shutil.rmtree(folder, ignore_errors=True)
        prior, _ = build_prior(load_dataset(dataset), PriorSettings(**settings))
        with atomic_folder(folder) as unfinished:
            save_prior(unfinished, prior)
    return load_prior(folder)


def test_views_of(dataset: Dataset) -> Dataset:
    """Its test views. Raises InputError where it has none."""
    tests = dataset.test_views()
    if tests is None:
        raise InputError(
            f"{dataset.root}: has no test views, by which models are judged; make them with `--test-views`"
        )
    return tests
