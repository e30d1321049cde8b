"""Policies compared over random pools of candidates with random seeds: see `studies.setups`."""

from dataclasses import replace

from studies import setups
from studies.frame.case import ROCKS
from studies.frame.program import WORKERS, study_of

DRAWN = {
    f"drawn {name}": replace(setups.SETUPS[name], frames=72, drawn=True)
    for name in ("hemisphere", "mixed distances")
}
"""Set-ups with as many candidates as those they are named after, of twice as many frames."""

POLICIES = (setups.LEADER, "cover", setups.RANDOM, *setups.BASELINES[1:4])

tables = setups.tables

STUDY = replace(
    setups.STUDY,
    name="pools",
    about="Compare policies as `setups` does, over five random pools with random seeds each.",
    cells=lambda size: setups.cells_of(size, POLICIES, DRAWN),
    options=ROCKS | WORKERS,
    write=lambda work: setups.write(work, "pools", work.cells),
)

if __name__ == "__main__":
    study_of("pools")()
