"""Tables of docs/benchmarks/*.json.

Most of these files say which command wrote them; demo.json is demo/report/table.json after `make
demo`, and docs/nbv.md has the commands of flights.json.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from mgs.report.tables import markdown_table, table_cell
from table_makers.markdown import made_by, markdown


def demo(rows: list[dict[str, Any]]) -> str:
    """The columns of the demo's table that the README shows."""
    headings = {
        "policy": "policy",
        "test.psnr": "test views",
        "test.psnr_mask": "test views, rock",
        "all.psnr": "all views",
        "held_out.psnr": "held out",
        "held_out.psnr_mask": "held out, rock",
        "coverage": "coverage (%)",
    }
    return _shown(headings, rows)


def _shown(headings: dict[str, str], rows: list[dict[str, Any]]) -> str:
    """The columns of the reports' rows that have a heading; of a dataset without test views, none
    of these."""
    keys = [key for key in headings if key in rows[0]]
    return markdown(
        [headings[key] for key in keys],
        [[table_cell(key, row[key]) for key in keys] for row in rows],
    )


def demo_report(rows: list[dict[str, Any]]) -> str:
    """`table.md` of the demo's report."""
    return markdown_table(rows)


def policies(rows: list[dict[str, Any]]) -> str:
    """More policies on the demo's dataset, compared inside the rock's mask too."""
    headings = {
        "policy": "policy",
        "test.psnr": "test views",
        "test.psnr_mask": "test views, rock only",
        "all.psnr": "all views",
        "all.psnr_mask": "all, rock only",
        "held_out.psnr": "held out",
        "held_out.psnr_mask": "held out, rock only",
        "held_out.ssim_mask": "SSIM, held out, rock only",
    }
    return _shown(headings, rows)


def flights(rows: list[dict[str, Any]]) -> str:
    """Batches and the cost of the way on the demo's dataset."""
    headings = {
        "policy": "policy (folder of the run)",
        "test.psnr": "test views",
        "test.psnr_mask": "test views, rock only",
        "held_out.psnr": "held out",
        "held_out.psnr_mask": "held out, rock only",
        "path": "path (m)",
    }
    return _shown(headings, rows)


def hutchinson(data: dict[str, Any]) -> str:
    """Error of the estimator against the number of probes."""
    mean = [sum(column) / len(column) for column in zip(*data["relative_l2"], strict=True)]
    rows = [
        [
            f"relative L2 error, mean of {len(data['relative_l2'])} seeds",
            *(f"{value:.2f}" for value in mean),
        ]
    ]
    slope = f"Growth with k: exponent {data['slope']:.2f}, expected -0.50."
    return markdown(["probes k", *map(str, data["probes"])], rows) + f"\n{slope}\n" + made_by(data)


def render_settings(data: dict[str, Any]) -> str:
    """PSNR and cost of path-traced frames, plain and denoised."""
    plain, denoised = (
        [row for row in data["settings"] if row["denoise"] is flag] for flag in (False, True)
    )
    rows = [
        [
            str(a["spp"]),
            *(
                text
                for row in (a, b)
                for text in (f"{row['psnr_rock']:.1f} dB", f"{row['cpu_seconds']:.1f}")
            ),
        ]
        for a, b in zip(plain, denoised, strict=True)
    ]
    heading = [
        "samples a pixel",
        "plain: PSNR on the rock",
        "CPU seconds",
        "denoised: PSNR on the rock",
        "CPU seconds",
    ]
    return markdown(heading, rows) + made_by(data)


def lambda_ranking(data: dict[str, Any]) -> str:
    """Rank correlation and choice for some of the lambdas."""
    named = {
        ("default times", power): f"default x 10^{power}" for power in (-8, -4, -2, 0, 1, 2, 4, 8)
    }
    named |= {("single", power): f"10^{power} for all parameters" for power in (-12, -3, 0)}
    named |= {("default times", 0): "default", ("single", 0): "1 for all parameters"}
    found = {(row["kind"], round(math.log10(row["value"]))): row for row in data["rows"]}
    rows = [
        [name, f"{found[key]['spearman']:.2f}", found[key]["chosen"]] for key, name in named.items()
    ]
    return markdown(["lambda", "Spearman with the default", "chosen view"], rows)


