"""Tables of docs/fit.md. Each file says which command wrote it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mgs.bench.fit import TARGETS as FIT_TARGETS
from mgs.study.statistics import interval
from table_makers.markdown import made_by, markdown


def ranking(data: dict[str, Any]) -> str:
    """Agreement of rankings after short fits with those after the longest, mean over the states."""
    rows, passes = [], sorted({r["passes"] for r in data["rows"]})[:-1]
    for criterion in dict.fromkeys(r["criterion"] for r in data["rows"]):
        cells = []
        for count in passes:
            of = [r for r in data["rows"] if (r["criterion"], r["passes"]) == (criterion, count)]
            tau, regret = (sum(r[key] for r in of) / len(of) for key in ("tau", "regret"))
            cells.append(f"{tau:.2f} / {100 * regret:.1f} %")
        rows.append([criterion, *cells])
    return markdown(["criterion", *(f"{count} passes" for count in passes)], rows) + made_by(data)


def stops(data: dict[str, Any]) -> str:
    """What a run could know of its ranking when its fit stops, and what the ranking is worth: means
    over the states, and in how many states it would have been said to have settled that had not."""
    rows, known = [], [r for r in data["rows"] if "tau_half" in r]
    for criterion in ("d-optimal", "fisherrf", "a-optimal"):
        for passes in sorted({r["passes"] for r in known}):
            of = [r for r in known if (r["criterion"], r["passes"]) == (criterion, passes)]
            half, end, predicted, fell = (
                sum(r[key] for r in of) / len(of)
                for key in ("tau_half", "tau", "predicted_decrease", "found_decrease")
            )
            settled = [r for r in of if r["tau_half"] >= SETTLED]
            wrong = sum(r["tau"] < SETTLED for r in settled)
            cells = [
                f"{100 * predicted:.0f} %",
                f"{100 * fell:.0f} %",
                f"{half:.2f}",
                f"{end:.2f}",
                f"{wrong} of {len(settled)}",
            ]
            rows.append([f"{criterion}, {passes} passes", *cells])
    heading = [
        "",
        "Phi will fall by, predicted",
        "found",
        "tau with half the passes",
        "with 4,000 passes",
    ]
    heading.append(f"of those with at least {SETTLED:g} at half, below it in the end")
    return markdown(heading, rows) + made_by(data)


SETTLED = 0.95
"""Kendall's tau from which on a ranking might be said to have settled: the target of
docs/fit.md."""


def noise_ranking(data: dict[str, Any]) -> str:
    """Agreement of rankings under other assumptions with the default's, over the states."""
    rows, names = [], {"sigma": "sigma = {:g}", "alpha in F": "alpha in F, weight {:g}"}
    names |= {what: f"{what}, weight {{:g}}" for what in ("alpha in lambda", "alpha in the fit")}
    for assumption, name in names.items():
        for number in dict.fromkeys(
            r["number"] for r in data["records"] if r["assumption"] == assumption
        ):
            of = [
                r for r in data["records"] if (r["assumption"], r["number"]) == (assumption, number)
            ]
            tau, regret = (sum(r[key] for r in of) / len(of) for key in ("tau", "regret"))
            regrets, same = (
                f"{100 * regret:.1f} % ({100 * max(r['regret'] for r in of):.1f})",
                sum(r["same"] for r in of),
            )
            rows.append([name.format(number), f"{tau:.2f}", regrets, f"{same} of {len(of)}"])
    heading = [
        "assumption",
        "Kendall's tau with the default",
        "regret, mean (worst)",
        "the same view",
    ]
    return markdown(heading, rows) + made_by(data)


