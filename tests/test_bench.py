"""`python -m studies.bench`: what is timed and written."""

import pytest
import tiny
from program import study
from refusals import refused

from mgs.files import read_json
from studies import bench as core


def test_cold_keeps_no_lists(monkeypatch):
    gaussians = tiny.initial([])
    camera, cold, draw = core.surface_camera(gaussians, 32, 24), [], core.render

    def watched(gaussians, camera, cache=None):
        if cache is None:
            cold.append(camera)
        return draw(gaussians, camera, cache=cache)

    monkeypatch.setattr(core, "render", watched)
    core.time_core(gaussians, camera, 3)
    assert len(cold) == 3 + core.WARM_UP


@pytest.mark.slow
def test_times_every_operation_and_writes_json(capsys, tmp_path):
    json = tmp_path / "a b.json"
    arguments = ["--gaussians", "1000", "--repeats", "3", "--json", str(json)]
    study("bench", *arguments)
    written = read_json(json)
    line = f"python -m studies.bench --gaussians 1000 --repeats 3 --json '{json}'"
    assert written["command"] == line
    own = {"forward_cold", "forward_warm", "gradient_warm", "fisher_exact", "fisher_block"}
    assert set(written["seconds"]) == own | {"volprim_forward", "volprim_gradient"}
    assert all(value > 0 for value in [*written["seconds"].values(), *written["ratios"].values()])
    assert "forward warm speedup" in capsys.readouterr().out
    assert "is there already" in refused(capsys, ["--json", json], tmp_path, "bench")
