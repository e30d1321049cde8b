"""Tables and figures of a reproduction, from the results of its cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mgs.files import write_csv, write_json
from mgs.provenance import versions
from mgs.report.evaluation import evaluate_run
from mgs.report.tables import markdown
from mgs.report.writing import write_report
from mgs.study import reproduce
from mgs.study.output import Panel, draw_panels, table, with_interval, write_table
from mgs.study.reproduce import LEADER, ORACLE, ReproduceSize, Run
from mgs.study.statistics import area, holm, images_to_reach, interval, permutation_p
from mgs.study.sweep import Report, cell_folder, found, run_cells
from mgs.study.verdict import Claim, Row, judged, paired

Found = Mapping[str, Mapping[str, Any]]
"""Results of cells by name."""

Rows = list[Row]

MEASURES = ("test_psnr", "test_psnr_mask")
"""Mean PSNR over the test views, dB: of the full frame, by which policies are judged, and inside
the rock's mask."""

PAPER_TABLE = (("D-Optimal NBV", 54, 25.97, 0.9654), ("Coverage-Greedy", 50, 26.06, 0.9648))
"""Table I of the paper: method, images, PSNR in dB and SSIM over all 100 views of its own rock,
which is not ours."""

TABLE_COLUMNS = {
    "policy": "row",
    "images": "images",
    "test views (dB)": "test.psnr:.2f",
    "SSIM": "test.ssim:.4f",
    "test views, rock (dB)": "test.psnr_mask:.2f",
    "all views (dB)": "all.psnr:.2f",
    "all SSIM": "all.ssim:.4f",
    "held out (dB)": "held_out.psnr:.2f",
    "a choice (s)": "choice_seconds:.2f",
    "run (s)": "seconds:.0f",
    "memory (MB)": "peak_megabytes:.0f",
}


def known_runs(root: Path, runs: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """Results of the runs that are done."""
    results = {run.name: found(root, run.cells()[-1]) for run in runs}
    return {name: result for name, result in results.items() if result is not None}


def table_rows(results: Found, size: ReproduceSize) -> Rows:
    """Table I: a row for each run that is done."""
    rows = []
    for label, run in reproduce.table_runs(size).items():
        if run.name not in results:
            continue
        numbers = results[run.name]
        row: Row = {"row": label, "images": numbers["images"]}
        for views in ("test", "all", "held_out"):
            for metric in ("psnr", "ssim", "psnr_mask", "ssim_mask"):
                row[f"{views}.{metric}"] = numbers[views][metric]
        row |= {key: numbers[key] for key in ("choice_seconds", "seconds", "peak_megabytes")}
        rows.append(row | {"command": run.command()})
    return rows


def table_text(rows: Rows, left: Sequence[str]) -> str:
    """Table I with the paper's rows, and the mean of the draws of `random`. left: rows to come."""
    shown: Rows = [
        {"row": f"the paper's {name}, on its rock", "images": n, "all.psnr": psnr, "all.ssim": ssim}
        for name, n, psnr, ssim in PAPER_TABLE
    ]
    draws = [row for row in rows if row["row"].startswith("random,")]
    for row in rows:
        if row not in draws:
            shown.append(row)
        elif row is draws[0]:
            numbers = [key for key, value in row.items() if isinstance(value, float)]
            mean = {key: float(np.mean([draw[key] for draw in draws])) for key in numbers}
            shown.append(row | mean | {"row": f"random, mean of {len(draws)}"})
    to_come = f"\nNot done yet: {'; '.join(left)}.\n" if left else ""
    return table(TABLE_COLUMNS, shown) + to_come


def by_rock(results: Found, runs: Sequence[Run]) -> Rows:
    """A row for each step of each run, with the MEASURES and the coverage."""
    rows = []
    for run in runs:
        about = {
            "rock": run.rock.index,
            "scene": run.rock.scene,
            "rock_seed": run.rock.seed,
            "pool": run.pool,
            "policy": run.label,
            "draw": run.draw,
            "seeds": run.seeds,
        }
        curves = [results[run.name][key] for key in ("images", *MEASURES, "coverage")]
        for images, psnr, psnr_mask, coverage in zip(*curves, strict=True):
            measured = dict(zip(MEASURES, (psnr, psnr_mask), strict=True))
            rows.append(about | {"images": images} | measured | {"coverage": coverage})
    return rows


def last_rows(results: Found, runs: Sequence[Run]) -> Rows:
    """A row for each run: its last step, and KEY_area, the mean of each curve. Draws of a policy
    are averaged."""
    drawn: dict[tuple[Any, ...], Rows] = {}
    for run in runs:
        row = by_rock(results, [run])[-1] | {"run": run.rock.name}
        for key in MEASURES:
            row[f"{key}_area"] = area(results[run.name]["images"], results[run.name][key])
        drawn.setdefault((run.pool, run.rock.index, run.label, run.seeds), []).append(row)
    measured = [f"{key}{end}" for key in MEASURES for end in ("", "_area")]
    return [
        rows[0] | {key: float(np.mean([row[key] for row in rows])) for key in measured}
        for rows in drawn.values()
    ]


def with_differences(
    rows: Rows, name: str, reference: Row, same: Sequence[str], keys: Sequence[str] = MEASURES
) -> Rows:
    """Rows with KEY_NAME, the difference of each key from the row that has the entries `reference`
    and the same values of `same`; unchanged where there is none."""
    known = {
        tuple(row[key] for key in same): row for row in rows if reference.items() <= row.items()
    }
    made = []
    for row in rows:
        other = known.get(tuple(row[key] for key in same))
        gains = {f"{key}_{name}": row[key] - other[key] for key in keys} if other else {}
        made.append(row | gains)
    return made


def summary(rows: Rows, by: Sequence[str], keys: Sequence[str]) -> Rows:
    """A row for each combination of `by`: number of rocks, and KEY, KEY_low, KEY_high, the mean of
    each key over rocks and its 95 % interval (None for one rock)."""
    groups: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in by), []).append(row)
    made = []
    for values, group in groups.items():
        one: Row = dict(zip(by, values, strict=True)) | {"rocks": len(group)}
        for key in keys:
            if key in group[0]:
                numbers = [row[key] for row in group]
                low, high = interval(numbers) or (None, None)
                ends = {f"{key}_low": low, f"{key}_high": high}
                one |= {key: float(np.mean(numbers)), **ends}
        made.append(one)
    return made


