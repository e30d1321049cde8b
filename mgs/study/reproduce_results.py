"""What the cells of a reproduction say together: rows of numbers, written as CSV, JSON, Markdown
and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.files import atomic_path, write_csv, write_json
from mgs.provenance import versions
from mgs.report.evaluation import evaluate_run
from mgs.report.writing import write_report
from mgs.runtime import processor
from mgs.study import reproduce
from mgs.study.reproduce import ORACLE, Preset, Run
from mgs.study.reproduce_figures import curves_figure, pools_figure, seeds_figure
from mgs.study.reproduce_tables import (
    pools_markdown,
    seeds_markdown,
    statistics_markdown,
    table_markdown,
)
from mgs.study.statistics import area, holm, images_to_reach, interval, permutation_p
from mgs.study.sweep import cell_folder, found

Found = Mapping[str, Mapping[str, Any]]
"""What each cell found, by its name."""

Rows = list[dict[str, Any]]

MEASURES = ("test_psnr", "test_psnr_mask")
"""What statistics are made of: mean PSNR over the test views, dB, of the full frame (the first, by
which policies are judged), and inside the rock's mask."""


def paired(values: Mapping[int, float], others: Mapping[int, float]) -> list[float]:
    """Differences of two policies, for each rock that both have, by the rocks' indices."""
    return [values[k] - others[k] for k in sorted(values.keys() & others.keys())]


def summary(values: Sequence[float]) -> dict[str, float | None]:
    """Mean over rocks, and the 95 % t interval of that mean; None where there is only one rock."""
    low, high = interval(values) or (None, None)
    return {"mean": float(np.mean(values)), "low": low, "high": high}


def flat(key: str, values: Sequence[float]) -> dict[str, float | None]:
    """A `summary` as entries of a row: KEY, KEY_low, KEY_high."""
    return {
        f"{key}{'' if name == 'mean' else '_' + name}": value
        for name, value in summary(values).items()
    }


def ahead(differences: Sequence[float]) -> dict[str, Any]:
    """Differences of two policies over rocks as entries of a row: how many `rocks`, on how many the
    first is `ahead`, and their mean, `flat`."""
    count = sum(difference > 0 for difference in differences)
    return {"rocks": len(differences), "ahead": count, **flat("difference", differences)}


def table_rows(found: Found, preset: Preset) -> Rows:
    """Table I: a row for each run that is done."""
    rows = []
    for label, run in reproduce.table_runs(preset).items():
        if run.name not in found:
            continue
        numbers = found[run.name]
        row: dict[str, Any] = {"row": label, "images": numbers["images"]}
        for views in ("test", "all", "held_out"):
            row |= {
                f"{views}.{name}": numbers[views][name]
                for name in ("psnr", "ssim", "psnr_mask", "ssim_mask")
            }
        row |= {key: numbers[key] for key in ("choice_seconds", "seconds", "peak_megabytes")}
        rows.append(row | {"command": run.command()})
    return rows


def by_rock(found: Found, runs: Sequence[Run]) -> Rows:
    """A row for each step of each run: rock, scene, pool, policy, seeds, images, and the
    MEASURES."""
    rows = []
    for run in runs:
        numbers = found[run.name]
        for k, images in enumerate(numbers["images"]):
            row = {
                "rock": run.rock.index,
                "scene": run.rock.scene,
                "rock_seed": run.rock.seed,
                "pool": run.pool,
            }
            row |= {"policy": run.label, "draw": run.draw, "seeds": run.seeds, "images": images}
            rows.append(row | {key: numbers[key][k] for key in (*MEASURES, "coverage")})
    return rows


