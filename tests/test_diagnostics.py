"""Maps of information: scalars by their formulas, maps by a direct composite, files read back."""

import numpy as np
import pytest
import tiny
from PIL import Image
from plyfile import PlyData
from refusals import fails
from synthetic import pinhole

from mgs import Camera, Checkpoint, Run, groups, load_dataset, look_at
from mgs.gaussians import Gaussians, sh_from_rgb
from mgs.images import read_exr
from mgs.policy import criteria
from mgs.reports import diagnostics
from mgs.run import folder as run_folder
from mgs.run.settings import NbvSettings

CHANNELS = {
    "R", "G", "B", "A", "Z", "fisher.colour", "fisher.scale", "fisher.rotation", "fisher.opacity",
    "information", "uncertainty", "unobserved",
}  # fmt: skip


def test_scalars_follow_their_formulas(tmp_path):
    rng = np.random.default_rng(0)
    H, lam = rng.random((5, 11)) * 10, criteria.regularisation(groups(0))
    H[2] = 0
    surface = np.ones((5, 11))
    surface[4] = 1e-5
    gaussians = Gaussians(*(np.zeros(shape) for shape in ((5, 3), (5, 3), (5, 4), 5, (5, 1, 3))))
    run = Run(tmp_path, NbvSettings(dataset=tmp_path, prior=tmp_path))
    run.state = Checkpoint(gaussians, H, surface, [], [], {})
    scalars = diagnostics.run_scalars(run)
    np.testing.assert_allclose(scalars["fisher.scale"], H[:, 3] + H[:, 4] + H[:, 5])
    np.testing.assert_allclose(scalars["fisher.opacity"], H[:, 10])
    assert scalars["information"][2] == 0
    assert scalars["uncertainty"][2] == 1
    assert scalars["unobserved"].tolist() == [0, 0, 0, 0, 1]
    j = 3
    expected = sum(0.5 * np.log((H[j, k] + lam[k]) / lam[k]) for k in range(11))
    assert scalars["information"][j] == pytest.approx(expected)
    expected = np.mean([lam[k] / (H[j, k] + lam[k]) for k in range(11)])
    assert scalars["uncertainty"][j] == pytest.approx(expected)


def two_in_a_row() -> tuple[Gaussians, Camera]:
    """Two Gaussians, 20 pixels wide, at 2 m and 3 m; the near one is half transparent."""
    means, scales, quats = [[0, 0, 0], [0, 1, 0]], np.zeros((2, 3)), np.eye(4)[[0, 0]]
    parts = (np.array(part, np.float32) for part in (means, scales, quats, [0, 9]))
    return Gaussians(*parts, sh_from_rgb(np.ones((2, 3)))), pinhole(40.0, 33, 25, (0, -2, 0))


def test_maps_are_means_over_what_a_pixel_shows():
    """At the centre both weigh about 1/2: the map is the mean of any two values."""
    gaussians, camera = two_in_a_row()
    values = {"information": (1e-4, 3e-4), "large": (4e6, 0), "flat": (7.0, 7.0)}
    scalars = {name: np.array(pair) for name, pair in values.items()}
    maps = diagnostics.view_maps(gaussians, camera, scalars)
    near, far = 0.5, 0.5 * (1 / (1 + np.exp(-9.0)))
    assert maps["A"][12, 16] == pytest.approx(near + far, abs=1e-3)
    mean = (1e-4 * near + 3e-4 * far) / (near + far)
    assert maps["information"][12, 16] == pytest.approx(mean, rel=1e-3)
    assert maps["large"][12, 16] == pytest.approx(4e6 * near / (near + far), rel=1e-3)
    np.testing.assert_allclose(maps["flat"][maps["A"] > 0.1], 7.0, rtol=1e-4)
    assert maps["Z"][12, 16] == pytest.approx((2 * near + 3 * far) / (near + far), rel=1e-3)