def assumed_noise(data: dict[str, Any]) -> str:
    """What another assumed noise does to runs: means over the rocks, and differences from the
    default."""
    records, keys = data["records"], ("psnr", "psnr_mask")
    usual = {r["dataset"]: r for r in records if r["where"] == "as it is"}
    rows = []
    for where, fit_noise, score_noise in dict.fromkeys(
        (r["where"], r["fit"], r["score"]) for r in records
    ):
        of = [
            r
            for r in records
            if (r["where"], r["fit"], r["score"]) == (where, fit_noise, score_noise)
        ]
        means = [sum(r[key] for r in of) / len(of) for key in keys]
        more = [sum(r[key] - usual[r["dataset"]][key] for r in of) / len(of) for key in keys]
        cells = [
            f"{mean:.2f} ({difference:+.2f})" for mean, difference in zip(means, more, strict=True)
        ]
        residuals = [r["residual"] for r in of]
        cells.append(f"{min(residuals):.3f} to {max(residuals):.3f}")
        noise = score_noise if where == "in the score" else fit_noise
        rows.append(
            [f"{noise:g} {where}" if where != "as it is" else f"{noise:g}, as it is", *cells]
        )
    heading = [
        "noise assumed",
        "test views (dB)",
        "rock",
        "residual of new images, median of a run",
    ]
    return markdown(heading, rows) + made_by(data)


def surface(data: dict[str, Any]) -> str:
    """PSNR and how much of a surface a model is, with the backing and without, and with what else
    could keep it one."""
    rows = []
    for what in dict.fromkeys(r["what"] for r in data["means"]):
        cells = []
        for backing in dict.fromkeys(r["backing"] for r in data["means"]):
            r = next(r for r in data["means"] if (r["what"], r["backing"]) == (what, backing))
            cells += [f"{r['psnr']:.2f}, {r['psnr_inside']:.2f}"]
            cells += [", ".join(f"{100 * r[key]:.1f} %" for key in ("too_deep", "see_through"))]
        (low, high), (least, most) = (
            r["gain"],
            r["gain_inside"],
        )  # with the backing, which comes last
        rows.append([what, *cells, f"{low:+.2f} to {high:+.2f}", f"{least:+.2f} to {most:+.2f}"])
    heading = ["", "all on the surface: PSNR, inside (dB)", "too deep, see-through"]
    heading += [
        "a third behind: PSNR, inside",
        "too deep, see-through",
        "gain by rock",
        "gain inside",
    ]
    return markdown(heading, rows) + made_by(data)


def truth(data: dict[str, Any]) -> str:
    """PSNR on test views of fits to several truths, judged by two of them."""
    judges = [(judge, part) for judge in ("alpha", "mask") for part in ("", ", inside")]
    rows = []
    for record in data["records"]:
        scene = "boulder" if record["dataset"].startswith("demo") else "contact binary"
        rows.append(
            [
                f"{scene}: {record['fitted']}",
                *(f"{record[judge + part]:.2f}" for judge, part in judges),
            ]
        )
    named = [
        f"judged by {judge}, {'rock' if part else 'full frame'} (dB)" for judge, part in judges
    ]
    return markdown(["fitted to", *named], rows) + made_by(data)


def linearity(data: dict[str, Any]) -> str:
    """Departure from linear of moves of several sizes on each scene; of added views the mean."""
    scenes = data["scenes"]
    records = next(iter(scenes.values()))
    factors = sorted({r["factor"] for r in records})
    rows = []
    for passes in dict.fromkeys(r["passes"] for r in records):
        for move in dict.fromkeys(r["move"] for r in records):
            cells = []
            for factor in factors:
                found = []
                for of in scenes.values():
                    same = [
                        r["departure"]
                        for r in of
                        if (r["passes"], r["move"], r["factor"]) == (passes, move, factor)
                    ]
                    found += [f"{sum(same) / len(same):.2g}"] if same else []
                cells.append(", ".join(found))
            rows.append([f"{move}, after {passes} passes", *cells])
    heading = [f"move: {', '.join(scenes)}", *(f"times {factor:g}" for factor in factors)]
    return markdown(heading, rows) + made_by(data)


