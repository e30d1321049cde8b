"""Options and commands of the last release, which still work in this one and say their new form."""

import shlex
import warnings
from collections.abc import Iterable, Sequence

from mgs.errors import Notice

FLIGHT = ["flight.length", "flight.time", "flight.speed", "flight.hover", "flight.no_fly"]
FLIGHT.append("flight.clearance")
FIT = ["train.alpha_weight", "train.optimiser", "pixel_noise", "prior_std.", "train.rates."]
FIT += ["train.antialiased=true", "train.antialiased=false"]
NBV = ["nearest", "travel", "stop_gain", "stop_uncertainty", "stop_psnr", "train.passes"]
NBV += ["warm_passes", "train.means", "sh", "exposure=true", "estimator", "lam", "evaluate_every"]
NBV += ["capture.timeout", "capture.tries", "capture.failure", "capture.distance"]
SUGGEST = ["ring", "grid", "radius", "elevations", "safe_distance"]
"""Settings that were options. One with a dot at its end took KIND=NUMBER, one with a value none."""

OTHERS = {
    "flight.length": "--flight-length",
    "flight.time": "--flight-time",
    "capture.timeout": "--capture-timeout",
    "capture.tries": "--capture-tries",
    "capture.failure": "--capture-failure",
    "capture.distance": "--capture-distance",
    "train.rates.": "--rate",
    "train.antialiased=false": "--no-antialiased",
}
"""Settings whose old option was not their last word."""


def _old(keys: Iterable[str]) -> dict[str, str]:
    last = {key: key.partition("=")[0].strip(".").rpartition(".")[2] for key in keys}
    return {OTHERS.get(key, f"--{word.replace('_', '-')}"): key for key, word in last.items()}


SEED = {"--random-seed": "--seed"}
OPTIONS = {
    "nbv": SEED | {"--seed-views": "--seeds"} | _old([*FIT, *FLIGHT, *NBV]),
    "fit": SEED | _old([*FIT, "train.most_gaussians"]),
    "suggest": _old([*FLIGHT, *SUGGEST]),
    "prior": SEED | {"--from": "--source"},
    **dict.fromkeys(("synth-orbit", "survey", "demo"), SEED),
}
"""Command -> its old options -> an option or a setting, of the forms above, that replaces them."""


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
    said = f"{old} is now {shlex.join(now)}; it ends with this release"
    warnings.warn(Notice(said), stacklevel=3)