def _keys(*names: str) -> list[str]:
    """MEASURES, and each with the name of a difference."""
    return [f"{key}{end}" for end in ("", *(f"_{name}" for name in names)) for key in MEASURES]


def statistics_of(results: Found, runs: Sequence[Run]) -> dict[str, Any]:
    """Area under the curve by policy, and tests of pairs of policies, for each of MEASURES.

    "area": mean over rocks; "area_by_rock"; "reach": mean number of images to what `random` ends
    with, and on how many rocks it is reached; "pairs": judged claims (`mgs.study.verdict`) that the
    first policy is ahead, with the differences by rock, the p-values, and the same "elsewhere", on
    scenes not in DEVELOPED_ON.
    """
    rows = last_rows(results, runs)
    elsewhere = [row for row in rows if row["scene"] not in reproduce.DEVELOPED_ON]
    statistics: dict[str, Any] = {}
    for key in MEASURES:
        areas: dict[str, list[float]] = {}
        for row in rows:
            areas.setdefault(row["policy"], []).append(row[f"{key}_area"])
        pairs: Rows = []
        for policy, other in reproduce.pairs_of(areas):
            effects = paired(f"{key}_area", {"policy": policy}, {"policy": other})
            claim = Claim(f"{policy} is ahead of {other}.", effects, "dB", "above", 0.0, "rock")
            there = _ahead(claim, elsewhere) if elsewhere else None
            pair = {"policy": policy, "other": other, **_ahead(claim, rows), "elsewhere": there}
            pairs.append(pair | {"p": permutation_p(pair["differences"])})
        p_values = [pair["p"] for pair in pairs]
        corrected = p_values if None in p_values else holm(p_values)  # None: one rock
        pairs = [pair | {"p_holm": p} for pair, p in zip(pairs, corrected, strict=True)]
        means = {policy: float(np.mean(values)) for policy, values in areas.items()}
        reach = _reach(results, runs, key)
        statistics[key] = {"area": means, "area_by_rock": areas, "reach": reach, "pairs": pairs}
    return statistics