UNITS = {
    "pose noise": "degrees", "image noise": "of the range", "exposure": "stops", "motion blur": "pixels", "defocus": "pixels",
    "shifted mask": "pixel", "wrong mask": "pixel", "noisy prior": "spacings", "smoothed prior": "rounds",
    "holes": "of the surface", "shifted prior": "m", "scaled prior": "times", "turned prior": "degrees",
}  # fmt: skip
"""Units of the faults' sizes."""


def alpha_faults(data: dict[str, Any]) -> str:
    """What alpha as a channel brings where data are wrong: mean PSNR without, and the gain on each
    rock from least to most."""
    scenes = list(data["scenes"].values())
    rows = []
    for fault in dict.fromkeys(r["fault"] for r in scenes[0]):
        pairs = [[r for r in records if r["fault"] == fault] for records in scenes]
        size = pairs[0][0]["size"]
        row = [f"{fault}, {size:g} {UNITS[fault]}" if size else fault]
        for key in ("psnr", "psnr_mask"):
            gains = [given[key] - without[key] for without, given in pairs]
            mean = sum(without[key] for without, _ in pairs) / len(pairs)
            row += [f"{mean:.2f}", f"{min(gains):+.2f} to {max(gains):+.2f}"]
        rows.append(row)
    heading = [
        f"{len(scenes)} rocks",
        "colours alone, full frame (dB)",
        "gain by rock",
        "rock only (dB)",
        "gain by rock",
    ]
    return markdown(heading, rows) + made_by(data)


def alpha_policies(data: dict[str, Any]) -> str:
    """Policies with alpha in the fit and without, and by how much each is ahead of even spacing
    either way."""
    records = data["records"]
    found = {(r["rock"], r["policy"], r["alpha_weight"] > 0): r["test_psnr"] for r in records}
    rocks = list(dict.fromkeys(r["rock"] for r in records))
    rows = []
    for policy in dict.fromkeys(r["policy"] for r in records):
        means = [
            sum(found[rock, policy, alpha] for rock in rocks) / len(rocks)
            for alpha in (False, True)
        ]
        gains = [found[rock, policy, True] - found[rock, policy, False] for rock in rocks]
        row = [
            policy,
            *(f"{mean:.2f}" for mean in means),
            f"{min(gains):+.2f} to {max(gains):+.2f}",
        ]
        for alpha in (False, True):
            ahead = [found[rock, policy, alpha] - found[rock, "uniform", alpha] for rock in rocks]
            low, high = interval(ahead) or (0.0, 0.0)
            row.append(
                ""
                if policy == "uniform"
                else f"{sum(ahead) / len(ahead):+.2f} [{low:+.2f}, {high:+.2f}]"
            )
        of_uniform = [
            found[rock, "uniform", True] - found[rock, "uniform", False] for rock in rocks
        ]
        changes = [gain - other for gain, other in zip(gains, of_uniform, strict=True)]
        low, high = interval(changes) or (0.0, 0.0)
        row.append(
            ""
            if policy == "uniform"
            else f"{sum(changes) / len(changes):+.2f} [{low:+.2f}, {high:+.2f}]"
        )
        rows.append(row)
    heading = [f"{len(rocks)} rocks", "colours alone (dB)", "with alpha (dB)", "gain by rock"]
    return markdown(
        [*heading, "over even spacing, colours alone", "the same, with alpha", "change"], rows
    ) + made_by(data)


def prior_std(data: dict[str, Any]) -> str:
    """Quality and shape of the surface against the prior's standard deviations."""
    rows = []
    for r in data["records"]:
        which = "" if len(r["kinds"]) == 4 else f" for {' and '.join(r['kinds'])}"
        cells = [
            f"{r[key]:.2f}" for key in ("psnr", "psnr_inside", "test_psnr", "test_psnr_inside")
        ]
        cells += [f"{100 * r[key]:.1f} %" for key in ("too_deep_3", "see_through", "needles")]
        rows.append([f"tau x {r['factor']:g}{which}, {r['passes']} passes", *cells])
    heading = [
        "",
        "held out, dB",
        "inside",
        "test views",
        "inside",
        "too deep",
        "see-through",
        "needles",
    ]
    return markdown(heading, rows) + made_by(data)