def curve_rows(found: Found, runs: Sequence[Run]) -> Rows:
    """A row for each policy and number of images: means over the rocks with intervals, and the
    difference from `uniform`."""
    rows = []
    values = {(run.label, run.rock.index): found[run.name] for run in runs}
    indices = sorted({rock for _, rock in values})
    for policy in dict.fromkeys(run.label for run in runs):
        for k, images in enumerate(values[policy, indices[0]]["images"]):
            row: dict[str, Any] = {"policy": policy, "images": images, "rocks": len(indices)}
            for key in MEASURES:
                own, uniform = (
                    [values[name, rock][key][k] for rock in indices] for name in (policy, "uniform")
                )
                row |= flat(key, own) | flat(
                    f"{key}_over_uniform", np.subtract(own, uniform).tolist()
                )
            rows.append(row)
    return rows


def curve_statistics(found: Found, runs: Sequence[Run]) -> dict[str, Any]:
    """For each of MEASURES the area under PSNR(images) by policy and rock, and the tests of pairs
    (`reproduce.pairs_of`).

    In "reach", how many images a policy needs for what `random` has with all of them, the mean over
    the rocks on which it gets there, and how many these are; without `random` there is none. A pair
    also has, in "elsewhere", its differences on rocks of the scenes that are not in
    `reproduce.DEVELOPED_ON`; None where there are none.
    """
    result: dict[str, Any] = {}
    elsewhere = {run.rock.index for run in runs if run.rock.scene not in reproduce.DEVELOPED_ON}
    for key in MEASURES:
        areas: dict[str, dict[int, float]] = {}
        for run in runs:
            areas.setdefault(run.label, {})[run.rock.index] = area(
                found[run.name]["images"], found[run.name][key]
            )
        pairs: Rows = []
        for policy, other in reproduce.pairs_of(areas):
            differences = paired(areas[policy], areas[other])
            there = paired({k: v for k, v in areas[policy].items() if k in elsewhere}, areas[other])
            pair = {
                "policy": policy,
                "other": other,
                **ahead(differences),
                "differences": differences,
            }
            pair["elsewhere"] = ahead(there) if there else None
            pairs.append(pair | {"p": permutation_p(differences)})
        p_values = [pair["p"] for pair in pairs]
        corrected = (
            p_values if None in p_values else holm(p_values)
        )  # None: of one rock nothing can be claimed
        means = {policy: summary(list(values.values())) for policy, values in areas.items()}
        by_index = {policy: [values[k] for k in sorted(values)] for policy, values in areas.items()}
        pairs = [pair | {"p_holm": p} for pair, p in zip(pairs, corrected, strict=True)]
        result[key] = {
            "area": means,
            "area_by_rock": by_index,
            "reach": _reach(found, runs, key),
            "pairs": pairs,
        }
    return result


def _reach(found: Found, runs: Sequence[Run], key: str) -> dict[str, dict[str, Any]]:
    """By policy, the entry "reach" of `curve_statistics`."""
    levels = {run.rock.index: found[run.name][key][-1] for run in runs if run.label == "random"}
    needed: dict[str, list[float]] = {}
    for run in runs:
        if run.rock.index in levels:
            own, curve = needed.setdefault(run.label, []), found[run.name]
            images = images_to_reach(curve["images"], curve[key], levels[run.rock.index])
            own += [] if images is None else [images]
    return {
        policy: {"images": float(np.mean(own)) if own else None, "rocks": len(own)}
        for policy, own in needed.items()
    }


def largest_gap(taken: Sequence[int], frames: int) -> float:
    """The largest angle, degrees, between neighbours among the frames taken of a ring of so many,
    evenly spaced."""
    turned = np.sort(taken)
    return float(np.diff(turned, append=turned[0] + frames).max() * 360 / frames)


