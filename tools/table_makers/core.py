"""Tables of docs/benchmarks/*.json about the speed and the accuracy of the kernels, and the time of
whole runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mgs.bench.core import TARGETS
from table_makers.markdown import made_by, markdown, short


def splat(data: dict[str, Any]) -> str:
    """Times of `mgs bench splat`, ratios to the peer or to a gradient, and what is asked for."""
    seconds, figures, scene = data["seconds"], data["figures"], data["scene"]
    rows = []
    for name, own, peer, figure in (
        ("forward, warm", "forward_warm", "volprim_forward", "forward_warm_speedup"),
        (
            "forward, cold (a view never seen before)",
            "forward_cold",
            "volprim_forward",
            "forward_cold_speedup",
        ),
        ("forward + adjoint, warm", "gradient_warm", "volprim_gradient", "gradient_warm_speedup"),
        (
            "exact Fisher diagonal, warm, over forward + adjoint",
            "fisher_exact",
            None,
            "fisher_over_gradient",
        ),
        (
            "exact 11x11 blocks, warm, over forward + adjoint",
            "fisher_block",
            None,
            "block_fisher_over_gradient",
        ),
    ):
        bound, target = TARGETS[figure]
        times = [f"{1e3 * seconds[own]:.1f} ms", f"{1e3 * seconds[peer]:.0f} ms" if peer else ""]
        rows.append(
            [name, *times, f"{figures[figure]:.{0 if peer else 2}f}", f"{bound} {target:g}"]
        )
    bound, target = TARGETS["tiny_forward_ms"]
    tiny = f"{figures['tiny_forward_ms']:.2f} ms"
    rows.append(["forward, 1,000 Gaussians, 64x48, warm", tiny, "", "", f"{bound} {target:g} ms"])
    title = f"{scene['gaussians']:,} Gaussians of a rock, {scene['width']}x{scene['height']}"
    return markdown([title, "mgs", "`volprim_rf_basic`", "ratio", "asked for"], rows) + made_by(
        data
    )


def splat_short(data: dict[str, Any]) -> str:
    """The times of `splat` alone, and how many times as long Mitsuba's own integrator takes."""
    seconds, figures, scene = data["seconds"], data["figures"], data["scene"]
    rows = []
    for name, own, figure in (
        ("forward, warm", "forward_warm", "forward_warm_speedup"),
        ("forward, a view never seen before", "forward_cold", "forward_cold_speedup"),
        ("forward + adjoint, warm", "gradient_warm", "gradient_warm_speedup"),
        ("exact Fisher diagonal, warm", "fisher_exact", None),
        ("exact 11x11 blocks, warm", "fisher_block", None),
    ):
        rows.append(
            [name, f"{1e3 * seconds[own]:.1f} ms", f"{figures[figure]:.0f} times" if figure else ""]
        )
    title = f"{scene['gaussians']:,} Gaussians, {scene['width']}x{scene['height']}"
    return markdown([title, "mgs", "Mitsuba over mgs"], rows) + made_by(data)


def splat_work(data: dict[str, Any]) -> str:
    """Work and memory of the same run."""
    peak, share = f"{data['peak_gflops_measured']:.0f} Gflop/s", data["share_of_peak"]
    rows = [
        ["(splat, block) pairs", f"{data['pairs']:,}"],
        [
            "pixels evaluated a second (32 a pair), forward",
            f"{data['pixel_splat_pairs_per_second']['forward'] / 1e9:.1f} billion",
        ],
        [f"share of the measured FMA rate ({peak}), forward", f"{share['forward']:.0%}"],
        ["share of the measured FMA rate, exact Fisher", f"{share['fisher_exact']:.0%}"],
        ["block lists of a camera", f"{data['list_megabytes']:.0f} MB"],
        [
            "most memory of the process, before the peer is loaded",
            f"{data['peak_memory_megabytes']:.0f} MB",
        ],
    ]
    return markdown(["in the same run", ""], rows)