def inset(data: dict[str, Any]) -> str:
    """Quality and error of depth against how far below the surface Gaussians lie."""
    rows = []
    depths = list(dict.fromkeys(r["inset"] for scene in data["scenes"] for r in scene["records"]))
    for k, scene in enumerate(data["scenes"]):
        for n in dict.fromkeys(r["gaussians"] for r in scene["records"]):
            found = [r for r in scene["records"] if r["gaussians"] == n]
            cells = [
                f"{r['psnr']:.2f}, {r['psnr_inside']:.2f}, {1e3 * r['depth_error']:.0f}"
                for r in found
            ]
            about = f"rock {k + 1}, {n:,}, {1e3 * found[0]['pixel']:.0f} mm, {1e3 * found[0]['spacing']:.0f} mm"
            rows.append([about, *cells])
    return markdown(
        ["rock, Gaussians, pixel, spacing", *(f"{d:g} pixels" for d in depths)], rows
    ) + made_by(data)


def warm_colours(data: dict[str, Any]) -> str:
    """Quality by the colours in which fits start, for numbers of seeds and of images: means over
    the rocks."""
    records = [r for scene in data["scenes"] for r in scene["records"]]
    rows = []
    for seeds in dict.fromkeys(r["seeds"] for r in records):
        for way in dict.fromkeys(r["way"] for r in records):
            cells = []
            for images in dict.fromkeys(r["images"] for r in records):
                found = [
                    r
                    for r in records
                    if (r["seeds"], r["way"], r["images"]) == (seeds, way, images)
                ]
                cells.append(
                    ", ".join(
                        f"{sum(r[key] for r in found) / len(found):.2f}"
                        for key in ("psnr", "psnr_mask")
                    )
                )
            rows.append([f"{seeds}, {way}", *cells])
    images = [f"{n} images" for n in dict.fromkeys(r["images"] for r in records)]
    return markdown(["seeds, start of a fit", *images], rows) + made_by(data)


def optimisers(data: dict[str, Any]) -> str:
    """Objective and quality by the number of passes and seconds, for each number of Gaussians, cold
    and warm; where there are many points, every fourth."""
    rows: dict[tuple[str, str, str], list[str]] = {}
    for r in sorted(data["records"], key=lambda r: (r["gaussians"], r["start"])):
        cell = f"{r['passes']:.0f} ({r['seconds']:.1f} s): {r['phi']:.0f}, {r['psnr_inside']:.2f}"
        rows.setdefault((f"{r['gaussians']:,}", r["start"], r["row"]), []).append(cell)
    shown = {key: cells if len(cells) < 10 else cells[3::4] for key, cells in rows.items()}
    lines = "".join(f"| {' | '.join(key)} | {'; '.join(cells)} |\n" for key, cells in shown.items())
    heading = "| Gaussians | start | optimiser | passes (seconds): Phi, PSNR inside (dB) |\n| ---: | --- | --- | --- |\n"
    return heading + lines + made_by(data)


def fit(data: dict[str, Any]) -> str:
    """What a fit comes to, beside what is asked for."""
    rows = []
    for name, (bound, target) in FIT_TARGETS.items():
        value = data["figures"][name]
        measured = "not reached" if value is None else f"{value:.3g}"
        n, key = ON_TEST_VIEWS.get(name, (0, ""))
        test = f"{data['test'][str(n)][key]:.3g}" if key else "–"
        rows.append([FIT_FIGURES[name], measured, test, f"{bound} {target:.3g}"])
        if name == "ranking_tau":
            rows.append(
                [
                    "the same with that of half the passes",
                    f"{data['ranking_tau_half']:.3g}",
                    "–",
                    "–",
                ]
            )
    return markdown(
        ["figure", "measured", "the same on the test views", "asked for"], rows
    ) + made_by(data)


