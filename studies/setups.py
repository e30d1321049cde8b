"""Policies compared in set-ups where choosing matters: few seeds, limited reach, mixed distances.

Every policy chooses until the same number of images is taken; one fit of these from the prior is
then judged, so that two policies which take the same views get the same number. Policies that need
no model choose without any fit. Rocks and scenes chose no setting of a policy. A scene is the unit
of every test, because rocks of one scene are not independent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import load_dataset
from mgs.data.frames import Frame
from mgs.evaluation import psnr_over
from mgs.learning import fit_views, learn, surface_information, with_view
from mgs.policy.poses import path_length
from mgs.prior.build import load_prior
from mgs.run.choosing import choose
from mgs.run.inputs import policy_record
from mgs.run.loop import finished, select_views
from mgs.run.policy_file import label, policy_of
from mgs.run.settings import Mission
from mgs.scene import Scene, State
from mgs.splat import ListCache
from studies.case import Case, Rock, Size, test_views_of
from studies.oracle import Oracle
from studies.output import Panel, draw_matrix, table, with_interval
from studies.statistics import holm, interval, permutation_p
from studies.sweep import Cell
from studies.verdict import Row

Found = Mapping[str, Mapping[str, Any]]
"""Results of cells by name."""

POLICIES = (
    "directional-i", "directional-d", "cover", "coverage", "farthest", "uniform", "random",
    "d-optimal", "paper",
)  # fmt: skip

LEADER = "directional-i"
"""Policy whose lead over every other is tested: the default of `mgs nbv`."""

RANDOM, ORACLE = "random", "oracle"

SCORED = tuple(policy for policy in POLICIES if policy != RANDOM)
"""Policies whose scores are compared with what each candidate gains, at the oracle's choices."""

FORETOLD = {
    "spearman": "rank correlation of the score with the gain",
    "regret": "regret of one choice (dB)",
}
"""Keys of `studies.oracle.foretold`."""

MEAN = "mean"
"""Name of the mean over the set-ups, beside their names."""

DRAWS = 5
"""Runs of `random`, averaged."""

JUDGE_PASSES = 20
"""Passes of the fit that is judged: twice the default."""

MEASURES = {
    "test": "test views",
    "test_mask": "inside the rock",
    "pool": "views of the pool not taken",
    "ring": "views of the ring not taken",
}
"""Mean PSNR of each cell, dB, by what it is over."""


@dataclass(frozen=True)
class Setup:
    """Candidates and seeds of a run.

    orbit: values of the scene's orbit. frames: number of poses. seeds: views to start with. every:
    take only the first half of the frames, and one in so many of the others. settings: more of
    `mgs nbv`. survey: poses, depth and prior are those of `mgs survey`, with its noise and drift.
    """

    orbit: Mapping[str, Any]
    frames: int
    seeds: int = 4
    every: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    survey: bool = False


RING = {"kind": "circle", "distances": [1]}
"""Orbit of the paper."""

DOME = {"kind": "hemisphere", "distances": [1]}

SETUPS = {
    "ring": Setup(RING, 48),
    "hemisphere": Setup(DOME, 36),
    "one seed": Setup(DOME, 36, seeds=1),
    "biased arc": Setup(RING, 48, seeds=2, every=6),
    "five nearest": Setup(RING, 48, settings={"nearest": 5}),
    "mixed distances": Setup({"kind": "hemisphere", "distances": [1, 2, 3]}, 36),
}
"""In all but the ring the choice matters more."""

SURVEYED = {"surveyed ring": Setup(RING, 48, survey=True)}
"""Set-ups with the estimated poses, measured depth and prior of `mgs survey`."""


@dataclass(frozen=True)
class SetupSize:
    """Width, height, test views and samples per pixel of the images, and images that a run
    takes, seeds among them. Numbers of frames are those of SETUPS, over `fewer`. gaussians: of the
    prior; None: automatic."""

    width: int = 128
    height: int = 96
    tests: int = 16
    spp: int = 8
    images: int = 12
    fewer: int = 1
    gaussians: int | None = None


