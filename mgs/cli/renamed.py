"""Options and commands of the last release, which still work in this one and say their new form."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Sequence

from mgs.errors import Notice

SEED = {"--random-seed": "--seed"}
FLIGHT = {
    "--flight-length": "flight.length",
    "--flight-time": "flight.time",
    "--speed": "flight.speed",
    "--hover": "flight.hover",
    "--no-fly": "flight.no_fly",
    "--clearance": "flight.clearance",
}
FIT = SEED | {
    "--antialiased": "train.antialiased=true",
    "--no-antialiased": "train.antialiased=false",
    "--alpha-weight": "train.alpha_weight",
    "--optimiser": "train.optimiser",
    "--rate": "train.rates.",
    "--pixel-noise": "pixel_noise",
    "--prior-std": "prior_std.",
}
OPTIONS = {
    "nbv": FIT
    | FLIGHT
    | {
        "--seed-views": "--seeds",
        "--nearest": "nearest",
        "--travel": "travel",
        "--stop-gain": "stop_gain",
        "--stop-uncertainty": "stop_uncertainty",
        "--stop-psnr": "stop_psnr",
        "--passes": "train.passes",
        "--warm-passes": "warm_passes",
        "--means": "train.means",
        "--sh": "sh",
        "--exposure": "exposure=true",
        "--estimator": "estimator",
        "--lam": "lam",
        "--evaluate-every": "evaluate_every",
        "--capture-timeout": "capture.timeout",
        "--capture-tries": "capture.tries",
        "--capture-failure": "capture.failure",
        "--capture-distance": "capture.distance",
    },
    "fit": FIT | {"--most-gaussians": "train.most_gaussians"},
    "suggest": FLIGHT
    | {
        "--ring": "ring",
        "--grid": "grid",
        "--radius": "radius",
        "--elevations": "elevations",
        "--safe-distance": "safe_distance",
    },
    "prior": SEED | {"--from": "--source"},
    "synth-orbit": SEED,
    "survey": SEED,
    "demo": SEED,
}
"""Command -> its old options -> what replaces them: an option, a setting of --set, its table where
the value was KIND=NUMBER, or a setting with its value where there was none."""


COMMANDS = {"prune": ["simplify"], "refit": ["simplify", "--method", "refit"]}
"""Old commands -> what replaces them."""


def renewed(arguments: Sequence[str]) -> list[str]:
    """Arguments in today's words; warns once for each old option."""
    command, *words = arguments
    if command in COMMANDS:
        _notice(f"mgs {command}", ["mgs", *COMMANDS[command]])
        return [*COMMANDS[command], *words]
    table, result, rest = OPTIONS.get(command, {}), [command], iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        new = table.get(name)
        if new is None:
            result.append(word)
            continue
        if new.startswith("--"):
            now = [new + equals + value]
        elif "=" in new:
            now = ["--set", new]
        else:
            value = value if equals else next(rest, "")
            now = ["--set", f"{new}{value}" if new.endswith(".") else f"{new}={value}"]
        _notice(name, now)
        result += now
    return result


def _notice(old: str, now: list[str]) -> None:
    warnings.warn(
        Notice(f"{old} is now {shlex.join(now)}; it ends with this release"), stacklevel=3
    )
