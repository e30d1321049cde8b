"""Cases: a rock at one size with one prior, and what studies do with it.

A case names the cells that render its dataset and build its prior. The functions with the arguments
(root, out, ...) are tasks of `studies.sweep.Cell`; `dataset` and `prior` are folders below the
study's folder, or absolute. All tasks continue after an interruption.
"""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from mgs.data.dataset import Dataset, load_dataset
from mgs.errors import InputError
from mgs.evaluation import evaluate_model
from mgs.files import atomic_folder
from mgs.fit.settings import COLOURS_ALONE
from mgs.gaussians import Gaussians
from mgs.prior.build import build_prior, load_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.reports.evaluation import evaluate_run
from mgs.run.folder import Run, open_run
from mgs.run.nbv import resume_nbv, start_run
from studies.sweep import CELLS, Cell

MESH_SCENE = "boulder"
"""Scene whose ground, light and orbits a mesh gets."""


@dataclass(frozen=True)
class Rock:
    """A scene file and the seed of its rock, or a mesh file and its hash in MESH_SCENE.

    index: place among the rocks of a study, and seed of its runs.
    """

    scene: str
    seed: int = 0
    index: int = 0
    mesh: Path | None = None
    digest: str = ""

    @property
    def name(self) -> str:
        """Folder name."""
        return f"{self.scene}-{self.digest[:8] if self.mesh else self.seed}"


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
        """Folder of the dataset."""
        return str(self.given) if self.given else f"{CELLS}/dataset/{self.name}/dataset"

    @property
    def prior(self) -> str:
        """Folder of the prior."""
        return f"{CELLS}/{self.prior_name}/prior"

    @property
    def prior_name(self) -> str:
        """Name of the prior's cell."""
        values = (f"{v:g}" if isinstance(v, float) else str(v) for v in self.settings.values())
        return "-".join([f"prior/{self.name}", *values])

    @property
    def folders(self) -> dict[str, str]:
        """The arguments `dataset` and `prior` of tasks."""
        return {"dataset": self.dataset, "prior": self.prior}

    def on_orbit(self, orbit: Mapping[str, Any]) -> Case:
        """Case with values of the orbit's section, and a folder named after them."""
        kind = "-".join([orbit["kind"], *map(str, orbit.get("distances", ()))])
        return replace(self, changes={"orbit": dict(orbit)}, label=f"{self.rock.name}/{kind}")

    def cells(self) -> list[Cell]:
        """Cells that make the dataset and the prior."""
        cells = []
        if not self.given:
            rock = self.rock
            arguments = {
                "scene": MESH_SCENE if rock.mesh else rock.scene,
                "seed": rock.seed,
                "changes": self.changes,
                "size": asdict(self.size),
                "mesh": str(rock.mesh) if rock.mesh else None,
            }
            cells.append(Cell(f"dataset/{self.name}", f"{__name__}:make_dataset", arguments))
        arguments = {"dataset": self.dataset, **self.settings}
        needs = tuple(cell.name for cell in cells)
        return [*cells, Cell(self.prior_name, f"{__name__}:make_prior", arguments, needs)]

    def surveyed(self, seed: int) -> tuple[Case, list[Cell]]:
        """Case of a survey of this dataset, and the cells of the dataset, survey and prior."""
        label = f"{self.name}-survey"
        task, arguments = f"{__name__}:make_survey", {"dataset": self.dataset, "seed": seed}
        first = self.cells()[:-1]
        flown = Cell(f"survey/{label}", task, arguments, tuple(cell.name for cell in first))
        given = Path(CELLS) / flown.name / "survey"
        case = replace(self, label=label, given=given)
        prior = replace(case.cells()[-1], needs=(flown.name,))
        return case, [*first, flown, prior]

    def with_task(self, name: str, task: str, alone: bool = False, **arguments: Any) -> list[Cell]:
        """The cells above, and last a cell of a task that gets their folders."""
        cells = self.cells()
        needs = tuple(cell.name for cell in cells)
        return [*cells, Cell(name, task, {**self.folders, **arguments}, needs, alone)]


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
    return {"frames": len(load_dataset(folder))}


