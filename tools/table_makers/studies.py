"""Tables of docs/results/*/*.json: what the studies found."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

from mgs.study.chart.tables import TABLES as CHART_TABLES
from mgs.study.chart.tables import chart_table
from mgs.study.reproduce import LEADER
from mgs.study.reproduce_tables import led, matrix
from mgs.study.stress.verdict import effect
from table_makers.markdown import made_by, markdown


def stability(data: dict[str, Any]) -> str:
    """Verdicts of `mgs stress`, experiment by experiment."""
    rows = []
    for experiment in data["experiments"]:
        for claim in experiment["claims"]:
            rows.append(
                [
                    experiment["name"],
                    claim["hypothesis"],
                    f"**{claim['verdict']}**",
                    effect(claim),
                    str(claim["runs"]),
                ]
            )
    heading = ["experiment", "hypothesis", "verdict", "mean effect (95 % interval)", "runs"]
    return markdown(heading, rows) + made_by(data)


def parsimony(data: dict[str, Any]) -> str:
    """Every fit of `mgs parsimony`."""
    rows = []
    for r in data["rows"]:
        n = f"{r['gaussians']:,}" + (" (auto)" if r["asked"] == "auto" else "")
        cells = [
            n,
            r["learned"],
            str(r["degree"]),
            f"{r['parameters']:,}",
            f"{r['psnr_inside']:.2f}",
            f"{r['psnr']:.2f}",
        ]
        if r["learned"] == "auto":  # it is fitted to all views at once
            cells += ["", "", ""]
        else:
            cells += [
                f"{1e3 * math.sqrt(r['next_error']):.1f}",
                f"{r['predictive']:.2f}",
                f"{r['evidence'] / 1e3:,.0f}",
            ]
        rows.append([r["scene"], *cells, f"{r['seconds']:.0f}"])
    heading = [
        "scene", "N", "learned", "SH", "parameters", "PSNR inside", "PSNR", "rms of the next view, 1e-3", "predictive",
        "evidence, 1e3", "seconds of fits",
    ]  # fmt: skip
    return markdown(heading, rows) + made_by(data)


def parsimony_verdict(data: dict[str, Any]) -> str:
    """What is chosen automatically, the number of Gaussians alone and everything, beside fixed
    numbers."""
    rows = []
    for scene, one in data["scenes"].items():
        number = next(
            r
            for r in data["rows"]
            if r["scene"] == scene and r["asked"] == "auto" and r["learned"] == "+ rotation"
        )
        cells = [
            f"{one['best']:.2f}", f"{one['number']:.2f}, {number['parameters']:,}", f"{one['auto']:.2f}, {one['parameters']:,}",
            f"{round(one['loss'], 2) + 0.0:.2f}", f"{one['smallest']:,}",
        ]  # fmt: skip
        rows.append(
            [scene, *cells, " and ".join("yes" if one[key] else "no" for key in ("close", "small"))]
        )
    heading = [
        "scene", "best fixed, dB", "automatic number: dB, parameters", "all automatic: dB, parameters", "loss",
        "smallest fixed within 0.1 dB, parameters", "close, and no larger",
    ]  # fmt: skip
    return markdown(heading, rows) + made_by(data)


def parsimony_lean(data: dict[str, Any]) -> str:
    """What `mgs refit` chooses, and why."""
    rows = []
    for scene, one in data["scenes"].items():
        lean, of = (
            one["lean"],
            [r for r in data["rows"] if r["scene"] == scene and r["asked"] == "auto"],
        )
        by_degree = {r["degree"]: r["psnr_inside"] for r in of if r["learned"] == "+ rotation"}
        whole = next(r for r in of if r["learned"] == "+ rotation" and r["degree"] == 0)
        shares = [
            f"{lean['shares'][kind]:.0%}" if kind in lean["shares"] else ""
            for kind in ("opacity", "scale", "rotation")
        ]
        rows.append([
            scene, *shares, f"{lean['directional_gain']:+.2f} ± {lean['directional_error']:.2f}", str(lean["degree"]),
            f"{by_degree[1] - by_degree[0]:+.2f}", f"{lean['shares'].get('directional', 0):.0%}",
            *(f"{one['psnr_inside']:.2f}, {one['psnr']:.2f}" for one in (lean["whole"], lean)),
            f"{lean['parameters'] / whole['parameters']:.0%}",
        ])  # fmt: skip
    heading = [
        "scene", "learn opacity", "scale", "rotation", "degree 1 on views left out, dB", "degree chosen",
        "degree 1 on test views, dB", "learn it", "learning all: inside, full frame, dB", "chosen", "parameters",
    ]  # fmt: skip
    return markdown(heading, rows) + made_by(data)


def left_out(data: dict[str, Any]) -> str:
    """What degree 1 gains on test views and on views left out."""
    rows = []
    for one in data["records"]:
        cells = [f"{one['psnr'][1] - one['psnr'][0]:+.2f}"]
        for name in ("blocks", "between"):
            found = one[name]
            cells += [
                f"{found['gain']:+.2f} ({found['error']:.2f})",
                "degree 1" if found["pays"] else "degree 0",
            ]
        rows.append([f"{one['rock']}, {one['material']}", str(one["views"]), *cells])
    heading = [
        "rock",
        "views",
        "gain on test views, dB",
        "on blocks left out, dB",
        "asks for",
        "between, dB",
        "asks for",
    ]
    return markdown(heading, rows) + made_by(data)


def parsimony_rules(data: dict[str, Any]) -> str:
    """What each rule would choose along each axis, and what that loses."""
    rows = []
    for scene, one in data["scenes"].items():
        for axis in ("gaussians", "learned", "degree"):
            found = [
                one["chosen"][f"{axis} by {rule}"]
                for rule in ("psnr_inside", "next_error", "predictive", "evidence")
            ]
            cells = [f"{c['value']:,}" if axis == "gaussians" else str(c["value"]) for c in found]
            rows.append(
                [
                    f"{scene}, {axis}",
                    cells[0],
                    *(
                        f"{c} ({0.0 - round(f['loss'], 2):.2f})"
                        for c, f in zip(cells[1:], found[1:], strict=True)
                    ),
                ]
            )
    return markdown(
        ["", "best on the test views", "by next error", "by predictive", "by evidence"], rows
    )


def parsimony_prune(data: dict[str, Any]) -> str:
    """How much pruning leaves of the automatic model, and what it changes."""
    rows = []
    for scene, one in data["scenes"].items():
        before = one["prior"]["gaussians"]
        for p in one["pruned"]:
            left = f"{p['gaussians']:,} of {before:,} ({p['gaussians'] / before:.0%})"
            change = [f"{1e3 * p[key]:.2f}" for key in ("predicted", "actual")]
            ratio = f"{(p['actual'] / p['predicted']) ** 2:.2f}" if p["predicted"] else ""
            rows.append(
                [
                    f"{scene}, {p['noise']:g} sigma",
                    left,
                    *change,
                    ratio,
                    f"{p['psnr_inside'] - one['number']:+.2f}",
                ]
            )
    heading = [
        "scene, noise",
        "Gaussians left",
        "rms change predicted, 1e-3",
        "measured",
        "ratio of squares",
        "PSNR inside, dB",
    ]
    return markdown(heading, rows)


def chart(name: str) -> Callable[[dict[str, Any]], str]:
    """What makes a table of `mgs chart`, by its name."""

    def table(data: dict[str, Any]) -> str:
        picture, heading, rows, note = chart_table(name, data)
        return picture + (markdown(heading, rows) + "\n" if rows else "") + f"{note}\n"

    return table


SHORT = ("d-optimal", "paper", "directional-i", "coverage", "farthest", "uniform", "random")
"""Policies of the README's table."""


