"""Cases: a rock at one size with one prior, and what studies do with it.

A case names the cells that render its dataset and build its prior. The functions of (root, out,
...) are tasks of `studies.frame.sweep.Cell`; `dataset` and `prior` are folders below the study's
folder, or absolute. All tasks continue after an interruption.
"""

import shutil
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import mgs
from mgs.files import atomic_folder
from mgs.resources import scene_path
from mgs.run.inputs import file_digest
from studies.frame.program import Options, at_least
from studies.frame.statistics import MOST_ROCKS, Row
from studies.frame.sweep import CELLS, Cell

MESH_SCENE = "boulder"
"""Scene whose ground, light and orbits a mesh gets."""


@dataclass(frozen=True)
class Rock:
    """A scene and the seed of its rock, or a mesh file in MESH_SCENE.

    index: place among the rocks of a study, and seed of its runs. file, digest: a scene or mesh
    of the options and its hash; `scene` is then its name.
    """

    scene: str
    seed: int = 0
    index: int = 0
    file: Path | None = None
    digest: str = ""

    @property
    def mesh(self) -> Path | None:
        """Mesh file; None: a rock of the scene."""
        return self.file if self.file and self.file.suffix != ".toml" else None

    @property
    def scene_file(self) -> str:
        """Name or path of the scene file, of a mesh that of MESH_SCENE."""
        return MESH_SCENE if self.mesh else str(self.file or self.scene)

    @property
    def name(self) -> str:
        """Folder name."""
        parts = self.scene, self.digest[:8], "" if self.mesh else str(self.seed)
        return "-".join(filter(None, parts))


_SEEDS = {
    "boulder": (11, 12),
    "contact-binary": (12, 14),
    "low-sun": (11, 12),
    "pebbles": (11, 12),
    "strata": (12,),
    "horseshoe": (11,),
    "obsidian": (12,),
    "half-banded": (11,),
}

FRESH = tuple(
    Rock(scene, seed, index)
    for index, (scene, seed) in enumerate(
        (scene, seeds[k]) for k in range(2) for scene, seeds in _SEEDS.items() if k < len(seeds)
    )
)
"""Rocks that chose no setting: of each scene the first seeds from 11 on with which the rock is
wholly in every view, one of each scene first. Three scenes are new with them."""

TRAINING = tuple(
    Rock(scene, seed, index)
    for index, (scene, seed) in enumerate(
        (
            *(("boulder", 1), ("strata", 1), ("obsidian", 2)),
            *(("pebbles", 2), ("low-sun", 2), ("contact-binary", 1)),
        )
    )
)
"""Rocks on which settings are chosen."""

ROCKS: Options = {
    "--rocks": {"type": at_least(1), "help": "Number of rocks."},
    "--training": {
        "action": "store_true",
        "help": "The rocks on which settings are chosen, in place of those that judge.",
    },
    "--mesh": {
        "action": "append",
        "default": [],
        "type": Path,
        "help": "A rock of your own in place of the procedural ones; repeatable.",
    },
    "--scene": {
        "action": "append",
        "default": [],
        "help": "Three rocks of a scene (its name, or a .toml file) in place of them; repeatable.",
    },
}

SCENE_SEEDS = (11, 12, 13)
"""Rocks of a scene of the options."""


def rocks_of(options: Namespace, count: int) -> tuple[Rock, ...]:
    """Rocks of the options --rocks, --training, --mesh and --scene; `count` of FRESH by default.

    Raises InputError if there are fewer, two files have one name, or a file cannot be read or is
    one too many.
    """
    own: list[tuple[str, Path, Sequence[int]]]
    own = [("--mesh", mesh, [0]) for mesh in options.mesh]
    own += [("--scene", scene_path(scene), SCENE_SEEDS) for scene in options.scene]
    if len(own) > MOST_ROCKS:
        raise mgs.InputError(
            f"--mesh, --scene: {len(own)} files; differences are tested over {MOST_ROCKS} at "
            "most, leave some out"
        )
    rocks: list[Rock] = []
    for option, path, seeds in own:
        if path.stem in [rock.scene for rock in rocks]:
            raise mgs.InputError(f"{option} {path}: {NAMESAKE}")
        for seed in seeds:
            about = seed, len(rocks), path.resolve(), file_digest(path)
            rocks.append(Rock(path.stem, *about))
    these: Sequence[Rock] = rocks or (TRAINING if options.training else FRESH)
    asked = options.rocks or len(rocks) or (len(these) if options.training else count)
    if asked > len(these):
        raise mgs.InputError(f"--rocks {asked}: there are 1 to {len(these)}")
    return tuple(these[:asked])


NAMESAKE = "there is one of this name already; leave it out, or rename its file"


@dataclass(frozen=True)
class Size:
    """Width and height of images in pixels, numbers of frames and test views, samples per pixel."""

    width: int
    height: int
    frames: int
    tests: int
    spp: int = 8