def seed_rows(found: Found, runs: Sequence[Run]) -> Rows:
    """A row for each policy and number of seeds: the model of all images, and its difference from
    that of four seeds; gap,
    gap_max: mean and largest `largest_gap` of the rocks."""
    rows = []
    last = {(run.policy, run.seeds, run.rock.index): found[run.name] for run in runs}
    indices = sorted({rock for *_, rock in last})
    for policy in reproduce.SEED_POLICIES:
        for seeds in reproduce.SEED_COUNTS:
            row: dict[str, Any] = {"policy": policy, "seeds": seeds, "rocks": len(indices)}
            row |= {"images": last[policy, seeds, indices[0]]["images"][-1]}
            row |= {
                "first_coverage": float(
                    np.mean([last[policy, seeds, rock]["coverage"][0] for rock in indices])
                )
            }
            gaps = [
                largest_gap(last[policy, seeds, rock]["taken"], runs[0].size.frames)
                for rock in indices
            ]
            row |= {"gap": float(np.mean(gaps)), "gap_max": max(gaps)}
            for key in MEASURES:
                own, four = (
                    [last[policy, n, rock][key][-1] for rock in indices]
                    for n in (seeds, reproduce.SEEDS)
                )
                row |= flat(key, own) | flat(f"{key}_over_four", np.subtract(own, four).tolist())
            rows.append(row)
    return rows


def by_policy(values: Iterable[tuple[Run, float]]) -> dict[str, dict[int, float]]:
    """The mean of a value of runs over the draws of each policy and rock, by policy and the rock's
    index."""
    drawn: dict[str, dict[int, list[float]]] = {}
    for run, value in values:
        drawn.setdefault(run.label, {}).setdefault(run.rock.index, []).append(value)
    return {
        policy: {rock: float(np.mean(values)) for rock, values in of.items()}
        for policy, of in drawn.items()
    }


def pool_rows(found: Found, runs: Sequence[Run], oracle: Sequence[Run]) -> Rows:
    """A row for each pool and policy: the last model, its difference from the mean of the draws of
    `random`, by how much the LEADER is ahead of it, there and in the area under its curve, and the
    share of what the oracle gains over `random` that it
    gets. None: without an oracle or a leader, or where the oracle gains nothing."""
    rows: Rows = []
    policies = list(dict.fromkeys(run.label for run in [*runs, *oracle]))
    for pool in reproduce.POOLS:
        inside = [run for run in [*runs, *oracle] if run.pool == pool]
        last, areas = {}, {}
        for key in MEASURES:
            curves = [(run, found[run.name]["images"], found[run.name][key]) for run in inside]
            last[key] = by_policy((run, curve[-1]) for run, _, curve in curves)
            areas[key] = by_policy((run, area(images, curve)) for run, images, curve in curves)
        for policy in policies:
            row: dict[str, Any] = {
                "pool": pool,
                "policy": policy,
                "rocks": len(last[MEASURES[0]].get(policy, {})),
            }
            for key in MEASURES:
                mean = {name: last[key].get(name, {}) for name in policies}
                gained = paired(mean[policy], mean["random"])
                won = (
                    float(np.mean(paired(mean[ORACLE], mean["random"]))) if ORACLE in mean else 0.0
                )
                row |= flat(key, [mean[policy][k] for k in sorted(mean[policy])]) | flat(
                    f"{key}_over_random", gained
                )
                led = (
                    paired(mean[reproduce.LEADER], mean[policy]) if reproduce.LEADER in mean else []
                )
                if policy != reproduce.LEADER and led:
                    row |= flat(f"{key}_led", led)
                    row |= flat(
                        f"{key}_area_led", paired(areas[key][reproduce.LEADER], areas[key][policy])
                    )
                row[f"{key}_share"] = float(np.mean(gained)) / won if won > 0 else None
            rows.append(row)
    return rows


def _write(
    out: Path, name: str, rows: Rows, markdown: str, command: str, **more: Any
) -> list[Path]:
    """NAME.csv of rows, NAME.md of a table of them, NAME.json with both; all say by which command
    they were made."""
    csv_rows = [row if "command" in row else row | {"command": command} for row in rows]
    record = (
        {"command": command, "versions": versions()} | more | {"rows": rows, "markdown": markdown}
    )
    write_json(out / f"{name}.json", record)
    with atomic_path(out / f"{name}.md") as temporary:
        temporary.write_text(f"{markdown}\n`{command}`\n", encoding="utf-8")
    return [write_csv(out / f"{name}.csv", csv_rows), out / f"{name}.json", out / f"{name}.md"]