def _ahead(claim: Claim, rows: Rows) -> Row:
    """A judged claim with its differences by rock, and on how many of them the first is ahead."""
    differences = claim.effects(rows)
    ahead = sum(difference > 0 for difference in differences)
    return judged(claim, rows) | {"ahead": ahead, "differences": differences}


def _reach(results: Found, runs: Sequence[Run], key: str) -> dict[str, Row]:
    levels = {run.rock.index: results[run.name][key][-1] for run in runs if run.label == "random"}
    needed: dict[str, list[float]] = {}
    for run in runs:
        if run.rock.index in levels:
            own, curve = needed.setdefault(run.label, []), results[run.name]
            images = images_to_reach(curve["images"], curve[key], levels[run.rock.index])
            own += [] if images is None else [images]
    return {
        policy: {"images": float(np.mean(own)) if own else None, "rocks": len(own)}
        for policy, own in needed.items()
    }


def statistics_text(statistics: Mapping[str, Any]) -> str:
    """Two tables: areas of each policy, and the tests of pairs."""
    measures = list(zip(MEASURES, ("full frame", "rock"), strict=True))
    areas = [
        {"policy": policy}
        | {key: statistics[key]["area"][policy] for key in MEASURES}
        | {f"{key}_reach": _reach_text(statistics[key], policy) for key in MEASURES}
        for policy in statistics[MEASURES[0]]["area"]
    ]
    columns = {
        "policy": "policy",
        **{f"area, {what} (dB)": f"{key}:.2f" for key, what in measures},
        "images for what random ends with": "test_psnr_reach",
        "the same, rock": "test_psnr_mask_reach",
    }
    pairs = [pair | {"of": what} for key, what in measures for pair in statistics[key]["pairs"]]
    pair_columns: dict[str, str | Callable[[Row], str]] = {
        "pair": lambda pair: f"{pair['policy']} − {pair['other']}",
        "PSNR of": "of",
        "difference of areas (dB)": _difference,
        "is ahead": "verdict",
        "p": "p:.2g",
        "p, Holm": "p_holm:.2g",
        "on scenes that chose no setting": lambda pair: (
            _difference(pair["elsewhere"]) if pair["elsewhere"] else "–"
        ),
    }
    return f"{table(columns, areas)}\n{table(pair_columns, pairs)}"


def _difference(pair: Row) -> str:
    """Difference, its interval, and on how many rocks the first policy is ahead."""
    low, high = pair["interval"] or (None, None)
    text = with_interval({"d": pair["effect"], "d_low": low, "d_high": high}, "d")
    return f"{text}, {pair['ahead']} of {pair['runs']}"


def _reach_text(of: Mapping[str, Any], policy: str) -> str:
    reached = of["reach"].get(policy)
    if reached is None or reached["images"] is None:
        return "–"
    rocks = len(of["area_by_rock"][policy])
    some = f" ({reached['rocks']} of {rocks} rocks)" if reached["rocks"] < rocks else ""
    return f"{reached['images']:.1f}{some}"


def largest_gap(taken: Sequence[int], frames: int) -> float:
    """Largest angle between neighbours among the frames taken of an evenly spaced ring."""
    turned = np.sort(taken)
    return float(np.diff(turned, append=turned[0] + frames).max() * 360 / frames)


SEED_COLUMNS: dict[str, str | Callable[[Row], str]] = {
    "policy": "policy",
    "seeds": "seeds",
    "they see (%)": lambda row: f"{100 * row['first_coverage']:.1f}",
    "largest gap (most), degrees": lambda row: f"{row['gap']:.0f} ({row['gap_max']:.0f})",
    "test views (dB)": "test_psnr:.2f",
    "over four seeds (dB)": lambda row: with_interval(row, "test_psnr_over_four"),
    "rock (dB)": lambda row: with_interval(row, "test_psnr_mask_over_four"),
}


