"""The six set-ups with free means: does the ranking of policies change?

    mgs reproduce OUT --only setups --rocks 12
    python benchmarks/free_means.py OUT ROCK [ROCK ...]

Reads datasets and priors of OUT. Prints a line for each rock, set-up and policy: PSNR on the test
views and inside the rock, dB. `paper` has no information about means and is left out.
"""

import sys
from pathlib import Path

from mgs import runtime

runtime.start()
from mgs.prior.build import load_prior  # noqa: E402
from mgs.run import settings as run_settings  # noqa: E402
from mgs.study import setups  # noqa: E402
from mgs.study.rocks import FRESH  # noqa: E402

POLICIES = ("directional-i", "d-optimal", "coverage", "cover", "farthest", "uniform", "random")

root, names = Path(sys.argv[1]), sys.argv[2:]


class Free(run_settings.NbvSettings):
    """Settings whose means are free, with the prior's spacing."""

    def __new__(cls, **given):
        given["train"] = {**given["train"], "means": "free"}
        spacing = load_prior(given["prior"]).spacing
        return run_settings.NbvSettings(**given).with_spacing(spacing)


setups.NbvSettings = Free
size = setups.SetupSize()
for rock in (rock for rock in FRESH if rock.name in names):
    for name in setups.SETUPS:
        for cell in setups.cells_of(size, [rock], POLICIES, {name: setups.SETUPS[name]}):
            if not cell.name.startswith("setup/"):
                continue
            of = setups.choose_and_judge(root, root, **cell.arguments)
            policy = cell.arguments["settings"]["policy"]
            numbers = f"{of['test']:.3f} {of['test_mask']:.3f}"
            print(f"{rock.name},{name},{policy},{numbers.replace(' ', ',')}", flush=True)