def roofline(data: dict[str, Any]) -> str:
    """What share of each kernel's time each limit of the machine takes, and the limits."""
    rows = data["kernels"]
    lines = [
        [
            row["name"],
            f"{1e3 * row['seconds']:.2f}",
            f"{row['gflops']:.1f}" if row["gflops"] else "",
            *(f"{share:.0%}" for share in row["shares"].values()),
            row["verdict"],
        ]
        for row in rows
    ]
    return (
        markdown(["kernel", "ms", "Gflop/s", *rows[0]["shares"], "bound by"], lines)
        + _limits(data["limits"])
        + made_by(data)
    )


def _limits(limits: dict[str, Any]) -> str:
    """What the machine could do at most, as measured in the same run."""
    bandwidths = ", ".join(
        f"{name} {value / 1e9:.0f}" for name, value in limits["bandwidth"].items()
    )
    return (
        f"\nLimits: FMAs {limits['flops'] / 1e9:.0f} Gflop/s, in double {limits['flops64'] / 1e9:.0f}; divisions "
        f"{limits['divisions'] / 1e9:.1f} billion a second, in double {limits['divisions64'] / 1e9:.1f}; addresses "
        f"{limits['addresses'] / 1e9:.2f} billion a second; GB/s: {bandwidths}.\n"
    )


def roofline_bounds(data: dict[str, Any]) -> str:
    """For whole operations the time of their kernels, and what it would be if each took as long as
    its nearest limit asks."""
    kernels, rows = {row["name"]: row for row in data["kernels"]}, []
    for operation, names in KERNELS_OF.items():
        measured = sum(kernels[name]["seconds"] for name in names)
        nearest = sum(
            kernels[name]["seconds"] * min(max(kernels[name]["shares"].values()), 1)
            for name in names
        )
        rows.append(
            [
                operation,
                f"{1e3 * nearest:.1f}",
                f"{1e3 * measured:.1f}",
                f"{measured / nearest:.1f}",
            ]
        )
    return markdown(["", "by the nearest limits, ms", "kernels, ms", "ratio"], rows) + made_by(data)


BEFORE, DRAWN = (
    ("projection", "lists tested, and packing"),
    ("forward: alpha and depth", "pixels row by row"),
)
ADJOINT = ("adjoint: alpha and depth: walk", "adjoint: alpha and depth: add up")
KERNELS_OF = {
    "draw a view never seen before": ("projection", "packing", "block lists", *DRAWN),
    "draw a view seen before": (*BEFORE, *DRAWN),
    "image and gradient": (*BEFORE, *DRAWN, *ADJOINT, "sums to gradient"),
    "exact Fisher diagonal": (
        *BEFORE, "exact Fisher: walk 1", "exact Fisher: walk 2", "exact Fisher: add up", "sums to exact Fisher",
    ),
    "exact 11x11 blocks": (
        *BEFORE, "block Fisher: walk 1", "block Fisher: walk 2", "block Fisher: add up", "sums to block Fisher",
    ),
}  # fmt: skip
"""The kernels of each operation that `mgs bench splat` times."""


def roofline_work(data: dict[str, Any]) -> str:
    """Operations and bytes of each kernel, counted, and the lanes that are busy."""
    rows = []
    for row in data["kernels"]:
        each = row["each"]
        counts = [each["flops"], each["flops64"], each["divisions"] + each["divisions64"]]
        counts += [each[key] for key in ("instructions", "bytes", "state_bytes", "addresses")]
        rows.append(
            [
                row["name"],
                row["unit"],
                *(f"{count:,.0f}" for count in counts),
                f"{row['lanes_active']:.0%}",
            ]
        )
    heading = [
        "kernel",
        "for each",
        "operations",
        "in double",
        "divisions",
        "instructions",
        "bytes",
        "state bytes",
        "addresses",
        "busy lanes",
    ]
    return markdown(heading, rows)


def roofline_short(data: dict[str, Any]) -> str:
    """Of each kernel its time, the limits that bind some kernel, and which of them does."""
    shown = ("division", "instructions", "memory", "addresses")
    rows = [
        [
            row["name"],
            f"{1e3 * row['seconds']:.1f}",
            *(f"{row['shares'][name]:.0%}" for name in shown),
            row["verdict"],
        ]
        for row in data["kernels"]
    ]
    return (
        markdown(["kernel", "ms", *shown, "bound by"], rows)
        + _limits(data["limits"])
        + made_by(data)
    )


