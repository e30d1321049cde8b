"""Every command of the `mgs` program, in the order of the pipeline."""

from __future__ import annotations

from collections.abc import Callable

from mgs.commands.bench import bench
from mgs.commands.dataset import dataset
from mgs.commands.demo import demo
from mgs.commands.diagnose import diagnose
from mgs.commands.doctor import doctor
from mgs.commands.evaluate import evaluate
from mgs.commands.import_data import import_data
from mgs.commands.nbv import nbv
from mgs.commands.prior import prior
from mgs.commands.render import render
from mgs.commands.report import report
from mgs.commands.survey import survey
from mgs.commands.synth_orbit import synth_orbit

COMMANDS: dict[str, Callable[..., None]] = {
    "doctor": doctor,
    "synth-orbit": synth_orbit,
    "dataset": dataset,
    "import": import_data,
    "survey": survey,
    "prior": prior,
    "nbv": nbv,
    "eval": evaluate,
    "diagnose": diagnose,
    "report": report,
    "render": render,
    "demo": demo,
    "bench": bench,
}

_AGAIN = "run the same command again to continue"
GOES_ON = {
    "synth-orbit": _AGAIN,
    "import": _AGAIN,
    "demo": _AGAIN,
    "nbv": "`mgs nbv --resume RUN` continues a run whose folder is there",
}
"""What a person is told after Ctrl-C, by command. The others start anew: they write at the end, or write the same again."""