def make_survey(root: Path, out: Path, dataset: str, seed: int) -> dict[str, Any]:
    """Survey a dataset into OUT/survey, as `mgs survey` does. Returns the rms errors of the poses,
    metres and degrees."""
    from mgs.survey.flight import SurveySettings, fly
    from mgs.survey.folder import save_survey

    folder, data, settings = out / "survey", load_dataset(root / dataset), SurveySettings(seed=seed)
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
        built = build_prior(load_dataset(root / dataset), PriorSettings(**settings))
        with atomic_folder(folder) as unfinished:
            save_prior(unfinished, built)
    prior = load_prior(folder)
    found = {"gaussians": len(prior.points) + prior.backed, "spacing": prior.spacing}
    kept = ("sampled_area", "resolution")
    return found | {key: prior.numbers[key] for key in kept if key in prior.numbers}


def test_views_of(dataset: Dataset) -> Dataset:
    """Test views of a dataset. Raises InputError where it has none."""
    tests = dataset.test_views()
    if tests is None:
        raise InputError(
            f"{dataset.root}: has no test views, by which models are judged; "
            "make them with `--test-views`"
        )
    return tests


def judge(model: Gaussians, dataset: Dataset) -> dict[str, float]:
    """Mean metrics of a model over the test views of a dataset (`mgs.evaluation`)."""
    return dict(evaluate_model(model, (), (), test_frames=test_views_of(dataset).frames)["test"])


def begun_run(root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]) -> Run:
    """The run in OUT/run, which is started if it is not there. settings: of `mgs nbv`."""
    for leftover in out.glob(".run.*.part"):  # of a process killed before the run began
        shutil.rmtree(leftover)
    run = out / "run"
    if (run / "config.json").is_file():
        return open_run(run)
    train = {**COLOURS_ALONE, **settings.get("train", {})}
    return start_run(root / dataset, run, prior=root / prior, **settings | {"train": train})


def time_policy(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Run a policy in a new process, and measure its last model on all views.

    Returns "images"; "test", "all" and "held_out" of `evaluate`; "seconds" of all steps without
    evaluation; "choice_seconds", the mean of one choice (None without any); "peak_megabytes" of the
    process at the end of the run.
    """
    return in_new_process(_timed, out, root, out, dataset, prior, settings)


def _timed(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    run = begun_run(root, out, dataset, prior, settings)
    steps = resume_nbv(run, policy=settings.get("policy")).state.steps
    peak = peak_megabytes()
    metrics = evaluate_run(run.folder, pictures=False)
    seconds = [step["seconds"] for step in steps]
    choices = [one["score"] for one in seconds[1:]]
    return {key: metrics[key] for key in ("images", "test", "all", "held_out")} | {
        "seconds": sum(one[stage] for one in seconds for stage in one if stage != "evaluate"),
        "choice_seconds": sum(choices) / len(choices) if choices else None,
        "peak_megabytes": peak,
    }


def in_new_process(
    task: Callable[..., dict[str, Any]], out: Path, *arguments: Any
) -> dict[str, Any]:
    """Result of a function called in a new process, whose memory is its own. out: for messages.

    Raises InputError if that process is killed, and what the function raises.
    """
    at_interrupt = (signal.SIGINT, signal.SIG_DFL)  # end silently
    context = get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=signal.signal, initargs=at_interrupt) as pool:
        try:
            return pool.submit(task, *arguments).result()
        except BrokenProcessPool:
            raise InputError(
                f"{out}: its process was killed (is there too little memory?); "
                "give the command again"
            ) from None


def peak_megabytes() -> float:
    """Most memory that this process has held, megabytes. `getrusage` would include the parent's."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1.024e-3