def depth_error(data: dict[str, Any]) -> str:
    """Shares of the rock's pixels that are drawn too deep, or not whole."""
    deep, deeper = (f"{100 * limit:.0f} cm" for limit in data["too_deep"])
    heading = [
        "",
        f"expected depth more than {deep} too deep",
        f"more than {deeper}",
        f"opacity below {data['opaque']}",
    ]
    return markdown(
        heading,
        [
            [name, *(f"{100 * share:.1f} %" for share in row)]
            for name, row in data["shares"].items()
        ],
    )


def exposure(data: dict[str, Any]) -> str:
    """Fits to photographs of differing exposure, without gains and with them."""
    rows = []
    for row in data["records"]:
        cells = [f"{row['stops']:g}", "estimated" if row["exposure"] else "none"]
        cells += [f"{row[key]:.2f}" for key in ("psnr_mask_corrected", "psnr_mask")]
        rows.append(
            [*cells, f"{row['gain_rms']:.1%}, {row['gain_worst']:.1%}" if row["exposure"] else ""]
        )
    heading = [
        "stops",
        "gains",
        "exposure fitted to each view, dB",
        "as it is, dB",
        "error of gains, rms and worst",
    ]
    return markdown(heading, rows) + made_by(data)


def photo_memory(data: dict[str, Any]) -> str:
    """Most memory of each station for photographs of 12 megapixels."""
    rows = [
        [f"`{r['station']}`", f"{r['photographs']}", f"{r['gigabytes']:.1f} GB"]
        for r in data["records"]
    ]
    return markdown(["station", "photographs", "most memory"], rows) + made_by(data)


def own_data(data: dict[str, Any]) -> str:
    """Held-out quality from strangers' data, and what is lost against the exact prior."""
    rows = []
    for row in data["records"]:
        cells = [
            f"{row[key]:.2f} ({row[loss]:+.2f})"
            for key, loss in (("psnr", "loss"), ("psnr_rock", "loss_rock"))
        ]
        cells += [
            f"{1e3 * row['accuracy']:.0f} mm",
            f"{row['masks_overlap']:.3f}" if "masks_overlap" in row else "",
        ]
        rows.append([f"{row['kind']}: {row['from']}, masks {row['masks']}", *cells])
    heading = [
        "data, prior from",
        "all pixels, dB",
        "inside the rock, dB",
        "accuracy",
        "overlap of made masks",
    ]
    return markdown(heading, rows) + made_by(data)


def backing(data: dict[str, Any]) -> str:
    """Quality and see-through of fits with and without Gaussians behind the surface."""
    found = {(row["gaussians"], row["passes"], row["backing"]): row for row in data["records"]}
    rows = []
    for n, passes in dict.fromkeys((n, passes) for n, passes, _ in found):
        without, with_ = found[n, passes, 0.0], found[n, passes, 0.5]
        cells = [f"{row['psnr_inside']:.2f} dB" for row in (without, with_)]
        cells += [
            f"{100 * row[key]:.1f} %"
            for key in ("too_deep", "see_through")
            for row in (without, with_)
        ]
        rows.append([f"{n:,}, {passes} passes", *cells])
    heading = [
        "Gaussians",
        "PSNR, all on the surface",
        "a third behind",
        "too deep",
        "a third behind",
        "see-through",
        "a third behind",
    ]
    return markdown(heading, rows) + made_by(data)


def local_density(data: dict[str, Any]) -> str:
    """PSNR inside the rock on test views, by scene, number of Gaussians, and how much the spacing
    follows the texture."""
    rows: list[list[str]] = []
    strengths = list(dict.fromkeys(r["strength"] for r in data["scenes"][0]["records"]))
    for scene in data["scenes"]:
        for n in dict.fromkeys(r["asked"] for r in scene["records"]):
            of = {r["strength"]: r for r in scene["records"] if r["asked"] == n}
            name = f"{_rock(scene['dataset'])}, {n:,} Gaussians, {scene['views']} views"
            gain = of[strengths[-1]]["psnr_inside"] - of[0.0]["psnr_inside"]
            ratio = f"{of[strengths[-1]]['spacings']:.1f}"
            rows.append(
                [
                    name,
                    *(f"{of[strength]['psnr_inside']:.2f}" for strength in strengths),
                    f"{gain:+.2f}",
                    ratio,
                ]
            )
    names = [
        "as `mgs prior` has it" if strength is None else f"strength {strength:g}"
        for strength in strengths
    ]
    heading = ["rock", *names, f"{strengths[-1]:g} over 0, dB", "largest spacing over smallest"]
    return markdown(heading, rows) + made_by(data)