def case_of(rock: Rock, setup: Setup, size: SetupSize) -> Case:
    """Dataset and prior."""
    images = Size(size.width, size.height, setup.frames // size.fewer, size.tests, size.spp)
    number = {} if size.gaussians is None else {"gaussians": size.gaussians}
    return Case(rock, images, number | {"seed": 0}).on_orbit(setup.orbit)


def cells_of(
    size: SetupSize,
    rocks: Iterable[Rock],
    policies: Sequence[str],
    setups: Mapping[str, Setup] = SETUPS,
) -> list[Cell]:
    """Cells of every policy in every set-up on every rock, with datasets and priors."""
    cells: dict[str, Cell] = {}
    for rock in rocks:
        ring = case_of(rock, SETUPS["ring"], size)
        for name, setup in setups.items():
            case = case_of(rock, setup, size)
            case, data = case.surveyed(rock.index) if setup.survey else (case, case.cells())
            common = {"seeds": setup.seeds, "budget": size.images - setup.seeds, **setup.settings}
            for policy in policies:
                for draw in range(DRAWS if policy == RANDOM else 1):
                    settings = common | {"policy": policy, "seed": rock.index + 1000 * draw}
                    version = "".join(f"-{d[:8]}" for d in policy_record(policy).values())
                    shown = label(policy)
                    where = f"{name.replace(' ', '-')}-{size.width}x{size.height}"
                    of = f"setup/{rock.name}/{where}/{shown}{version}-{draw}"
                    made = case.with_task(
                        of,
                        f"{__name__}:choose_and_judge",
                        ring=ring.dataset,
                        every=setup.every,
                        settings=settings,
                    )
                    needs = (ring.cells()[0].name, *(cell.name for cell in data))
                    about = {"rock": rock.name, "scene": rock.scene, "setup": name, "policy": shown}
                    last = replace(made[-1], needs=needs, about=about)
                    for cell in (*ring.cells()[:1], *data, last):
                        cells[cell.name] = cell
    return list(cells.values())


def choose_and_judge(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    ring: str,
    every: int | None,
    settings: dict[str, Any],
) -> dict[str, Any]:
    """Task: choose views by a policy, fit all of them from the prior, and judge the model.

    Returns MEASURES, "taken" (indices of the frames in the order taken) and "path" (metres through
    the views taken). The oracle's has "foretold": means of `foretold` over its choices.
    """
    name, seed = settings["policy"], settings["seed"]
    shared, tests, pool, on_ring = shared_scene(root / dataset, root / prior, root / ring, every)
    scene = shared.with_seed(seed)
    mission = Mission(**{k: v for k, v in settings.items() if k not in ("policy", "seed")})
    policy = (
        policy_of(name)
        if name != ORACLE
        else Oracle(test_views_of(shared.dataset), [policy_of(one) for one in SCORED])
    )
    start = _after_seeds if policy.needs_fit else before_any_fit
    state = start(shared, mission.seeds)
    if policy.needs_fit:
        for item in select_views(scene, policy, mission, state):
            state = item if isinstance(item, State) else state
    else:
        unused = np.zeros_like(state.H)  # information about a model that there is not
        while not finished(scene, state, mission):
            view, _ = choose(scene, state, policy, mission)
            state = with_view(scene, state, view, unused)
    train = scene.settings.train.model_copy(update={"passes": JUDGE_PASSES})
    taken = list(state.taken)
    model = fit_views(scene, scene.frames, taken, train=train)[0].gaussians
    others = [i for i in range(len(scene.frames)) if i not in taken]
    on_tests, on_pool = tests(model), pool(model, others)
    mine = dataset == ring  # the poses of the ring, of which some may be taken
    return {
        "test": float(on_tests["psnr"].mean()),
        "test_mask": float(on_tests["psnr_mask"].mean()),
        "pool": float(on_pool["psnr"].mean()),
        "ring": float((on_pool if mine else on_ring(model))["psnr"].mean()),
        "path": path_length(scene.positions([scene.frames[i] for i in taken])),
        "taken": taken,
    } | ({"foretold": _means(policy.tried)} if isinstance(policy, Oracle) else {})


def _means(tried: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Means of `foretold` over choices."""
    return {
        policy: {key: float(np.mean([one[policy][key] for one in tried])) for key in first}
        for policy, first in tried[0].items()
    }


Measure = Callable[..., dict[str, np.ndarray]]
"""(model, indices of frames; default: all) -> as `mgs.evaluation.psnr_over`."""


@lru_cache(maxsize=1)
def shared_scene(
    dataset: Path, prior: Path, ring: Path, every: int | None
) -> tuple[Scene, Measure, Measure, Measure]:
    """Scene of a set-up on one rock, and PSNR over test views, candidates and the ring.

    All policies share them, with the visibility of the surface."""
    data, cache = load_dataset(dataset), ListCache()
    if every is not None:
        half = len(data) // 2
        some = (f for i, f in enumerate(data.frames) if i < half or (i - half) % every == 0)
        data = replace(data, frames=tuple(some))
    _after_seeds.cache_clear()

    def over(frames: Sequence[Frame]) -> Measure:
        of = psnr_over(frames, cache)
        return lambda model, some=range(len(frames)): of(model, some)

    views = test_views_of(data).frames, data.frames, load_dataset(ring).frames
    tests, pool, on_ring = map(over, views)
    return Scene(data, load_prior(prior)), tests, pool, on_ring


@lru_cache(maxsize=1)
def _after_seeds(scene: Scene, seeds: int) -> State:
    """State after the fit to the seeds, the same for every policy."""
    return learn(scene, scene.seeds(seeds))


def before_any_fit(scene: Scene, seeds: int) -> State:
    """State after the seeds, with the Gaussians before training and no information about them."""
    views, nothing = tuple(scene.seeds(seeds)), np.zeros(0)
    start = scene.start(tuple(scene.frames[i] for i in views))
    state = State(scene.frames, views, len(views), start, nothing, nothing)
    surface = surface_information(scene, state, views)
    return replace(state, H=np.zeros_like(surface), surface=surface)


def rows_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
    """A row for each rock, set-up and policy, draws averaged: MEASURES, "path", and KEY_gain, the
    difference from `random`."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for cell in cells:
        if cell.about:
            groups.setdefault(tuple(cell.about.items()), []).append(results[cell.name])
    rows: list[Row] = [
        dict(about) | {key: float(np.mean([one[key] for one in of])) for key in (*MEASURES, "path")}
        for about, of in groups.items()
    ]
    base = {(row["rock"], row["setup"]): row for row in rows if row["policy"] == RANDOM}
    for row in rows:
        against = base[row["rock"], row["setup"]]
        row |= {f"{key}_gain": row[key] - against[key] for key in MEASURES}
    return rows


def foretold_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
    """Rows with FORETOLD for each rock and set-up of the oracle, and each of SCORED."""
    return [
        cell.about | {"policy": policy} | numbers
        for cell in cells
        for policy, numbers in results[cell.name].get("foretold", {}).items()
    ]


def by_scene(rows: Sequence[Row], setup: str, policy: str, key: str) -> dict[str, float]:
    """Mean of a key over the rocks of each scene; setup: a name of SETUPS, or MEAN."""
    values: dict[str, list[float]] = {}
    for row in rows:
        if row["policy"] == policy and setup in (row["setup"], MEAN):
            values.setdefault(row["scene"], []).append(row[key])
    return {scene: float(np.mean(of)) for scene, of in values.items()}


def _setups(rows: Sequence[Row]) -> list[str]:
    """Set-ups of the rows, in their order, and MEAN."""
    return [*dict.fromkeys(row["setup"] for row in rows), MEAN]


def _policies(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["policy"] for row in rows))


def leads_of(rows: Sequence[Row], leader: str, measure: str) -> list[Row]:
    """Lead of a policy over each other in each set-up and in their mean, where both were run.

    Each is a mean over scenes, with a 95 % interval, an exact permutation p, and p by Holm's
    correction over all of them."""
    leads: list[Row] = []
    for setup, other in product(_setups(rows), _policies(rows)):
        if other in (leader, ORACLE):
            continue
        own, theirs = (by_scene(rows, setup, policy, measure) for policy in (leader, other))
        apart = [own[scene] - theirs[scene] for scene in theirs if scene in own]
        if not apart:
            continue
        low, high = interval(apart) or (None, None)
        lead = {"lead": float(np.mean(apart)), "lead_low": low, "lead_high": high}
        about = {"measure": measure, "setup": setup, "policy": other, "scenes": len(apart)}
        leads.append(about | lead | {"p": permutation_p(apart)})
    p_values = [lead["p"] for lead in leads]
    corrected = p_values if None in p_values else holm(p_values)  # None: one scene
    return [lead | {"p_holm": p} for lead, p in zip(leads, corrected, strict=True)]


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw gains over `random` on the test views, means over scenes, as a matrix of policies and
    set-ups. Raises InputError if the file cannot be written."""
    means = []
    for setup, policy in product(_setups(rows), _policies(rows)):
        if policy in (RANDOM, ORACLE):
            continue
        values = list(by_scene(rows, setup, policy, "test_gain").values())
        low, high = interval(values) or (np.nan, np.nan)
        gain = {"gain": float(np.mean(values)), "gain_low": low, "gain_high": high}
        means.append({"setup": setup, "policy": policy} | gain)
    title = "PSNR over random views (dB). Bold: the 95 % interval excludes 0"
    draw_matrix(path, Panel("setup", "gain", "set-up", "", "policy", title=title), means)


def text_of(rows: Sequence[Row], leads: Sequence[Row], predicted: Sequence[Row] = ()) -> str:
    """Tables with a line for each policy and a column for each set-up: gains over `random` by each
    of MEASURES, share of the oracle's gain, the leader's lead, and FORETOLD of `foretold_of`."""
    setups, policies = _setups(rows), _policies(rows)
    matrix = partial(_matrix, setups)

    def means(of: Sequence[Row], key: str, form: str) -> Callable[[str, str], str]:
        def cell(setup: str, policy: str) -> str:
            found = by_scene(of, setup, policy, key)
            return format(np.mean(list(found.values())), form) if found else "–"

        return cell

    tables = [
        matrix(f"{title}, over random (dB)", means(rows, f"{key}_gain", "+.2f"), policies)
        for key, title in MEASURES.items()
    ]
    known = {(lead["setup"], lead["policy"]): lead for lead in leads if lead["measure"] == "test"}
    others = [p for p in policies if p not in (LEADER, ORACLE)]
    tables.append(
        matrix(
            f"{LEADER} over it (dB)",
            lambda s, p: (
                with_interval(known.get((s, p), {}), "lead")
                + (" *" if (known.get((s, p), {}).get("p_holm") or 1) < 0.05 else "")
            ),
            others,
        )
    )
    if ORACLE in policies:
        tables.append(_shares(rows, setups, policies, matrix))
    if predicted:
        tables += [matrix(t, means(predicted, k, ".2f"), SCORED) for k, t in FORETOLD.items()]
    return "\n".join(tables)


def _matrix(
    setups: Sequence[str], title: str, cell: Callable[[str, str], str], policies: Sequence[str]
) -> str:
    """Table of cell(setup, policy), a line for each policy."""
    columns = {title: "policy"} | {setup: setup for setup in setups}
    lines = [{"policy": p} | {setup: cell(setup, p) for setup in setups} for p in policies]
    return table(columns, lines)


def _shares(
    rows: Sequence[Row],
    setups: Sequence[str],
    policies: Sequence[str],
    matrix: Callable[..., str],
) -> str:
    """Share of the oracle's gain over `random`, over the rocks that the oracle was tried on."""
    rocks = {row["rock"] for row in rows if row["policy"] == ORACLE}
    tried = [row for row in rows if row["rock"] in rocks]

    def share(setup: str, policy: str) -> str:
        of, won = (by_scene(tried, setup, p, "test_gain") for p in (policy, ORACLE))
        total = sum(won.values())
        return f"{sum(of.values()) / total:.0%}" if of and total > 0 else "–"

    return matrix("share of the oracle's gain", share, [p for p in policies if p != RANDOM])


if __name__ == "__main__":
    from studies.commands import start

    start("setups")