def seed_rows(results: Found, runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """A row for each policy and number of seeds, and the rows by rock: the last model, its
    difference from four seeds, coverage of the seeds, and `largest_gap` (mean, most)."""
    rows = with_differences(
        last_rows(results, runs), "over_four", {"seeds": reproduce.SEEDS}, ("policy", "rock")
    )
    for row, run in zip(rows, runs, strict=True):
        numbers = results[run.name]
        row |= {"first_coverage": numbers["coverage"][0]}
        row |= {"gap": largest_gap(numbers["taken"], run.size.images.frames)}
    keys = [*_keys("over_four"), "first_coverage", "gap"]
    means = summary(rows, ("policy", "seeds", "images"), keys)
    for mean in means:
        alike = [r for r in rows if (r["policy"], r["seeds"]) == (mean["policy"], mean["seeds"])]
        mean["gap_max"] = max(row["gap"] for row in alike)
    return means, rows


def pool_rows(results: Found, runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """A row for each pool and policy, and the rows by rock: the last model, its difference from
    `random` and by how much LEADER is ahead of it, there and in the area under the curve; KEY_share
    of what the oracle gains over `random`, None without an oracle or a gain."""
    rows = last_rows(results, runs)
    rows = with_differences(rows, "over_random", {"policy": "random"}, ("pool", "rock"))
    every = _keys("area")
    rows = with_differences(rows, "over_leader", {"policy": LEADER}, ("pool", "rock"), every)
    for row in rows:
        if row["policy"] != LEADER and f"{every[0]}_over_leader" in row:
            row |= {f"{key}_led": -row[f"{key}_over_leader"] for key in every}
    led = [f"{key}_led" for key in every]
    means = summary(rows, ("pool", "policy"), [*_keys("over_random"), *led])
    oracle = {mean["pool"]: mean for mean in means if mean["policy"] == ORACLE}
    for mean in means:
        for key in MEASURES:
            won = oracle.get(mean["pool"], {}).get(f"{key}_over_random", 0)
            mean[f"{key}_share"] = mean[f"{key}_over_random"] / won if won > 0 else None
    return means, rows


def pools_text(rows: Rows) -> str:
    """Tables with a line for each policy and a column for each pool."""
    tables = [matrix(rows, "test views (dB)", lambda row: f"{row['test_psnr']:.2f}")]
    for title, key in (
        (f"{LEADER} over it (dB)", "test_psnr_led"),
        ("inside the rock (dB)", "test_psnr_mask_led"),
        ("over the whole curve (dB)", "test_psnr_area_led"),
    ):
        tables.append(matrix(rows, title, partial(with_interval, key=key)))
    if any(row["test_psnr_share"] is not None for row in rows):
        tables.append(matrix(rows, "share of the oracle's", _share))
    return "\n".join(tables)


def _share(row: Row) -> str:
    return "–" if row["test_psnr_share"] is None else f"{row['test_psnr_share']:.0%}"


def matrix(rows: Rows, title: str, cell: Callable[[Row], str]) -> str:
    """Table of the rows of pools, with a line for each policy and a column for each pool."""
    pools, policies = (list(dict.fromkeys(row[key] for row in rows)) for key in ("pool", "policy"))
    cells = {(row["policy"], row["pool"]): cell(row) for row in rows}
    lines = [[policy, *(cells.get((policy, pool), "–") for pool in pools)] for policy in policies]
    return markdown([title, *pools], lines)


@dataclass(frozen=True)
class Work:
    """Inputs of a result: the study's folder `root`, the results of cells, the size, the number of
    rocks, and the command."""

    root: Path
    results: Found
    size: ReproduceSize
    count: int
    command: str

    @property
    def out(self) -> Path:
        """Folder for the files."""
        return self.root / "results"

    def write(
        self, name: str, rows: Rows, text: str, each: Rows, panels: Sequence[Panel], drawn: Rows
    ) -> list[Path]:
        """Write NAME.csv, .json and .md of rows, NAME_by_rock.csv of the rows `each`, and NAME.png
        of the rows `drawn`."""
        draw_panels(self.out / f"{name}.png", panels, drawn)
        by_rock = write_csv(self.out / f"{name}_by_rock.csv", each)
        written = write_table(self.out, name, rows, text, self.command, rocks=self.count)
        return [*written, by_rock, self.out / f"{name}.png"]


def write_table1(work: Work) -> list[Path]:
    """table1.csv, .json and .md of the runs that are done."""
    rows = table_rows(work.results, work.size)
    done = {row["row"] for row in rows}
    left = [label for label in reproduce.table_runs(work.size) if label not in done]
    return write_table(work.out, "table1", rows, table_text(rows, left), work.command, left=left)


def write_figures(work: Work) -> list[Path]:
    """Report on some runs of Table I, as `mgs report` draws it."""
    needed = reproduce.RESULTS["figures"].runs(work.size, work.count)
    runs = [cell_folder(work.root, run.name) / "run" for run in needed]
    for run in runs:
        evaluate_run(run)  # draws; the metrics are there already
    return write_report(work.out / "figures", runs)


def write_curves(work: Work) -> list[Path]:
    """curves.csv, .json, .md and .png; curves_by_rock.csv; statistics.json."""
    runs = reproduce.curve_runs(work.size, work.count)
    rows, statistics = by_rock(work.results, runs), statistics_of(work.results, runs)
    over = with_differences(rows, "over_uniform", {"policy": "uniform"}, ("rock", "images"))
    about = {"command": work.command, "versions": versions(), "rocks": work.count}
    write_json(work.out / "statistics.json", about | statistics)
    label, key = "PSNR on the test views (dB)", "test_psnr_over_uniform"
    panels = (
        Panel("images", "test_psnr", "images", label, "policy"),
        Panel("images", key, "images", "difference from uniform (dB)", "policy"),
    )
    means = summary(over, ("policy", "images"), _keys("over_uniform"))
    written = work.write("curves", means, statistics_text(statistics), rows, panels, over)
    return [*written, work.out / "statistics.json"]


def write_seeds(work: Work) -> list[Path]:
    """seeds.csv, .json, .md and .png; seeds_by_rock.csv."""
    runs = reproduce.seed_runs(work.size, work.count)
    means, rows = seed_rows(work.results, runs)
    label = "PSNR over four seeds (dB)"
    panels = (Panel("seeds", "test_psnr_over_four", "seed views", label, "policy"),)
    each = by_rock(work.results, runs)
    return work.write("seeds", means, table(SEED_COLUMNS, means), each, panels, rows)


def write_pools(work: Work) -> list[Path]:
    """pools.csv, .json, .md and .png; pools_by_rock.csv; with the oracle where it is done."""
    oracle = reproduce.oracle_runs(work.size, work.count)
    known = dict(work.results) | known_runs(work.root, oracle)
    runs = reproduce.pool_runs(work.size, work.count)
    runs += oracle if all(run.name in known for run in oracle) else []
    means, rows = pool_rows(known, runs)
    label = "PSNR on the test views, over random (dB)"
    panels = (Panel("pool", "test_psnr_over_random", "pool", label, "policy"),)
    others = [row for row in rows if row["policy"] != "random"]
    return work.write("pools", means, pools_text(means), by_rock(known, runs), panels, others)


WRITERS: dict[str, Callable[[Work], list[Path]]] = {
    "table1": write_table1,
    "figures": write_figures,
    "curves": write_curves,
    "seeds": write_seeds,
    "pools": write_pools,
    "oracle": write_pools,
}
"""Writers of results, which return the files written."""


def make(
    out: Path,
    name: str,
    preset: str,
    size: ReproduceSize,
    count: int,
    report: Report,
    workers: int = 1,
    scheduler: str | None = None,
) -> list[Path]:
    """Do the cells of a result over so many rocks and write it into OUT/results; returns the files.
    Table I is written anew before each cell, from the runs that are done."""
    result = reproduce.RESULTS[name]
    command = f"mgs reproduce --scale {preset} --only {name}"
    command += f" --rocks {count}" if result.count(size) > 1 else ""
    if name in ("curves", "pools"):
        command += "".join(f" --policy {_from_here(policy)}" for policy in size.own_policies)
    if result.rocks:
        command += "".join(f" --mesh {rock.mesh.name}" for rock in size.meshes if rock.mesh)
    elif size.table.batch > 1:
        command += f" --batch {size.table.batch}"

    def tell(cell: str, done: int, total: int) -> None:
        if name == "table1" and (so_far := known_runs(out, result.runs(size, count))):
            write_table1(Work(out, so_far, size, count, command))
        report(f"{name} {cell}", done, total)

    cells = result.cells(size, count)
    results = run_cells(out, cells, tell, workers=workers, scheduler=scheduler)
    return WRITERS[name](Work(out, results, size, count, command))


def _from_here(policy: str) -> str:
    """A policy, its file as a path from the current folder where it lies below it."""
    path, here = Path(policy), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else path.name