def evidence_kinds(data: dict[str, Any]) -> str:
    """PSNR on test views with all parameters, without a kind, and with those of each Gaussian that
    the evidence pays for."""
    rows = []
    for scene in data["scenes"]:
        of = {r["what"]: r for r in scene["kinds"]}
        name = f"{_rock(scene['dataset'])}, {of['all']['gaussians']:,} Gaussians, {scene['views']} views"
        most = of["all"]["parameters"]
        cells = [
            f"{r['psnr_inside']:.2f}, {r['psnr']:.2f} ({r['parameters'] / most:.0%})"
            for r in of.values()
        ]
        rows.append(
            [
                name,
                *cells,
                ", ".join(f"{share:.0%}" for share in of["by evidence"]["shares"].values()),
            ]
        )
    shares = ", ".join(data["scenes"][0]["kinds"][0]["shares"])
    return markdown(["rock", *of, f"by evidence, Gaussians that learn {shares}"], rows) + made_by(
        data
    )


def evidence_degrees(data: dict[str, Any]) -> str:
    """PSNR inside the rock with colours of degree 1 against degree 0, by the prior of their
    coefficients, and the prior that rules without test views choose."""
    rows = []
    for scene in data["scenes"]:
        zero, *others = scene["degrees"]
        for what in dict.fromkeys(r["what"] for r in others):
            of = [r for r in others if r["what"] == what]
            shares = ["" if what == "all" else f" ({r['shares']['degree 1']:.0%})" for r in of]
            cells = [
                f"{r['psnr_inside'] - zero['psnr_inside']:+.2f}{share}"
                for r, share in zip(of, shares, strict=True)
            ]
            chosen = [
                max([zero, *of], key=lambda r: r["evidence"])
                if "evidence" in what or what == "all"
                else {}
            ]
            chosen.insert(
                0, min([zero, *of], key=lambda r: r["left_out_error"]) if what == "all" else {}
            )
            named = [f"{r.get('tau', 'degree 0')}" if r else "" for r in chosen]
            name = f"{_rock(scene['dataset'])}, {scene['views']} views: {what}"
            rows.append([name, f"{zero['psnr_inside']:.2f}", *cells, *named])
    taus = [
        f"tau {tau:g}" for tau in dict.fromkeys(r["tau"] for r in data["scenes"][0]["degrees"][1:])
    ]
    return markdown(
        [
            "rock: Gaussians of degree 1",
            "degree 0, dB",
            *taus,
            "tau by views left out",
            "tau by evidence",
        ],
        rows,
    )


def _rock(dataset: str) -> str:
    """The scene that a dataset of the commands here is of, by its path."""
    parts = Path(dataset).parts
    return "boulder" if parts[0] == "demo" else parts[-2]


def uncertainty(data: dict[str, Any]) -> str:
    """How well errors are predicted in the test views: means over runs; of shares inside intervals
    the extremes, too."""
    rows = []
    of_tests = [
        row for record in data["records"] for row in record["rows"] if row["views"] == "test"
    ]
    for prediction in dict.fromkeys(row["prediction"] for row in of_tests):
        found = [row for row in of_tests if row["prediction"] == prediction]
        names = [
            (kind, name) for kind in ("mae", "mse") for name in ("ause", "perfect", "constant")
        ]
        areas = [[row["ause"][kind][name] for row in found] for kind, name in names]
        cells = [f"{sum(values) / len(values):.2f}" for values in areas]
        cells = [f"{a} ({p}; {c})" for a, p, c in (cells[:3], cells[3:])]
        cells += [
            f"{sum(row[key] for row in found) / len(found):.2f}" for key in ("spearman", "pearson")
        ]
        for share in ("0.5", "0.9"):
            whole = sum(row["held"][share][0] for row in found) / len(found)
            thirds = [held for row in found for held in row["held"][share][1:]]
            cells += [f"{100 * whole:.0f} % ({100 * min(thirds):.0f} to {100 * max(thirds):.0f})"]
        crps = sum(row["crps"] / row["crps_constant"] for row in found) / len(found)
        rows.append([prediction, *cells, f"{crps:.2f}"])
    heading = [
        "prediction",
        "AUSE of absolute errors (perfect; constant)",
        "of squared errors",
        "Spearman",
        "Pearson",
    ]
    heading += ["in the interval of 50 % (thirds)", "of 90 %", "CRPS over a constant's"]
    command = re.sub(
        r"(out/calibrated/\S+ ?)+", "out/calibrated/*/d*", data["command"]
    )  # their names are many
    return markdown(heading, rows) + made_by(data | {"command": command})