@dataclass(frozen=True)
class Case:
    """A rock at one size, with the settings of its prior (`PriorSettings`).

    given: a dataset that exists already, in place of the rock's. changes: values in place of the
    scene file's, by section and key. label: folder name in place of the rock's.
    """

    rock: Rock
    size: Size
    settings: Mapping[str, Any] = field(default_factory=dict)
    given: Path | None = None
    changes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    label: str = ""

    @property
    def name(self) -> str:
        """Name of the rock at its size, for folders."""
        label = self.label or self.rock.name
        size = self.size
        return label if self.given else f"{label}/{size.frames}x{size.width}x{size.height}"

    @property
    def dataset(self) -> str:
        return str(self.given) if self.given else f"{CELLS}/dataset/{self.name}/dataset"

    @property
    def prior(self) -> str:
        return f"{CELLS}/{self.prior_name}/prior"

    @property
    def prior_name(self) -> str:
        values = (f"{v:g}" if isinstance(v, float) else str(v) for v in self.settings.values())
        return "-".join([f"prior/{self.name}", *values])

    @property
    def folders(self) -> dict[str, str]:
        """The arguments `dataset` and `prior` of tasks."""
        return {"dataset": self.dataset, "prior": self.prior}

    def on_orbit(self, orbit: Mapping[str, Any]) -> "Case":
        """Case with values of the orbit's section, and a folder named after them."""
        kind = "-".join([orbit["kind"], *map(str, orbit.get("distances", ()))])
        return replace(self, changes={"orbit": dict(orbit)}, label=f"{self.rock.name}/{kind}")

    def cells(self) -> list[Cell]:
        """Cells that make the dataset and the prior."""
        cells = []
        if not self.given:
            rock = self.rock
            arguments = {
                "scene": rock.scene_file,
                "seed": rock.seed,
                "changes": self.changes,
                "size": asdict(self.size),
                "mesh": str(rock.mesh) if rock.mesh else None,
            }
            cells.append(Cell(f"dataset/{self.name}", f"{__name__}:make_dataset", arguments))
        arguments = {"dataset": self.dataset, **self.settings}
        needs = tuple(cell.name for cell in cells)
        return [*cells, Cell(self.prior_name, f"{__name__}:make_prior", arguments, needs)]

    def surveyed(self, seed: int) -> "tuple[Case, list[Cell]]":
        """Case of a survey of this dataset, and the cells of the dataset, survey and prior."""
        label = f"{self.name}-survey"
        task, arguments = f"{__name__}:make_survey", {"dataset": self.dataset, "seed": seed}
        first = self.cells()[:-1]
        flown = Cell(f"survey/{label}", task, arguments, tuple(cell.name for cell in first))
        given = Path(CELLS) / flown.name / "survey"
        case = replace(self, label=label, given=given)
        prior = replace(case.cells()[-1], needs=(flown.name,))
        return case, [*first, flown, prior]

    def with_task(
        self,
        name: str,
        task: str,
        alone: bool = False,
        about: Row | None = None,
        made: Sequence[Cell] | None = None,
        **arguments: Any,
    ) -> list[Cell]:
        """The cells above, or those in `made`, and last a cell of a task that gets the folders and
        needs them all. about: columns of its rows after the rock's; None: it has no rows."""
        made = self.cells() if made is None else made
        needs = tuple(dict.fromkeys(cell.name for cell in made))
        rock = {"rock": self.rock.name, "scene": self.rock.scene}
        columns = {} if about is None else rock | about
        return [*made, Cell(name, task, {**self.folders, **arguments}, needs, alone, columns)]


def make_dataset(
    root: Path,
    out: Path,
    scene: str,
    seed: int,
    size: dict[str, int],
    changes: dict[str, dict[str, Any]] | None = None,
    mesh: str | None = None,
) -> dict[str, Any]:
    """Render the dataset of a `Case` into OUT/dataset, as `mgs synth-orbit` does."""
    from mgs.synth.rendering import RenderPreset, synth_orbit  # needs a variant of Mitsuba
    from mgs.synth.scene_file import SceneFile, load_scene_file

    folder = out / "dataset"
    images = RenderPreset(size["width"], size["height"], size["frames"], size["spp"])
    if not (folder / "transforms.json").is_file():
        sections = load_scene_file(scene).model_dump()
        for section, values in (changes or {}).items():
            sections[section] |= values
        changed = SceneFile.model_validate(sections)
        synth_orbit(folder, changed, images, seed, mesh, test_views=size["tests"])
    return {"frames": len(mgs.load_dataset(folder))}


def make_survey(root: Path, out: Path, dataset: str, seed: int) -> dict[str, Any]:
    """Survey a dataset into OUT/survey, as `mgs survey` does. Returns the rms errors of the poses,
    metres and degrees."""
    from mgs.survey.flight import SurveySettings, fly, save_survey

    folder, data = out / "survey", mgs.load_dataset(root / dataset)
    settings = SurveySettings(seed=seed)
    shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed
    with atomic_folder(folder) as unfinished:
        numbers = save_survey(unfinished, data, fly(data, settings), settings)
    error = numbers["error"]["optimised"]
    return {key: error[key] for key in ("ate_rms", "rotation_rms")}


def make_prior(root: Path, out: Path, dataset: str, **settings: Any) -> dict[str, Any]:
    """Build a prior into OUT/prior. settings: of `PriorSettings`."""
    folder = out / "prior"
    if not (folder / "prior.json").is_file():  # written last
        shutil.rmtree(folder, ignore_errors=True)
        built = mgs.build_prior(mgs.load_dataset(root / dataset), mgs.PriorSettings(**settings))
        with atomic_folder(folder) as unfinished:
            mgs.save_prior(unfinished, built)
    prior = mgs.load_prior(folder)
    found = {"gaussians": len(prior.points) + prior.backed, "spacing": prior.spacing}
    kept = ("sampled_area", "resolution")
    return found | {key: prior.numbers[key] for key in kept if key in prior.numbers}


def test_views_of(dataset: mgs.Dataset) -> mgs.Dataset:
    """Test views of a dataset. Raises InputError where it has none."""
    tests = dataset.test_views()
    if tests is None:
        raise mgs.InputError(
            f"{dataset.root}: has no test views, by which models are judged; "
            "make them with `--test-views`"
        )
    return tests


def judge(model: mgs.Gaussians, dataset: mgs.Dataset) -> dict[str, float]:
    """Mean metrics of a model over the test views of a dataset (`mgs.evaluation`)."""
    return dict(
        mgs.evaluate_model(model, (), (), test_frames=test_views_of(dataset).frames)["test"]
    )