ON_TEST_VIEWS = {
    "psnr_held_out": (10_000, "psnr"),
    "psnr_inside_10k": (10_000, "psnr_inside"),
    "psnr_inside_20k": (20_000, "psnr_inside"),
    "too_deep_3_spacings": (10_000, "too_deep_3"),
    "see_through": (10_000, "see_through"),
}
"""Number of Gaussians and metric of the figures that are measured on the test views, too."""


FIT_FIGURES = {
    "psnr_held_out": "PSNR of views held out, full frame (dB)",
    "psnr_inside_10k": "the same inside the rock, 10,000 Gaussians (dB)",
    "psnr_inside_20k": "20,000 Gaussians (dB)",
    "too_deep_3_spacings": "share of pixels more than 3 spacings too deep",
    "see_through": "share of pixels inside the rock with alpha below 0.9",
    "ranking_tau": "Kendall's tau of the ranking with that of a fit ten times as long",
    "ranking_regret": "regret of the view chosen, share of the best gain",
    "predicted_over_found_decrease": "predicted decrease of Phi over the one found",
    "seconds_to_old_objective_cold": "time to the Phi of 400 passes of Adam, over the time of these, from the prior",
    "seconds_to_old_objective_warm": "the same with one view added",
}
"""What is said of each figure of `mgs bench fit`."""


def means(data: dict[str, Any]) -> str:
    """PSNR inside the rock and distance from the true surface, by how the means are learned and how
    noisy the prior is."""
    rows = []
    for views, noise in dict.fromkeys((r["views"], r["noise"]) for r in data["records"]):
        found = {
            r["means"]: r for r in data["records"] if (r["views"], r["noise"]) == (views, noise)
        }
        before = f"{1e3 * found['frozen']['distance_before']:.1f} mm"
        cells = [
            f"{found[m]['psnr_inside']:.2f} dB, {1e3 * found[m]['distance_after']:.1f} mm"
            for m in found
        ]
        prior = "visual hull" if noise == "hull" else f"noise of {noise:g} spacings"
        rows.append([f"{views} views, {prior}", before, *cells])
    return markdown(["", "prior", *found], rows) + made_by(data)


def residual(data: dict[str, Any]) -> str:
    """Quality against the weights of pixels in the fit."""
    keys, rows = ("psnr", "psnr_mask", "psnr_inside"), []
    linear = data["records"][0]
    for r in data["records"]:
        cells = []
        for key in keys:
            gains = [a - b for a, b in zip(r["each"][key], linear["each"][key], strict=True)]
            cells.append(
                f"{r[key]:.2f}"
                if r is linear
                else f"{r[key]:.2f} ({min(gains):+.2f} to {max(gains):+.2f})"
            )
        rows.append([r["name"], r["background"], *cells])
    return markdown(
        ["weight of a pixel", "background", "full frame", "mask", "inside"], rows
    ) + made_by(data)


TABLES: dict[str, tuple[str, Callable[[Any], str]]] = {
    "ranking": ("benchmarks/ranking", ranking),
    "stops": ("benchmarks/ranking", stops),
    "noise-ranking": ("benchmarks/noise_ranking", noise_ranking),
    "assumed-noise": ("benchmarks/assumed_noise", assumed_noise),
    "surface": ("benchmarks/surface", surface),
    "truth": ("benchmarks/truth", truth),
    "linearity": ("benchmarks/linearity", linearity),
    "alpha-faults": ("benchmarks/alpha_faults", alpha_faults),
    "alpha-policies": ("benchmarks/alpha_policies", alpha_policies),
    "residual": ("benchmarks/residual", residual),
    "prior-std": ("benchmarks/prior_std", prior_std),
    "inset": ("benchmarks/inset", inset),
    "warm-colours": ("benchmarks/warm_colours", warm_colours),
    "optimisers": ("benchmarks/optimisers", optimisers),
    "fit": ("benchmarks/fit", fit),
    "fit-colours": ("benchmarks/fit_colours", fit),
    "means": ("benchmarks/means", means),
}
"""By name: the file, seen from docs/ and without `.json`, and what makes the table of its
contents."""
