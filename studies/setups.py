"""Policies compared in set-ups where choosing matters: few seeds, limited reach, mixed distances.

Every policy chooses until the same number of images is taken; one fit of these from the prior is
then judged, so that two policies which take the same views get the same number. Policies that need
no model choose without any fit. Rocks and scenes chose no setting of a policy. A scene is the unit
of every test, because rocks of one scene are not independent.
"""

import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.evaluation import psnr_over
from mgs.learning import fit_views, surface_information, with_view
from mgs.policy.poses import path_length
from mgs.run import policy_file
from mgs.run.inputs import policy_record
from mgs.run.loop import finished
from mgs.run.policies import Policy
from mgs.seeds import generator
from studies.frame.case import FRESH, NAMESAKE, ROCKS, Case, Rock, Size, rocks_of, test_views_of
from studies.frame.output import (
    Panel,
    draw_matrix,
    grouped,
    over_scenes,
    table,
    with_interval,
    write_csv,
    write_table,
)
from studies.frame.program import WORKERS, Options, Study, Work, at_least, study_of
from studies.frame.statistics import Row, holm, interval, permutation_p
from studies.frame.sweep import Cell, results_so_far
from studies.policies import Oracle

Results = Mapping[str, Mapping[str, Any]]
"""Results of cells by name."""

BASELINES = tuple(
    f"{Path(__file__).with_name('policies.py')}:{name}"
    for name in ("greedy", "cover_plan", "angle", "near_angle", "medoids")
)
"""Rules that could embarrass the default, from `studies.policies`."""

POLICIES = (
    "directional-i", "directional-d", "cover", "coverage", "farthest", "uniform", "random",
    "d-optimal", "paper", *BASELINES,
)  # fmt: skip

LEADER = "directional-i"
"""Policy whose lead over every other is tested: the default of `mgs nbv`."""

RANDOM, ORACLE = "random", "oracle"

MEAN = "mean"
"""Name of the mean over the set-ups, beside their names."""

ENDS = "worst, median"
"""Name of the column of the leads over every rock in every set-up."""

MEASURES = {
    "test": "test views",
    "test_mask": "inside the rock",
    "spiral": "views of a spiral, 1.25 and 2 times as far",
    "pool": "views of the pool not taken",
}
"""Mean PSNR of each cell, dB, by what it is over."""


@dataclass(frozen=True)
class Setup:
    """Candidates and seeds of a run.

    orbit: values of the scene's orbit. frames: number of poses. seeds: views to start with. every:
    take only the first half of the frames, and one in so many of the others. settings: more of
    `mgs nbv`. survey: poses, depth and prior are those of `mgs survey`, with its noise and drift.
    drawn: the candidates are a random half of the frames, and the seeds are random, in each draw.
    """

    orbit: Mapping[str, Any]
    frames: int
    seeds: int = 4
    every: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    survey: bool = False
    drawn: bool = False


RING = {"kind": "circle", "distances": [1]}
"""Orbit of the paper."""

DOME = {"kind": "hemisphere", "distances": [1]}

SPIRAL = {"kind": "spiral", "distances": [1.25, 2]}
"""Orbit of further test views, at other distances than the dome of the dataset's own."""

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
    """Images, fits and numbers of a comparison.

    width, height, tests, spp: of the images. images: that a run takes, seeds among them. fewer:
    divisor of the numbers of frames of `setups`. gaussians: of the prior; None: automatic. passes:
    of the fit that is judged, as by default. draws: runs of `random`, and of every policy in a
    set-up that is drawn, averaged. count: default number of rocks. rocks: set by the options.
    """

    width: int = 128
    height: int = 96
    tests: int = 16
    spp: int = 8
    images: int = 12
    fewer: int = 1
    gaussians: int | None = None
    passes: int = 10
    draws: int = 5
    setups: Mapping[str, Setup] = field(default_factory=lambda: SETUPS)
    policies: tuple[str, ...] = POLICIES
    count: int = len(FRESH)
    rocks: tuple[Rock, ...] = ()


SIZES = {"quick": SetupSize(), "paper": SetupSize(320, 240, 24, 16)}

CHOICES: Options = {
    "--policy": {
        "action": "append",
        "default": [],
        "help": "A further policy: a name or FILE.py:NAME; repeatable.",
    },
    "--images": {
        "type": at_least(1 + max(setup.seeds for setup in SETUPS.values())),
        "help": f"Images that a run takes, seeds among them. Default: {SetupSize.images}.",
    },
}


