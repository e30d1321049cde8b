"""`mgs bench`: what is timed and written."""

import pytest
import tiny

from mgs import bench as core
from mgs.cli.app import main
from mgs.files import read_json


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
def test_times_every_operation_and_writes_json(monkeypatch, capsys, tmp_path):
    json = tmp_path / "a b.json"
    arguments = ["bench", "--gaussians", "1000", "--repeats", "3", "--json", str(json)]
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/mgs", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    written = read_json(json)
    assert written["command"] == f"mgs bench --gaussians 1000 --repeats 3 --json '{json}'"
    own = {"forward_cold", "forward_warm", "gradient_warm", "fisher_exact", "fisher_block"}
    assert set(written["seconds"]) == own | {"volprim_forward", "volprim_gradient"}
    assert all(value > 0 for value in [*written["seconds"].values(), *written["ratios"].values()])
    assert "forward warm speedup" in capsys.readouterr().out