def variants(data: dict[str, Any]) -> str:
    """Times of variants of the core over that of the core as it is, and their errors."""
    rows = []
    for row in data["rows"]:
        times = [f"{row['ratios'][key]:.2f}" for key in OPERATIONS]
        rows.append([row["name"], *times, *(short(value) for value in row["errors"].values())])
    rows.append(
        [
            f"slowest over fastest of {data['rounds']} rounds, as it is",
            *(f"{data['spread'][key]:.2f}" for key in OPERATIONS),
        ]
    )
    rows[-1] += ["–"] * 3
    ours, theirs = data["peer"].values()
    ratio = [theirs[key] / ours[key] for key in ("volprim_forward", "volprim_gradient")]
    rows.append(
        [
            "Mitsuba's volprim, instructions in LLVM's order",
            "–",
            *(f"{r:.2f}" for r in ratio),
            *["–"] * 5,
        ]
    )
    heading = ["", "new view", "view seen before", "image and gradient", "exact Fisher", "blocks"]
    return markdown([*heading, "error of the image", "gradient", "Fisher"], rows) + made_by(data)


def machine_code(data: dict[str, Any]) -> str:
    """Instructions of the loops that draw, of each kernel, for one pair."""
    rows = []
    for kernel in data["counts"]["as it is"]:
        found = [ways[kernel] for ways in data["counts"].values()]
        rows.append(
            [
                kernel,
                *(
                    f"{c['instructions']:,.0f} ({c['loads']:,.0f}, {c['stores']:,.0f})"
                    for c in found
                ),
            ]
        )
    return markdown(
        ["instructions of a pair (loads, stores of the stack)", *data["counts"]], rows
    ) + made_by(data)


def unseen(data: dict[str, Any]) -> str:
    """Seconds of the fits of a run, and its model, against the information below which Gaussians
    are left out."""
    rows = []
    for record in data["records"]:
        first = next(
            other for other in data["records"] if other["gaussians"] == record["gaussians"]
        )
        limit = (
            "all are drawn"
            if record["limit"] is None
            else short(record["limit"], 2)
            if record["limit"]
            else "0"
        )
        cells = [
            f"{record['seen']:.0%}",
            f"{record['fit']:.1f}",
            f"{record['fit'] / first['fit']:.2f}",
        ]
        cells += [f"{record[key]:.3f}" for key in ("test_psnr", "test_psnr_mask")]
        rows.append([f"{record['gaussians']:,}: {limit}", *cells])
    heading = [
        "Gaussians: limit",
        "drawn in a view",
        "fits, s",
        "ratio",
        "test views, dB",
        "rock only",
    ]
    return markdown(heading, rows) + made_by(data)


def scaling(data: dict[str, Any]) -> str:
    """Exponents of growth, and times as sums of what grows linearly."""
    costs, start = data["linear_growth"], f"{data['exponents_from_n']:,}"
    exponents = {
        "exponent against pairs, N and the image growing together": "pairs alone",
        "as the image grows alone": "pairs, image growing",
        f"as N grows alone, from {start}": "pairs, N growing",
    }
    fits = {
        "fit: ns per pair": "ns per pair",
        "ns per Gaussian": "ns per Gaussian",
        "constant, ms": "constant, ms",
    }
    rows = [
        [name, *(f"{data['exponents'][what][key]:.2f}" for what in costs)]
        for name, key in exponents.items()
    ]
    rows += [
        [name, *(f"{cost[key]:.{int('ms' in name)}f}" for cost in costs.values())]
        for name, key in fits.items()
    ]
    rows.append(["worst deviation", *(f"{cost['worst deviation']:.0%}" for cost in costs.values())])
    return markdown(["", *costs], rows) + made_by(data)


