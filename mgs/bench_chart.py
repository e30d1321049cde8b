"""The scaling chart: log-log, with fitted exponents. Reads records only, measures nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.bench import exponent
from mgs.figures import new_figure, save_figure

OPERATIONS = {
    "forward_warm": ("forward, warm", "#0072b2", "o"),
    "forward_cold": ("forward, cold", "#56b4e9", "s"),
    "gradient_warm": ("forward + adjoint", "#d55e00", "^"),
    "fisher_exact": ("exact Fisher", "#009e73", "D"),
    "fisher_block": ("block Fisher", "#cc79a7", "v"),
}


def scaling_exponents(points: list[dict[str, Any]]) -> dict[str, float]:
    """Fitted growth of each operation in N (from 10,000 up), pixels, and (splat, block) pairs at equal N
    (the image sizes; with N the O(N) projection grows too); and of peak memory in N."""
    by_n = [p for p in points if p["sweep"] == "gaussians" and p["n"] >= 10_000] or points
    by_pixels = [p for p in points if p["sweep"] == "pixels"]
    found = {}
    for name, (label, _, _) in OPERATIONS.items():
        found[f"{label} against N"] = exponent([p["n"] for p in by_n], [p[name] for p in by_n])
        found[f"{label} against pixels"] = exponent([p["pixels"] for p in by_pixels], [p[name] for p in by_pixels])
        found[f"{label} against pairs"] = exponent([p["pairs"] for p in by_pixels], [p[name] for p in by_pixels])
    found["peak memory against N"] = exponent([p["n"] for p in by_n], [p["peak_bytes"] for p in by_n])
    return found


def scaling_figure(path: str | Path, points: list[dict[str, Any]], exponents: dict[str, float]) -> None:
    """Four panels: time against N, pixels and pairs, and memory against N; threads as a note."""
    figure = new_figure(10, 7)
    panels = figure.subplots(2, 2)
    sweeps = [
        ("n", "gaussians", "Gaussians N", "N"),
        ("pixels", "pixels", "pixels", "pixels"),
        ("pairs", "", "(splat, block) pairs (exponents: at equal N)", "pairs"),
    ]
    for axis, (key, sweep, label, short) in zip(panels.flat, sweeps, strict=False):
        chosen = [p for p in points if p["sweep"] == sweep or (not sweep and p["sweep"] != "threads")]
        chosen.sort(key=lambda p: p[key])
        for name, (operation, colour, marker) in OPERATIONS.items():
            text = f"{operation}, exponent {exponents[f'{operation} against {short}']:.2f}"
            line = "-" if sweep else ""
            axis.loglog(
                [p[key] for p in chosen], [1e3 * p[name] for p in chosen], line + marker, color=colour, ms=4, label=text
            )
        axis.set(xlabel=label, ylabel="time, ms")
        axis.tick_params(which="minor", labelsize=6)
        axis.grid(True, which="both", alpha=0.2)
        axis.legend(fontsize=7, frameon=False)
    memory = panels[1, 1]
    chosen = [p for p in points if p["sweep"] == "gaussians"]
    memory.loglog(
        [p["n"] for p in chosen], [p["peak_bytes"] / 1e6 for p in chosen], "o-", color="#444444", label="peak of the kernels"
    )
    memory.loglog(
        [p["n"] for p in chosen],
        [p["list_bytes"] / 1e6 for p in chosen],
        "s-",
        color="#999999",
        label="block lists of one camera",
    )
    memory.set(xlabel="Gaussians N", ylabel="memory, MB")
    memory.grid(True, which="both", alpha=0.2)
    memory.legend(fontsize=7, frameon=False, title=f"exponent {exponents['peak memory against N']:.2f}", title_fontsize=7)
    threads = sorted((p for p in points if p["sweep"] == "threads"), key=lambda p: p["threads"])
    if len(threads) > 1:
        gain = threads[0]["gradient_warm"] / threads[-1]["gradient_warm"]
        figure.suptitle(
            f"{threads[-1]['threads']} threads are {gain:.2f} times as fast as {threads[0]['threads']} (forward + adjoint)",
            fontsize=10,
        )
    save_figure(figure, path)