def write_table(
    root: Path, out: Path, found: Found, preset: Preset, count: int, command: str
) -> list[Path]:
    """table1.csv, .json and .md, of the runs that are done; the last two name the others."""
    rows = table_rows(found, preset)
    left = [
        label for label in reproduce.table_runs(preset) if label not in {row["row"] for row in rows}
    ]
    return _write(
        out, "table1", rows, table_markdown(rows, left), command, machine=processor(), left=left
    )


def write_figures(
    root: Path, out: Path, found: Found, preset: Preset, count: int, command: str
) -> list[Path]:
    """What `mgs report` draws, of some runs of Table I."""
    runs = [
        cell_folder(root, run.name) / "run"
        for run in reproduce.RESULTS["figures"].runs(preset, count)
    ]
    for run in runs:
        evaluate_run(run)  # what is measured stays; this draws
    return write_report(out / "figures", runs)


def write_curves(
    root: Path, out: Path, found: Found, preset: Preset, count: int, command: str
) -> list[Path]:
    """curves.csv, .json, .md and .png; curves_by_rock.csv; statistics.json."""
    runs = reproduce.curve_runs(preset, count)
    rows = curve_rows(found, runs)
    statistics = curve_statistics(found, runs)
    write_json(
        out / "statistics.json",
        {"command": command, "versions": versions(), "rocks": count} | statistics,
    )
    each = write_csv(out / "curves_by_rock.csv", by_rock(found, runs))
    curves_figure(out / "curves.png", rows)
    written = _write(out, "curves", rows, statistics_markdown(statistics), command, rocks=count)
    return [*written, each, out / "statistics.json", out / "curves.png"]


def write_seeds(
    root: Path, out: Path, found: Found, preset: Preset, count: int, command: str
) -> list[Path]:
    """seeds.csv, .json, .md and .png; seeds_by_rock.csv."""
    runs = reproduce.seed_runs(preset, count)
    rows = seed_rows(found, runs)
    seeds_figure(out / "seeds.png", rows)
    each = write_csv(out / "seeds_by_rock.csv", by_rock(found, runs))
    return [
        *_write(out, "seeds", rows, seeds_markdown(rows), command, rocks=count),
        each,
        out / "seeds.png",
    ]


def write_pools(
    root: Path, out: Path, found: Found, preset: Preset, count: int, command: str
) -> list[Path]:
    """pools.csv, .json, .md and .png; pools_by_rock.csv. With the oracle, where it is done."""
    runs, oracle = reproduce.pool_runs(preset, count), reproduce.oracle_runs(preset, count)
    known = dict(found) | known_runs(root, oracle)
    done = oracle if all(run.name in known for run in oracle) else []
    rows = pool_rows(known, runs, done)
    pools_figure(out / "pools.png", rows)
    each = write_csv(out / "pools_by_rock.csv", by_rock(known, [*runs, *done]))
    return [
        *_write(out, "pools", rows, pools_markdown(rows), command, rocks=count),
        each,
        out / "pools.png",
    ]


def known_runs(root: Path, runs: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """What the runs found, of those that are done. root: the study's folder."""
    results = {run.name: found(root, run.cells()[-1]) for run in runs}
    return {name: result for name, result in results.items() if result is not None}


WRITERS: dict[str, Callable[[Path, Path, Found, Preset, int, str], list[Path]]] = {
    "table1": write_table,
    "figures": write_figures,
    "curves": write_curves,
    "seeds": write_seeds,
    "pools": write_pools,
    "oracle": write_pools,
}
"""What writes each of `mgs.study.reproduce.RESULTS`: f(study's folder, folder for the results, what
the cells found, preset, number of rocks, the command that makes it) returns the files."""