def block_accuracy(data: dict[str, Any]) -> str:
    """Errors of block entries against the float64 oracle."""
    error = data["error_over_sqrt_HiiHjj"]
    rows = [
        ["entries beyond the tolerance of the tests", f"{data['entries_beyond_tolerance']:,}"],
        ["worst relative error", short(data["worst_relative_error"], 2)],
        ["error over sqrt(H_ii H_jj), median", short(error["median"])],
        ["error over sqrt(H_ii H_jj), 99th percentile", short(error["p99"])],
        ["error over sqrt(H_ii H_jj), worst", short(error["max"])],
    ]
    title = f"{data['entries']:,} entries of blocks, {data['scenes']:,} random scenes"
    return markdown([title, "measured"], rows) + made_by(data)


OPERATIONS = {
    "forward_cold": "draw a view never seen before",
    "forward_warm": "draw a view seen before",
    "gradient_warm": "image and gradient",
    "fisher_exact": "exact Fisher diagonal",
    "fisher_block": "exact 11x11 blocks",
}


def lanes(data: dict[str, Any]) -> str:
    """Seconds of the core by the registers that it uses, and their ratios to the first: of the
    fastest, and of the rounds."""
    first, *others = data["fastest"]
    rows = []
    for key, name in OPERATIONS.items():
        row = [name, f"{1e3 * data['fastest'][first][key]:.1f}"]
        for other in others:
            best, rounds = data["fastest"][other][key], data["ratios"][other][key]
            row.append(
                f"{1e3 * best:.1f}, {best / data['fastest'][first][key]:.2f} ({min(rounds):.2f} to {max(rounds):.2f})"
            )
        rows.append(row)
    for key, name in {
        "error_image": "largest error of an image",
        "error_fisher": "of exact Fisher information",
    }.items():
        rows.append([name, *(short(found[key], 2) for found in data["fastest"].values())])
    columns = [
        f"{other}: ms, ratio of the fastest of {data['rounds']} rounds (range)" for other in others
    ]
    return markdown(
        ["100,000 Gaussians, 640x480", f"{first}, fastest (ms)", *columns], rows
    ) + made_by(data)


def wasted(data: dict[str, Any]) -> str:
    """What walks do in vain, and what registers of each size could leave out of it."""
    widths = list(data["lanes"])
    rows = [
        [
            f"pixels evaluated and not drawn, of {data['pairs']:,} pairs of 32",
            *[f"{data['pixels_not_drawn']:.0%}"] * len(widths),
        ],
        [
            "rows of a block that its splat does not reach",
            *[f"{data['rows_not_reached']:.0%}"] * len(widths),
        ],
    ]
    for key, name in {
        "rows_no_lane_reaches": "rows that no lane's splat reaches: could be left out",
        "pairs_merged": "pairs whose splat another lane draws at the same time: sums could be merged",
        "lanes_waiting": "lanes that wait for the longest list of their register",
    }.items():
        rows.append([name, *(f"{data['lanes'][width][key]:.1%}" for width in widths)])
    return markdown(
        ["share of all", *(f"registers of {width} lanes" for width in widths)], rows
    ) + made_by(data)


def sizes(data: dict[str, Any]) -> str:
    """Seconds and memory of large models and images."""
    rows = []
    for size in data["sizes"]:
        seconds = [f"{size[key]:.2f}" if key in size else "–" for key in OPERATIONS]
        label = f"{size['n']:,} Gaussians, {size['width']}x{size['height']}"
        rows.append(
            [label, f"{size['pairs'] / 1e6:.1f}", *seconds, f"{size['peak_bytes'] / 2**30:.1f}"]
        )
    heading = [
        "",
        "million pairs",
        *(f"{name} (s)" for name in OPERATIONS.values()),
        "memory (GiB)",
    ]
    return markdown(heading, rows) + made_by(data)