def uncertainty_rocks(data: dict[str, Any]) -> str:
    """The same rock by rock, of what the criteria assume and of all terms: means over runs; shares
    in intervals of each run."""
    of_rocks: dict[str, list[dict[str, Any]]] = {}
    for record in data["records"]:
        of_rocks.setdefault(Path(record["run"]).parent.name, []).extend(
            r for r in record["rows"] if r["views"] == "test"
        )
    rows = []
    for prediction in (data["records"][0]["rows"][0]["prediction"], "all"):
        for rock, found in of_rocks.items():
            of = [row for row in found if row["prediction"] == prediction]
            ause = {
                name: _mean(row["ause"]["mae"][name] for row in of)
                for name in ("ause", "perfect", "constant")
            }
            closed, promised = (1 - ause[name] / ause["constant"] for name in ("ause", "perfect"))
            held = [", ".join(f"{100 * row['held']['0.9'][k]:.1f}" for row in of) for k in range(4)]
            rows.append(
                [
                    f"{rock}: {prediction}",
                    f"{closed:.0%} ({promised:.0%})",
                    f"{_mean(r['spearman'] for r in of):.2f}",
                    *held,
                ]
            )
    policies = ", ".join(dict.fromkeys(record["policy"] for record in data["records"]))
    heading = [
        "rock: prediction",
        "gap closed (promised)",
        "Spearman",
        f"% in the interval of 90 % ({policies})",
    ]
    return markdown([*heading, "lowest third", "middle third", "highest third"], rows)


PRIORS = {
    "exact": "exact depth and poses",
    "survey, exact poses": "of `mgs survey --poses exact`: noisy depth",
    "survey": "of `mgs survey`: noisy depth, estimated poses",
    "--prior-noise 0.01": "`--prior-noise 0.01` (every point, 10 mm per axis)",
    "--holes 0.1": "`--holes 0.1` (share of the rock's points removed)",
    "--poisson-depth 7": "`--poisson-depth 7` (8 is automatic)",
}
"""What is said of a prior of `benchmarks/prior_errors.py`; of others, their option."""


def prior_errors(data: dict[str, Any]) -> str:
    """Errors of the priors of the first scene."""
    first, rows = data["rows"][0]["scene"], []
    of_first = [row for row in data["rows"] if row["scene"] == first]
    for row in sorted(
        of_first, key=lambda row: row["prior"].startswith("--")
    ):  # those of options last
        truth = row["truth"]
        lengths = [f"{1e3 * truth[key]:.1f} mm" for key in ("accuracy", "completeness")]
        lengths += [
            f"{1e3 * truth['hausdorff']:.0f} mm",
            f"{100 * truth['visible_within_2_spacing']:.1f} %",
        ]
        rows.append([PRIORS.get(row["prior"], f"`{row['prior']}`"), *lengths])
    heading = [
        f"prior of the {first}",
        "accuracy",
        "completeness",
        "Hausdorff",
        "visible within 2 spacings",
    ]
    return markdown(heading, rows) + made_by(data)


def prior_scenes(data: dict[str, Any]) -> str:
    """Errors of priors and surveys of all scenes, millimetres."""
    rows, scenes = [], {(row["scene"], row["prior"]): row for row in data["rows"]}

    def both(row: dict[str, Any]) -> str:
        return " / ".join(f"{1e3 * row['truth'][key]:.1f}" for key in ("accuracy", "completeness"))

    for scene in dict.fromkeys(row["scene"] for row in data["rows"]):
        exact, flown = scenes[scene, "exact"], scenes[scene, "survey"]
        errors = [f"{1e3 * error:.0f}" for error in flown["trajectory"].values()]
        rows.append([scene, both(exact), str(exact["clusters"]), *errors, both(flown)])
    heading = [
        "scene",
        "prior, exact: accuracy / completeness",
        "clusters found",
        "odometry",
        "registered",
        "loop closed",
    ]
    return markdown([*heading, "prior of the survey: accuracy / completeness"], rows) + made_by(
        data
    )