def curves_short(data: dict[str, Any]) -> str:
    """The rows of SHORT in the first table of the curves."""
    heading, rule, *rows = data["markdown"].split("\n\n")[0].splitlines()
    by_policy = {row.split("|")[1].strip(): row for row in rows}
    return "\n".join([heading, rule, *(by_policy[policy] for policy in SHORT)]) + "\n"


REPRODUCED = {
    "table1": "",
    "curves": "PSNR against images, and differences from uniform",
    "seeds": "PSNR of the last model against the number of seeds",
    "pools": "PSNR of the last model over random, for each pool and policy",
}
"""Results of `mgs reproduce` that have a table, by name, and what their picture shows; Table I has
none."""


def reproduced(name: str) -> Callable[[dict[str, Any]], str]:
    """What makes a table of `mgs reproduce`, by its name: as the study wrote it, its command, and
    its picture."""

    def table(data: dict[str, Any]) -> str:
        picture = (
            f"\n![{REPRODUCED[name]}](results/reproduce/{name}.png)\n" if REPRODUCED[name] else ""
        )
        return f"{data['markdown']}{made_by(data)}{picture}"

    return table


def ablations(data: dict[str, Any]) -> str:
    """Policies of `benchmarks/policies.py` beside `d-optimal`: by how much the leader is ahead of
    each."""
    rows = [row for row in data["rows"] if ".py:" in row["policy"] or row["policy"] == "d-optimal"]
    return matrix(rows, f"{LEADER} over it (dB)", lambda row: led(row, "test_psnr_led")) + made_by(
        data
    )