def two_versions(data: dict[str, Any]) -> str:
    """Seconds of two versions, and the ratios of the rounds, beside those asked for."""
    rows = []
    for key, name in (
        OPERATIONS | {"tiny": "draw 1,000 Gaussians in 64x48, a view seen before"}
    ).items():
        row = [name, *(f"{1e3 * data['fastest'][key][which]:.1f}" for which in ("old", "new"))]
        for column in (key, f"culled {key}"):
            if column in data["ratios"]:
                low, median, high = data["ratios"][column]
                fastest = data["fastest"][column]["new"] / data["fastest"][column]["old"]
                asked = f"; at most {data['targets'][column]}" if column in data["targets"] else ""
                row.append(f"{fastest:.2f}; {median:.2f} ({low:.2f} to {high:.2f}){asked}")
        rows.append(row + ["–"] * (5 - len(row)))
    heading = ["", *(f"commit {data[which]}, fastest (ms)" for which in ("old", "new"))]
    heading += [f"ratio of the fastest; median of {data['rounds']} rounds (range); asked for"]
    seen = data["culled"]["seen"] / data["culled"]["gaussians"]
    return markdown(
        [*heading, f"a fitted model: the {seen:.0%} that are seen (new) over all (old)"], rows
    ) + made_by(data)


def demo_time(data: dict[str, Any]) -> str:
    """Seconds of the demo's stages in two versions: those of each round."""
    found: dict[str, dict[str, list[str]]] = {}
    for record in data["records"]:
        for stage, seconds in [
            *record["stages"],
            ["sum", sum(seconds for _, seconds in record["stages"])],
        ]:
            found.setdefault(stage, {}).setdefault(record["version"], []).append(f"{seconds:.0f}")
    rows = [
        [stage, *(", ".join(times.get(version, ["–"])) for version in ("old", "new"))]
        for stage, times in found.items()
    ]
    heading = ["stage", *(f"commit {data[which]}, s" for which in ("old", "new"))]
    return markdown(heading, sorted(rows, key=lambda row: row[0] == "sum")) + made_by(data)


def whole_runs(data: dict[str, Any]) -> str:
    """Seconds of whole runs by stage, against the older version, and what their models are like on
    the test views."""
    rows = []
    for record in data["records"]:
        seconds = record["seconds"]
        old = next(
            other for other in data["records"] if other["gaussians"] == record["gaussians"]
        )  # the first of its kind
        total = sum(seconds.values())
        stages = [seconds["fit"], seconds["score"], seconds["information"]]
        name = record["run"].replace("old,", f"commit {data['old']},")
        cells = [f"{value:.1f}" for value in [*stages, total - sum(stages), total]]
        ratio = f"{total / sum(old['seconds'].values()):.2f}"
        rows.append(
            [
                f"{record['gaussians']:,}: {name}",
                *cells,
                ratio,
                f"{record['psnr']:.2f}",
                f"{record['psnr_mask']:.2f}",
            ]
        )
    heading = [
        "Gaussians: run",
        "fits, s",
        "scores",
        "information",
        "rest",
        "sum",
        "ratio",
        "test views, dB",
        "rock only",
    ]
    return markdown(heading, rows) + made_by(data)


PAPER_SIZE = 100_000
"""Gaussians of the runs at the paper's size."""


def paper_size(data: dict[str, Any]) -> str:
    """Today's runs at the paper's size."""
    rows = []
    for record in data["records"]:
        if record["gaussians"] != PAPER_SIZE or record["run"].startswith("old"):
            continue
        quality = [f"{record['psnr']:.2f}", f"{record['ssim']:.4f}", f"{record['psnr_mask']:.2f}"]
        minutes = f"{sum(record['seconds'].values()) / 60:.1f}"
        rows.append(
            [
                record["run"],
                str(record["images"]),
                str(record["fits"]),
                f"{record['passes']:g}",
                *quality,
                minutes,
            ]
        )
    heading = [
        "policy",
        "images",
        "fits",
        "passes in all",
        "test views, dB",
        "SSIM",
        "rock only, dB",
        "minutes",
    ]
    return markdown(heading, rows) + made_by(data)


def later_passes(data: dict[str, Any]) -> str:
    """Time and quality of whole runs against the passes of their later fits."""
    rows = []
    for record in data["records"]:
        total, curve = (
            sum(record["seconds"].values()),
            dict(zip(record["images"], record["test_psnr"], strict=True)),
        )
        cells = [f"{record['seconds']['fit']:.1f}", f"{total:.1f}", f"{curve[12]:.2f}"]
        cells += [f"{record['test_psnr'][-1]:.2f}", f"{record['test_psnr_mask'][-1]:.2f}"]
        rows.append([str(record["passes"]), *cells])
    images = data["records"][0]["images"][-1]
    last = [f"{images} images, dB", f"{images} images, rock only"]
    return markdown(
        ["passes of later fits", "fits, s", "whole run, s", "12 images, dB", *last], rows
    ) + made_by(data)