def sized(size: SetupSize, options: Namespace) -> SetupSize:
    """Size with the options --rocks, --mesh, --policy and --images.

    Raises InputError as `rocks_of`, and if a policy is unknown or already compared, or two have the
    same name.
    """
    own = getattr(options, "policy", [])
    labels = list(POLICIES)
    for policy in own:
        if policy_file.absolute(policy) in POLICIES:
            raise mgs.InputError(f"--policy {policy}: is compared anyway; leave it out")
        if policy_file.label(policy) in labels:
            raise mgs.InputError(f"--policy {policy}: {NAMESAKE}")
        labels.append(policy_file.label(policy))
        policy_file.policy_of(policy)
    policies = (*size.policies, *map(policy_file.absolute, own))
    images = getattr(options, "images", None) or size.images
    rocks = rocks_of(options, size.count)
    return replace(size, policies=policies, images=images, rocks=rocks)


def case_of(rock: Rock, setup: Setup, size: SetupSize) -> Case:
    """Dataset and prior."""
    images = Size(size.width, size.height, setup.frames // size.fewer, size.tests, size.spp)
    number = {} if size.gaussians is None else {"gaussians": size.gaussians}
    return Case(rock, images, number | {"seed": 0}).on_orbit(setup.orbit)


def spiral_of(rock: Rock, size: SetupSize) -> Case:
    """Dataset of the test views on SPIRAL."""
    return Case(rock, Size(size.width, size.height, size.tests, 0, size.spp)).on_orbit(SPIRAL)


def shown_as(policy: str) -> str:
    label = policy_file.label(policy)
    return label.partition(":")[2] if policy in BASELINES else label


def worded(policy: str) -> str:
    """Name of a policy for tables, with spaces in place of underscores."""
    return policy.replace("_", " ")


def cells_of(
    size: SetupSize,
    policies: Sequence[str] | None = None,
    setups: Mapping[str, Setup] | None = None,
) -> list[Cell]:
    """Cells of every policy in every set-up on every rock, with datasets and priors; policies and
    set-ups are those of the size by default."""
    cells: list[Cell] = []
    pairs = product(size.rocks, (size.setups if setups is None else setups).items())
    for rock, (name, setup) in pairs:
        case = case_of(rock, setup, size)
        case, data = case.surveyed(rock.index) if setup.survey else (case, case.cells())
        spiral = spiral_of(rock, size)
        common = {"seeds": setup.seeds, "budget": size.images - setup.seeds, **setup.settings}
        every_policy = size.policies if policies is None else policies
        for draw, policy in product(range(size.draws), every_policy):
            if draw and policy != RANDOM and not setup.drawn:
                continue
            shown = shown_as(policy)
            version = "".join(f"-{digest[:8]}" for digest in policy_record(policy).values())
            shape = f"{size.images}x{size.width}x{size.height}"
            where = f"{rock.name}/{name.replace(' ', '-')}-{shape}"
            settings = common | {"policy": policy, "seed": rock.index + 1000 * draw}
            cells += case.with_task(
                f"setup/{where}/{shown}{version}-{draw}",
                f"{__name__}:choose_and_judge",
                about={"setup": name, "policy": shown},
                made=[*data, spiral.cells()[0]],
                spiral=spiral.dataset,
                every=setup.every,
                drawn=setup.drawn,
                passes=size.passes,
                settings=settings,
            )
    return cells


def choose_and_judge(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    spiral: str,
    every: int | None,
    settings: dict[str, Any],
    passes: int = SetupSize.passes,
    drawn: bool = False,
) -> dict[str, Any]:
    """Task: choose views by a policy, fit all of them from the prior, and judge the model.

    Returns MEASURES, "taken" (indices of the frames in the order taken) and "path" (metres through
    the views taken).
    """
    name, seed = settings["policy"], settings["seed"]
    draw = seed if drawn else None
    shared, tests, pool = shared_scene(root / dataset, root / prior, every, draw)
    further = views_of(root / spiral)
    scene = shared.with_seed(seed)
    mission = mgs.Mission(**{k: v for k, v in settings.items() if k not in ("policy", "seed")})
    policy = (
        Oracle(test_views_of(shared.dataset)) if name == ORACLE else policy_file.policy_of(name)
    )
    start = _after_seeds if policy.needs_fit else before_any_fit
    count = mission.seeds
    state = start(shared, tuple(range(count) if drawn else shared.seeds(count)))
    state, _ = choose_views(scene, policy, mission, state)
    train = scene.settings.train.model_copy(update={"passes": passes})
    taken = list(state.taken)
    model = fit_views(scene, scene.frames, taken, train=train)[0].gaussians
    others = [i for i in range(len(scene.frames)) if i not in taken]
    on_tests, on_pool = tests(model), pool(model, others)
    return {
        "test": float(on_tests["psnr"].mean()),
        "test_mask": float(on_tests["psnr_mask"].mean()),
        "spiral": float(further(model)["psnr"].mean()),
        "pool": float(on_pool["psnr"].mean()),
        "path": path_length(scene.positions([scene.frames[i] for i in taken])),
        "taken": taken,
    }


def choose_views(
    scene: mgs.Scene, policy: Policy, mission: mgs.Mission, state: mgs.State
) -> tuple[mgs.State, list[float]]:
    """Choose views one by one until the mission is over: the last state, and the CPU seconds of
    each choice. Models are fitted only if the policy needs them."""
    unused = np.zeros_like(state.H)  # information about a model that there is not
    seconds = []
    while not finished(scene, state, mission):
        began = time.process_time()
        view, _ = mgs.choose(scene, state, policy, mission)
        seconds.append(time.process_time() - began)
        if policy.needs_fit:
            state = mgs.learn(scene, [*state.taken, view], state)
        else:
            state = with_view(scene, state, view, unused)
    return state, seconds


Measure = Callable[..., dict[str, np.ndarray]]
"""(model, indices of frames; default: all) -> as `mgs.evaluation.psnr_over`."""


@lru_cache(maxsize=1)
def shared_scene(
    dataset: Path, prior: Path, every: int | None, draw: int | None = None
) -> tuple[mgs.Scene, Measure, Measure]:
    """Scene of a set-up on one rock, and PSNR over test views and candidates.

    All policies share them, with the visibility of the surface. draw: seed of a random half of the
    frames in random order; None: all."""
    data = mgs.load_dataset(dataset)
    if every is not None:
        half = len(data) // 2
        some = (f for i, f in enumerate(data.frames) if i < half or (i - half) % every == 0)
        data = replace(data, frames=tuple(some))
    if draw is not None:
        order = generator(draw, "pool").permutation(len(data))[: len(data) // 2]
        data = replace(data, frames=tuple(data.frames[i] for i in order))
    _after_seeds.cache_clear()
    tests, pool = _measure(test_views_of(data).frames), _measure(data.frames)
    return mgs.Scene(data, mgs.load_prior(prior)), tests, pool


def _measure(frames: Sequence[mgs.Frame]) -> Measure:
    of = psnr_over(frames, mgs.ListCache())
    return lambda model, some=range(len(frames)): of(model, some)


@lru_cache(maxsize=1)
def views_of(dataset: Path) -> Measure:
    """PSNR over all frames of a dataset."""
    return _measure(mgs.load_dataset(dataset).frames)


@lru_cache(maxsize=1)
def _after_seeds(scene: mgs.Scene, seeds: tuple[int, ...]) -> mgs.State:
    """State after the fit to the seeds, the same for every policy."""
    return mgs.learn(scene, seeds)


def before_any_fit(scene: mgs.Scene, views: Sequence[int]) -> mgs.State:
    """State after these seeds, with the Gaussians before training and no information about them."""
    views, nothing = tuple(views), np.zeros(0)
    start = scene.start(tuple(scene.frames[i] for i in views))
    state = mgs.State(scene.frames, views, len(views), start, nothing, nothing)
    surface = surface_information(scene, state, views)
    return replace(state, H=np.zeros_like(surface), surface=surface)


def rows_of(results: Results, cells: Sequence[Cell]) -> list[Row]:
    """A row for each rock, set-up and policy, draws averaged: MEASURES, "path", and KEY_gain, the
    difference from `random`."""
    keys = (*MEASURES, "path")
    every = [dict(cell.about) | dict(results[cell.name]) for cell in cells if cell.about]
    rows: list[Row] = []
    for group in grouped(every, "rock", "scene", "setup", "policy"):
        draws = group.pop("of")
        rows.append(group | {key: float(np.mean([one[key] for one in draws])) for key in keys})
    base = {(row["rock"], row["setup"]): row for row in rows if row["policy"] == RANDOM}
    for row in rows:
        against = base[row["rock"], row["setup"]]
        row |= {f"{key}_gain": row[key] - against[key] for key in MEASURES}
    return rows


def by_scene(rows: Sequence[Row], setup: str, policy: str, key: str) -> dict[str, float]:
    """Mean of a key over the rocks of each scene; setup: a name of SETUPS, or MEAN."""
    of = [r for r in rows if r["policy"] == policy and setup in (r["setup"], MEAN)]
    return over_scenes(of, key)


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
        means.append({"setup": setup, "policy": worded(policy)} | gain)
    title = "PSNR over random views (dB)\nBold: the 95 % interval excludes 0"
    draw_matrix(path, Panel("setup", "gain", "set-up", "", "policy", title=title), means)


def tables(rows: Sequence[Row]) -> str:
    """Tables with a line for each policy and a column for each set-up: the leader's lead, gains
    over `random` by each of MEASURES, and share of the oracle's gain."""
    setups, policies = _setups(rows), _policies(rows)
    rocks = {row["rock"] for row in rows if row["policy"] == ORACLE}
    tried = [row for row in rows if row["rock"] in rocks]
    groups = grouped(rows, "rock", "setup")
    cells = [{row["policy"]: row["test"] for row in group["of"]} for group in groups]
    leads = {(one["setup"], one["policy"]): one for one in leads_of(rows, LEADER, "test")}

    def matrix(
        title: str,
        cell: Callable[[str, str], str],
        policies: Sequence[str],
        across: Sequence[str] = tuple(setups),
    ) -> str:
        columns = {title: "policy"} | {name: name for name in across}
        lines = [{"policy": worded(p)} | {n: cell(n, p) for n in across} for p in policies]
        return table(columns, lines)

    def gain(key: str) -> Callable[[str, str], str]:
        def cell(setup: str, policy: str) -> str:
            values = by_scene(rows, setup, policy, f"{key}_gain")
            return format(np.mean(list(values.values())), "+.2f") if values else "–"

        return cell

    def ahead(setup: str, policy: str) -> str:
        lead = leads.get((setup, policy), {})
        if setup == ENDS:
            apart = [of[LEADER] - of[policy] for of in cells if {LEADER, policy} <= set(of)]
            return f"{np.min(apart):+.2f}, {np.median(apart):+.2f}" if apart else "–"
        if setup != MEAN:
            return format(lead["lead"], "+.2f") if lead else "–"
        return with_interval(lead, "lead") + (" *" if (lead.get("p_holm") or 1) < 0.05 else "")

    def share(setup: str, policy: str) -> str:
        of, won = (by_scene(tried, setup, p, "test_gain") for p in (policy, ORACLE))
        total = sum(won.values())
        return f"{sum(of.values()) / total:.0%}" if of and total > 0 else "–"

    others = [p for p in policies if p not in (LEADER, ORACLE)]
    parts = [matrix(f"{LEADER} over it (dB)", ahead, others, (*setups, ENDS))]
    parts += [
        matrix(f"{title}, over random (dB)", gain(key), policies) for key, title in MEASURES.items()
    ]
    if ORACLE in policies:
        shown = [p for p in policies if p != RANDOM]
        parts.append(matrix("share of the oracle's gain", share, shown))
    return "\n".join(parts)


def write(work: Work, name: str = "setups", cells: Sequence[Cell] | None = None) -> list[Path]:
    """Write NAME.csv, .json, .md, .png and NAME-leads.csv. cells: by default those of set-ups and
    oracle that are done."""
    cells = cells or [*cells_of(work.size), *cells_of(work.size, (ORACLE,))]
    results = results_so_far(work.out, cells)
    done = [cell for cell in cells if cell.name in results]
    rows = rows_of(results, done)
    leads = [lead for key in MEASURES for lead in leads_of(rows, LEADER, key)]
    draw(work.out / f"{name}.png", rows)
    paths = write_table(work, name, rows, tables(rows), rocks=len(work.size.rocks))
    return [*paths, work.out / f"{name}.png", write_csv(work.out / f"{name}-leads.csv", leads)]


STUDY = Study("setups", __doc__, write, SIZES, cells_of, ROCKS | CHOICES | WORKERS, sized)

if __name__ == "__main__":
    study_of("setups")()