@pytest.mark.parametrize("near", [0.0, 1.0])
def test_a_pixel_is_unobserved_where_most_of_its_weight_is(near):
    """The near one, more opaque than not, decides."""
    gaussians, camera = two_in_a_row()
    gaussians.logit_opacities[0] = 1
    maps = diagnostics.view_maps(gaussians, camera, {"unobserved": np.array([near, 1 - near])})
    assert maps["unobserved"][12, 16] == near


def test_maps_of_an_empty_view_are_zero(tmp_path, figures):
    gaussians, camera = two_in_a_row()
    away = Camera(camera.K, 33, 25, look_at((0, -2, 0), (0, -3, 0)))
    scalars = {name: np.ones(2) for name in diagnostics.PANELS if name != "Z"}
    maps = diagnostics.view_maps(gaussians, away, scalars)
    assert all((values == 0).all() for values in maps.values())
    diagnostics.write_preview(tmp_path / "empty.png", maps, "empty")
    assert (tmp_path / "empty.png").is_file()


def test_files(whole, figures):
    written = diagnostics.diagnose(whole, ["kf_0007"])
    assert [path.name for path in written] == ["information.ply", "kf_0007.exr", "kf_0007.png"]
    channels = read_exr(whole / "diagnostics/kf_0007.exr")
    assert set(channels) == CHANNELS
    assert {values.shape for values in channels.values()} == {(tiny.HEIGHT, tiny.WIDTH)}
    assert channels["A"].max() > 0.3
    assert channels["information"].max() > 0
    with Image.open(whole / "diagnostics/kf_0007.png") as picture:
        picture.load()
    assert (whole / "diagnostics/kf_0007.png").stat().st_size < 400_000
    vertices = PlyData.read(str(whole / "diagnostics/information.ply"))["vertex"]
    state = run_folder.read_checkpoint(whole)
    assert len(vertices.data) == tiny.POINTS
    assert vertices["red"].dtype == np.uint8
    np.testing.assert_allclose(vertices["fisher_opacity"], state.H[:, 10], rtol=1e-6)
    np.testing.assert_allclose(np.stack([vertices[a] for a in "xyz"], 1), state.gaussians.means)


def test_views(whole):
    frames = load_dataset(run_folder.open_run(whole).settings.dataset).frames
    state = run_folder.read_checkpoint(whole)
    trained = [frames[i].name for i in state.taken]
    chosen = diagnostics.choose_views(frames, trained, None)
    assert len(chosen) == diagnostics.VIEWS
    assert not {frame.name for frame in chosen} & set(trained)
    everything = [frame.name for frame in frames]
    assert len(diagnostics.choose_views(frames, everything, None)) == diagnostics.VIEWS
    named = "kf_9999: no such frame; the dataset has kf_0000 to kf_0011"
    fails(named, diagnostics.diagnose, whole, ["kf_9999"])


@pytest.mark.parametrize("count", [3, 8])
def test_gaussians_of_a_density_control_are_as_unobserved_as_the_nearest_sample(tmp_path, count):
    """They are fewer or more than the samples, in another order."""
    rng, here = np.random.default_rng(0), tiny.prior()
    rows = rng.permutation(len(here.points))[:count]
    shapes = (count, 3), (count, 4), count, (count, 1, 3)
    means = here.points[rows].astype(np.float32)
    gaussians = Gaussians(means, *(np.zeros(shape, np.float32) for shape in shapes))
    surface = np.ones((len(here.points), 11))
    surface[rows[0]] = 0
    settings = {"dataset": tmp_path, "prior": tmp_path, "budget": 0}
    run = Run(tmp_path, NbvSettings(**settings, train={"means": "free", "density": "split"}))
    run.state, run.prior = Checkpoint(gaussians, np.ones((count, 14)), surface, []), here
    run.settings.prior_std["mean"] = 1.0
    assert diagnostics.run_scalars(run)["unobserved"].tolist() == [1] + [0] * (count - 1)