def oracle(data: dict[str, Any]) -> str:
    """What each policy gains over random draws on the test views, and its share of what the oracle
    gains, pool by pool."""
    rows = data["rows"]
    pools, policies = (list(dict.fromkeys(row[key] for row in rows)) for key in ("pool", "policy"))
    found = {(row["policy"], row["pool"]): row for row in rows}
    lines = []
    for policy in policies:
        of = [found[policy, pool] for pool in pools]
        lines.append(
            [
                policy,
                *(
                    f"{row['test_psnr_over_random']:+.2f} ({row['test_psnr_share']:.2f})"
                    for row in of
                ),
            ]
        )
    return markdown([f"{data['rocks']} rocks: over random, dB (share)", *pools], lines) + made_by(
        data
    )


def own_policy(data: dict[str, Any]) -> str:
    """By how much a policy of the user's own is behind the leader, at the end and over the whole
    curve."""
    rows = [
        row | {"policy": what}
        for row in data["rows"]
        if ".py:" in row["policy"]
        for what in LED_COLUMNS
    ]
    return matrix(
        rows, f"{LEADER} over it (dB)", lambda row: led(row, LED_COLUMNS[row["policy"]])
    ) + made_by(data)


def small_lambda(data: dict[str, Any]) -> str:
    """Runs of `benchmarks/small_lambda.py` over those of d-optimal: mean, least and largest
    difference."""
    records, rows = data["records"], []
    base = {(r["rock"], r["pool"]): r for r in records if r["policy"] == "d-optimal"}
    for policy in dict.fromkeys(r["policy"] for r in records):
        of, cells = [r for r in records if r["policy"] == policy], []
        for key in ("test_psnr", "test_psnr_mask", "test_psnr_area", "test_psnr_mask_area"):
            more = [r[key] - base[r["rock"], r["pool"]][key] for r in of]
            mean, least, most = sum(more) / len(more), min(more), max(more)
            is_base = policy == "d-optimal"
            cells.append(
                f"{sum(r[key] for r in of) / len(of):.2f}"
                if is_base
                else f"{mean:+.2f} ({least:+.2f} to {most:+.2f})"
            )
        rows.append([policy, *cells])
    heading = ["policy", "last model, full frame (dB)", "rock", "whole curve, full frame", "rock"]
    return markdown(heading, rows) + made_by(data)