def data_samples(data: dict[str, Any]) -> str:
    """What samples per pixel of the data cost, and what they bring to a model that is fitted to
    it."""
    rows = []
    for record in data["records"]:
        views = [
            f"{record[f'{name}_{key}']:.2f}"
            for name in ("reference", "own")
            for key in ("psnr", "psnr_mask")
        ]
        rows.append([str(record["samples"]), f"{record['seconds']['frame_s']:.2f}", *views])
    most = data["records"][-1]["samples"]
    judges = [
        f"{tests}, {part}"
        for tests in (f"test views of {most} samples", "of its own")
        for part in ("dB", "rock")
    ]
    return markdown(["samples a pixel", "s a frame", *judges], rows) + made_by(data)


WAYS = {
    "anew": "all Gaussians, anew for every choice",
    "updated": "**all Gaussians, brought up to date**",
}
"""Ways of `benchmarks/planning.py`; the others are numbers of Gaussians."""


def planning(data: dict[str, Any]) -> str:
    """Seconds to plan a flight, and what the plan brings, by how the gains are computed."""
    rows: list[list[str]] = []
    for row in data["rows"]:
        poses = Path(row["dataset"]).name
        if poses not in (line[0] for line in rows):
            rows.append(
                [poses, "both", "(the pass over the poses)", f"{row['looking']:.1f}", "–", "–", "–"]
            )
        way = WAYS.get(row["way"], f"{row['gaussians']:,} Gaussians, anew")
        kept = (
            "–"
            if row["way"] == "anew"
            else f"{row['kept']} of {data['budget']}" + (", the same order" if row["same"] else "")
        )
        error = f"{row['largest_difference']:.0e}" if "largest_difference" in row else "–"
        worth = f"{100 * row['worth']:.2f} %" if "worth" in row else "100 %"
        rows.append([poses, row["criterion"], way, f"{row['seconds']:.1f}", kept, error, worth])
    heading = [
        "poses",
        "criterion",
        "gains of",
        "seconds",
        "the same choices",
        "largest error of a gain",
        "the plan's worth",
    ]
    return markdown(heading, rows) + made_by(data)


TABLES: dict[str, tuple[str, Callable[[Any], str]]] = {
    "planning": ("benchmarks/planning", planning),
    "versions": ("benchmarks/versions", two_versions),
    "demo-time": ("benchmarks/demo_time", demo_time),
    "roofline-bounds": ("benchmarks/roofline", roofline_bounds),
    "whole-runs": ("benchmarks/whole_runs", whole_runs),
    "paper-size": ("benchmarks/whole_runs", paper_size),
    "data-samples": ("benchmarks/data_samples", data_samples),
    "later-passes": ("benchmarks/warm_passes", later_passes),
    "lanes": ("benchmarks/lanes", lanes),
    "wasted": ("benchmarks/wasted", wasted),
    "sizes": ("benchmarks/sizes", sizes),
    "splat": ("benchmarks/splat", splat),
    "splat-short": ("benchmarks/splat", splat_short),
    "splat-work": ("benchmarks/splat", splat_work),
    "roofline": ("benchmarks/roofline", roofline),
    "roofline-million": ("benchmarks/roofline_million", roofline_short),
    "variants": ("benchmarks/variants", variants),
    "machine-code": ("benchmarks/machine_code", machine_code),
    "unseen": ("benchmarks/unseen", unseen),
    "roofline-work": ("benchmarks/roofline", roofline_work),
    "scaling": ("benchmarks/scaling", scaling),
    "block-accuracy": ("benchmarks/block_accuracy", block_accuracy),
}
"""By name: the file, seen from docs/ and without `.json`, and what makes the table of its
contents."""
