"""`mgs bench`: what is timed and written."""

import numpy as np
import pytest
import tiny

from mgs import bench as core
from mgs.cli.app import main
from mgs.files import read_json


def test_cold_renders_a_new_view_in_each_call(monkeypatch):
    gaussians = tiny.initial([])
    camera, seen, draw = core.surface_camera(gaussians, 32, 24), [], core.render

    def watched(gaussians, camera, cache=None):
        if cache is None:
            seen.append(camera)
        return draw(gaussians, camera, cache=cache)

    monkeypatch.setattr(core, "render", watched)
    core.time_core(gaussians, camera, 3)
    poses = {c.world_to_camera.tobytes() for c in [camera, *seen]}
    assert len(seen) == 3 + core.WARM_UP
    assert len(poses) == len(seen) + 1
    centre = (gaussians.means.min(axis=0) + gaussians.means.max(axis=0)) / 2
    for other in seen:
        assert np.array_equal(other.K, camera.K)
        np.testing.assert_allclose(
            other.world_to_camera @ [*centre, 1], camera.world_to_camera @ [*centre, 1], atol=1e-6
        )
        assert other.position[2] == pytest.approx(camera.position[2])


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