LED_COLUMNS = {
    "last model, full frame": "test_psnr_led",
    "last model, rock": "test_psnr_mask_led",
    "whole curve, full frame": "test_psnr_area_led",
    "whole curve, rock": "test_psnr_mask_area_led",
}
"""Rows of that table, and the differences that they are of."""


def lunar(data: dict[str, Any]) -> str:
    """The area under PSNR(images) on each of two meshes."""
    samples = [f"sample {number}" for number in re.findall(r"--mesh \w*?(\d+)\.", data["command"])]
    keys = {"test_psnr": "full frame", "test_psnr_mask": "rock"}
    policies = data["test_psnr"]["area_by_rock"]
    rows = [
        [policy, *(f"{area:.2f}" for key in keys for area in data[key]["area_by_rock"][policy])]
        for policy in policies
    ]
    heading = [f"{sample}, {part} (dB)" for part in keys.values() for sample in samples]
    return markdown(["policy", *heading], rows) + made_by(data)


def clean_alarms(data: dict[str, Any]) -> str:
    """How often each detector speaks in runs in which nothing is wrong."""
    rows = []
    for name, found in data["signs"].items():
        rows.append(
            [
                name,
                f"{found['runs']} of {data['runs']}",
                f"{found['rocks']} of {data['rocks']}",
                f"{found['largest']:.2f}",
            ]
        )
    alarms = sum(pool["alarms"] for pool in data["pools"].values())
    rows.append(["any but `saturated`", f"{alarms} of {data['runs']}", "", ""])
    pools = ", ".join(
        f"{name} {pool['alarms']} of {pool['runs']}" for name, pool in data["pools"].items()
    )
    heading = ["sign", "runs beyond its limit", "rocks", "largest value over the limit"]
    return markdown(heading, rows) + f"\nThe last row by pool: {pools}.\n" + made_by(data)


TABLES: dict[str, tuple[str, Callable[[Any], str]]] = {
    "stability": ("results/stress/verdicts", stability),
    "stability-world": ("results/stress/world", stability),
    "stability-full": ("results/stress-full/verdicts", stability),
    "parsimony": ("results/parsimony/parsimony", parsimony),
    "parsimony-verdict": ("results/parsimony/parsimony", parsimony_verdict),
    "parsimony-verdict-full": ("results/parsimony-full/parsimony", parsimony_verdict),
    "left-out": ("benchmarks/left_out", left_out),
    "parsimony-lean": ("results/parsimony/parsimony", parsimony_lean),
    "parsimony-lean-full": ("results/parsimony-full/parsimony", parsimony_lean),
    "parsimony-rules": ("results/parsimony/parsimony", parsimony_rules),
    "parsimony-prune": ("results/parsimony/parsimony", parsimony_prune),
    **{f"reproduce-{name}": (f"results/reproduce/{name}", reproduced(name)) for name in REPRODUCED},
    "curves-short": ("results/reproduce/curves", curves_short),
    "paper-size-table1": ("results/paper-size/table1", reproduced("table1")),
    "ablations": ("results/ablations/pools", ablations),
    "small-lambda": ("benchmarks/small_lambda", small_lambda),
    "trained-gaussians": ("benchmarks/trained_gaussians", own_policy),
    "linear-look": ("results/linear-look/pools", ablations),
    "directional-noise": ("results/directional-noise/pools", own_policy),
    "lunar": ("results/lunar/statistics", lunar),
    "clean-alarms-alpha": ("benchmarks/clean_alarms_alpha", clean_alarms),
    "clean-alarms": ("benchmarks/clean_alarms", clean_alarms),
    "oracle": ("results/oracle/pools", oracle),
    **{f"chart-{name}": ("results/chart/chart", chart(name)) for name in CHART_TABLES},
}
"""By name: the file, seen from docs/ and without `.json`, and what makes the table of its
contents."""

NOT_RUN = {
    f"results/reproduce/{name}": f"Not run yet: `mgs reproduce OUT --only {name}`.\n"
    for name in REPRODUCED
}
"""What stands for a table whose file may be missing."""