def criteria(data: dict[str, Any]) -> str:
    """How well scores predict the gain of a view: means over the states of rings and of domes, and
    over all."""
    states = data["states"]
    kinds = {
        "ring": [s for s in states if "-circle-" in s],
        "dome": [s for s in states if "-hemisphere-" in s],
    }
    sets = [*kinds.values(), list(states)]
    ceilings = [_mean(states[s]["result"]["ceiling"] for s in names) for names in sets]
    rows = []
    for policy in states[sets[0][0]]["result"]["spearman"]:
        found = [[states[s]["result"]["spearman"][policy] for s in names] for names in sets]
        if any(value is None for value in found[-1]):  # scores that are all equal rank nothing
            continue
        values = [_mean(numbers) for numbers in found]
        regrets = [_mean(states[s]["result"]["regret"][policy] for s in names) for names in sets]
        even = _mean(states[s]["result"]["spearman"][policy] for s in states if s.endswith("-even"))
        cells = [
            *(f"{value:.2f}" for value in (*values, even, values[-1] / ceilings[-1])),
            *(f"{r:.2f}" for r in regrets),
        ]
        rows.append((values[-1], [Path(policy).name, *cells]))
    ranked = [row for _, row in sorted(rows, key=lambda row: -row[0])]
    even = _mean(states[s]["result"]["ceiling"] for s in states if s.endswith("-even"))
    ranked.append(["(ceiling)", *(f"{value:.2f}" for value in (*ceilings, even)), "1", "", "", ""])
    spearman = [f"Spearman, {len(names)} {kind}s" for kind, names in kinds.items()]
    heading = [
        "score",
        *spearman,
        "all",
        "from 4 even views",
        "of the ceiling",
        "regret, rings, dB",
        "domes",
        "all",
    ]
    command = re.sub(
        r"(out/states/\S+ )+", "out/states/* ", data["command"]
    )  # their names are many
    apart = [
        state["largest_difference"] for state in states.values() if "largest_difference" in state
    ]
    note = (
        f"\nPSNR measured anew differs from that of `OLD.json` by {max(apart):.3f} dB at most.\n"
        if apart
        else ""
    )
    return (
        markdown(heading, ranked)
        + note
        + made_by(data | {"command": command.replace("out/OLD", "OLD")})
    )


def fitted_degree(data: dict[str, Any]) -> str:
    """Runs with colours of several degrees in the fit: means over the rocks."""
    rows = []
    for degree in dict.fromkeys(r["degree"] for r in data["records"]):
        for policy in dict.fromkeys(r["policy"] for r in data["records"]):
            of = [r for r in data["records"] if (r["degree"], r["policy"]) == (degree, policy)]
            keys = ("psnr", "psnr_mask", "degree_0_psnr", "degree_0_psnr_mask")
            rows.append(
                [f"{degree}, {policy}", *(f"{_mean(r[key] for r in of):.2f}" for key in keys)]
            )
    same = ["the same views fitted with degree 0", "rock"]
    return markdown(
        ["degree of the fit, policy", "test views (dB)", "rock", *same], rows
    ) + made_by(data)


def _mean(values: Iterable[float]) -> float:
    numbers = list(values)
    return sum(numbers) / len(numbers)


TABLES: dict[str, tuple[str, Callable[[Any], str]]] = {
    "local-density": ("benchmarks/local_density", local_density),
    "evidence-kinds": ("benchmarks/evidence", evidence_kinds),
    "evidence-degrees": ("benchmarks/evidence", evidence_degrees),
    "uncertainty": ("benchmarks/uncertainty", uncertainty),
    "uncertainty-rocks": ("benchmarks/uncertainty", uncertainty_rocks),
    "prior-errors": ("benchmarks/prior_errors", prior_errors),
    "prior-scenes": ("benchmarks/prior_errors", prior_scenes),
    "criteria": ("benchmarks/criteria", criteria),
    "fitted-degree": ("benchmarks/fitted_degree", fitted_degree),
    "demo": ("benchmarks/demo", demo),
    "demo-report": ("benchmarks/demo", demo_report),
    "flights": ("benchmarks/flights", flights),
    "policies": ("benchmarks/demo", policies),
    "hutchinson": ("benchmarks/hutchinson", hutchinson),
    "render-settings": ("benchmarks/render_settings", render_settings),
    "lambda-ranking": ("benchmarks/lambda_ranking", lambda_ranking),
    "depth-error": ("benchmarks/depth_error", depth_error),
    "backing": ("benchmarks/backing", backing),
    "own-data": ("benchmarks/own_data", own_data),
    "exposure": ("benchmarks/exposure", exposure),
    "photo-memory": ("benchmarks/photo_memory", photo_memory),
}
"""By name: the file, seen from docs/ and without `.json`, and what makes the table of its
contents."""
