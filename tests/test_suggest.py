"""`mgs suggest`: candidates, ranks, plans; flight plans read by a parser that is not ours."""

import json
import math
import shutil
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import synthetic
from matplotlib.figure import Figure
from program import command, output, said
from pymavlink import mavutil, mavwp
from refusals import refused

import mgs
from mgs import Prior, load_cameras, load_dataset, open_run
from mgs.camera import Camera, heading_and_pitch, look_at
from mgs.data import flight_plan
from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.meshes import distances_to_mesh
from mgs.data.world import World, unit_up
from mgs.progress import listening
from mgs.reports.suggestion import _from_above, numbers, write_suggestion
from mgs.run.candidates import Site, hidden, inside, place_poses, read_poses, refusals
from mgs.run.nbv import start_fit
from mgs.run.settings import FlightLimits
from mgs.run.suggest import coarse_prior, suggest


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of three seeds on one side of an ellipsoid, of 14 poses on a circle of 2.6 m."""
    folder = tmp_path_factory.mktemp("suggest")
    data = synthetic.write_rock(folder / "data", synthetic.orbit_cameras(14, 48, 36)[:8], 300)
    mgs.run_nbv(data.root, folder / "run", seeds=8, budget=0)
    return folder / "run"


@pytest.fixture(scope="module")
def site(run):
    opened = open_run(run)
    return Site(opened.prior, opened.taken[0].camera)


def test_the_best_candidate_sees_what_no_image_shows(run, site):
    """The images are on one half of the circle; the best of a ring is on the other."""
    found = suggest(open_run(run), place_poses("ring", 12, 2.6, (25, 35), site))
    best, worst = found.ranking[0], found.ranking[-1]
    assert 180 < best.azimuth < 360
    assert best.unknown > worst.unknown
    scores = [view.score for view in found.ranking]
    assert scores == sorted(scores, reverse=True)
    assert [view.name for view in found.plan] == [best.name]
    assert best.information_gain == pytest.approx(found.plan[0].information_gain)


def test_views_are_planned_together_and_flown_in_a_short_order(run, site):
    opened, ring = open_run(run), place_poses("ring", 12, 2.6, (25, 35), site)
    found = suggest(opened, ring, 4)
    assert sorted(view.planned for view in found.plan) == [1, 2, 3, 4]
    chosen = sorted(found.plan, key=lambda view: view.planned)
    alone = {view.name: view.information_gain for view in found.ranking}
    assert all(view.information_gain < alone[view.name] for view in chosen[1:])
    azimuths = [view.azimuth for view in found.plan]
    assert azimuths in (sorted(azimuths), sorted(azimuths, reverse=True))
    limits = {"length": 0.8 * found.metres}
    short = suggest(opened, ring, 12, flight=limits)
    assert 0 < len(short.plan) < 12
    assert short.metres <= 0.8 * found.metres
    assert suggest(opened, ring, 12, flight=FlightLimits(**limits)).metres == short.metres


def test_refined_poses_gain_within_the_limits(run, site, tmp_path, monkeypatch):
    """Every limit binds for some view: band, distance from the mesh, length of the flight. Walls
    are looked for again at each pose that is tried, and progress does not say so."""
    stages, cloud = [], tmp_path / "sparse.ply"
    write_cloud(cloud, SparseCloud(np.random.default_rng(0).normal((0, 0, -40), size=(60, 3))))
    monkeypatch.setattr("mgs.run.suggest.CLOUD", cloud)
    opened, ring = open_run(run), place_poses("ring", 12, 2.6, (25, 35), site)
    before, mesh = suggest(opened, ring, 3), opened.prior.mesh

    def apart(plan) -> float:
        eyes = np.array([view.camera.position for view in plan])
        return distances_to_mesh(eyes, mesh.vertices, mesh.faces).min()

    safe, most = apart(before.plan) - 0.02, 1.001 * before.metres
    limits = {"safe_distance": safe, "elevations": (29.0, 31.0), "flight": {"length": most}}
    with listening(lambda stage, *_: stages.append(stage)):
        found = suggest(opened, ring, 3, refine=True, **limits)
    walls = [k for k, stage in enumerate(stages) if stage == "looking for walls"]
    assert len(walls) == 8
    assert walls[-1] < stages.index("moving the poses")
    assert found.refined[1] > found.refined[0]
    assert apart(found.plan) >= safe
    assert found.metres <= most
    poses = dict(ring)
    for view in found.plan:
        shift = view.camera.position - poses[view.name].position
        assert view.moved == pytest.approx(np.linalg.norm(shift))
        assert 0.01 < view.moved <= 0.26 + 1e-9
        assert 29 <= view.elevation <= 31


def test_as_few_views_are_planned_as_have_a_share_of_what_all_would_give(run, site, capsys):
    opened, ring = open_run(run), place_poses("ring", 12, 2.6, (25, 35), site)
    few, more = (suggest(opened, ring, "auto", enough=share) for share in (0.5, 0.8))
    assert 1 <= len(few.plan) < len(more.plan) < 12
    assert few.certificate.of_all >= 0.5
    assert len(few.certificate.prices) == len(few.ranking)
    assert suggest(opened, ring, 3, policy="random").certificate is None
    for policy in ("d-optimal", "coverage"):
        assert suggest(opened, ring, 3, policy=policy).certificate.share >= 0.9
    limits = {"certificate": {"nodes": 0}}
    assert suggest(opened, ring, 3, **limits).certificate.nodes == 0
    data = opened.dataset.root
    run = mgs.start_run(data, run.parent / "auto", seeds=2, budget="auto", enough=0.7)
    assert 1 <= run.settings.budget < 6
    assert run.settings.enough == 0.7
    later = mgs.start_run(data, run.folder.parent / "more", seeds=2, budget="auto", enough=1.0)
    assert later.settings.budget == 6
    out = ["--out", run.folder.parent / "no", "--prior", later.settings.prior]
    for policy in ("a-optimal", "random"):
        words = ["nbv", data, *out, "--seeds", 2, "--budget", "auto", "--policy", policy]
        assert f"policy {policy}: has no bound to tell how many" in refused(capsys, words)


def test_candidates_of_one_pose_are_one_and_those_that_see_nothing_none(run, site):
    ring = place_poses("ring", 3, 2.6, (25, 35), site)
    away = replace(ring[0][1], world_to_camera=look_at([9, 0, 1], [18, 0, 1]))
    result = suggest(open_run(run), [*ring, ("again", ring[1][1]), ("away", away)])
    assert len(result.ranking) == 3
    assert result.dropped == {"sees nothing of the object": 1, "the same as one before": 1}


def test_views_that_the_policy_excludes_are_left_out(run, site, tmp_path):
    def half(candidates):
        return np.where(candidates[:, 0] > 0, candidates[:, 1], -np.inf)

    opened = open_run(run)
    found = suggest(opened, place_poses("ring", 12, 2.6, (25, 35), site), 2, policy=half)
    assert found.dropped["excluded by the policy"] == 12 - len(found.ranking)
    assert all(view.camera.position[0] > 0 for view in (*found.ranking, *found.plan))
    write_suggestion(tmp_path, opened, found)


def test_a_model_of_split_gaussians_is_rated_by_all_of_them(run, site, tmp_path):
    train = {"means": "free", "density": "split", "passes": 3}
    data = open_run(run).dataset.root
    split = mgs.resume_nbv(start_fit(data, tmp_path / "run", train=train))
    assert len(split.gaussians) > 1.5 * len(split.prior.points)
    found = suggest(split, place_poses("ring", 12, 2.6, (25, 35), site))
    assert 180 < found.ranking[0].azimuth < 360


def test_places_behind_a_wall_are_left_out(run, site):
    """Images of a wall and a ball before it: a place counts as behind where all say so."""
    across = np.stack(np.meshgrid(*[np.linspace(-4, 4, 60)] * 2), -1).reshape(-1, 2)
    wall = np.insert(across, 1, 3.0, axis=1)
    ball = np.random.default_rng(0).normal(size=(400, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=1)[:, None] - [0, 1, 0]
    taken = [synthetic.pinhole(50, 64, 48, [x, -4, 0]) for x in (-3, 0, 3)]
    eyes = {"behind": [0, 4, 0], "before": [1.5, 2, 0], "by the ball": [0, 2, 0], "out": [9, 4, 0]}
    eyes = np.array(list(eyes.values()), float)
    assert hidden(eyes, taken, np.concatenate([wall, ball])).tolist() == [True, *[False] * 3]
    assert not hidden(eyes, taken[:1], wall).any()
    assert not hidden(eyes, taken, None).any()
    opened = open_run(run)
    cloud = opened.dataset.root / "sparse.ply"
    write_cloud(cloud, SparseCloud(wall * [1, -0.4, 1]))
    found = suggest(opened, place_poses("ring", 12, 2, (0, 4), site))
    cloud.unlink()
    assert found.dropped["behind what the images show"] >= 2
    assert len(found.ranking) + sum(found.dropped.values()) == 12
    assert not any(255 < view.azimuth < 285 for view in found.ranking)


def test_the_far_side_of_an_object_alone_is_not_behind_a_wall(site):
    ball = np.random.default_rng(0).normal(size=(3000, 3))
    radius = np.linalg.norm(site.prior.points - site.centre, axis=1).max()
    ball = site.centre + radius * ball / np.linalg.norm(ball, axis=1)[:, None]
    angles = np.radians(np.linspace(-30, 30, 9))
    eyes = site.centre + 3 * radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    taken = [synthetic.pinhole(50, 64, 48, eye, site.centre) for eye in eyes]
    ring = place_poses("ring", 12, 3 * radius, (0, 4), site)
    assert hidden(np.stack([camera.position for _, camera in ring]), taken, ball).any()
    assert "behind what the images show" not in refusals(ring, taken, replace(site, points=ball))


def test_a_wall_near_a_long_object_hides_what_is_behind(site):
    across = np.stack(np.meshgrid(*[np.linspace(-4, 4, 60)] * 2), -1).reshape(-1, 2)
    wall = site.centre + np.insert(across, 1, 2.0, axis=1)
    long = site.centre + (site.prior.points - site.centre) * [5, 1, 1]
    behind = replace(site, prior=replace(site.prior, points=long), points=wall)
    eyes = site.centre + np.array([[x, -4, 0] for x in (-1, 0, 1)])
    taken = [synthetic.pinhole(50, 64, 48, eye, site.centre) for eye in eyes]
    places = site.centre + np.array([[0, 4, 0], [0, -3, 0]])
    poses = [(name, behind.camera(place)) for name, place in zip("ab", places, strict=True)]
    assert refusals(poses, taken, behind) == ["behind what the images show", ""]


@pytest.mark.parametrize("walls", [[[0.6, 0.0, 0.8]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
def test_nothing_is_taken_from_behind_a_facade(site, walls):
    """A leaning wall, and the corner of two."""
    facade = replace(site.prior, normals=np.resize(walls, site.prior.normals.shape))
    ring = place_poses("ring", 12, 2.6, (25, 35), site)
    taken = [site.like]
    why = refusals(ring, taken, replace(site, prior=facade))
    eyes = np.stack([camera.position for _, camera in ring]) - site.centre
    assert [bool(reason) for reason in why] == list((eyes @ np.transpose(walls) < 1e-6).all(1))
    assert set(why) == {"", "behind a surface that faces one way"}
    assert sum(map(bool, why)) < 6
    assert not any(refusals(ring, taken, site))


def test_gains_of_a_model_without_a_surface_are_no_guide(run, monkeypatch, capsys):
    monkeypatch.setattr(Prior, "kind", "random")
    said = output(capsys, "suggest", run, "--dome", 5)
    assert "nothing tells seen from unseen" in said
    assert "; import with masks, or fit with `prior`" in said  # depth is there


def test_a_coarse_model_keeps_the_best(run, site, monkeypatch):
    opened, dome = open_run(run), place_poses("dome", 20, 2.6, (10, 80), site)
    thin, rows = coarse_prior(opened.prior, 100)
    assert 60 <= len(thin.points) == len(rows) <= 100
    whole = {view.name: view.score for view in suggest(opened, dome).ranking}
    monkeypatch.setattr(coarse_prior, "__defaults__", (100,))
    coarse = suggest(opened, dome).ranking
    assert whole[coarse[0].name] > 0.9 * max(whole.values())
    ranks = np.argsort(np.argsort([whole[view.name] for view in coarse]))
    assert np.corrcoef(ranks, np.arange(20)[::-1])[0, 1] > 0.9


def test_a_dataset_is_one_command_and_its_flight_plan_is_read_by_pymavlink(
    run, figures, tmp_path, capsys
):
    out, data = tmp_path / "next", open_run(run).dataset.root
    plans = [tmp_path / f"next.{kind}" for kind in ("plan", "waypoints", "kml")]
    written = [word for path in plans for word in ("--plan", path)]
    asked = "--dome 16 --views 3 --origin 47,8,400,90 --set flight.no_fly=1.5 --set flight.hover=2"
    asked += " --set flight.speed=1.5"
    command("suggest", data, "--out", out, *written, *asked.split())
    assert "ruled out by flight.no_fly or flight.clearance" in said(capsys)[0]
    assert len(json.loads((out / "suggestions.json").read_text())["plan"]) == 3
    poses = [camera for _, camera in load_cameras(out)]
    assert len(load_dataset(out)) == len(poses) == 3
    loader = mavwp.MAVWPLoader()
    loader.load(str(plans[1]))
    items = [loader.wp(k) for k in range(loader.count())]
    command_of = mavutil.mavlink.enums["MAV_CMD"]
    names = [command_of[item.command].name for item in items]
    assert names[:3] == ["MAV_CMD_NAV_WAYPOINT", "MAV_CMD_NAV_TAKEOFF", "MAV_CMD_DO_CHANGE_SPEED"]
    assert names[-1] == "MAV_CMD_NAV_RETURN_TO_LAUNCH"
    assert names.count("MAV_CMD_IMAGE_START_CAPTURE") == 3
    stops = [k for k, name in enumerate(names) if name == "MAV_CMD_DO_MOUNT_CONTROL"]
    home = items[0]
    for k, camera in zip(stops, poses, strict=True):
        stop, mount = items[k - 1], items[k]
        # +Y is east, so +X is south.
        south, east, _ = camera.position
        level = (math.radians(stop.x - 47) * -6.367e6, math.radians(stop.y - 8) * 4.361e6)
        np.testing.assert_allclose(level, (south, east), rtol=0.01, atol=0.01)
        assert home.z + stop.z == pytest.approx(400 + camera.position[2], abs=1e-2)
        ahead = camera.world_to_camera[2, :3]
        assert math.sin(math.radians(mount.param1)) == pytest.approx(ahead[2], abs=1e-6)
        heading = math.radians(stop.param4)
        facing = [-math.cos(heading), math.sin(heading)]
        np.testing.assert_allclose(facing, ahead[:2] / np.linalg.norm(ahead[:2]), atol=1e-6)
        assert (stop.param1, mount.z) == (2, mavutil.mavlink.MAV_MOUNT_MODE_MAVLINK_TARGETING)
    mission = json.loads(plans[0].read_text())["mission"]
    keys = ("command", "frame", "param1", "param2", "param3", "param4", "x", "y", "z")
    for ours, theirs in zip(mission["items"], items[1:], strict=True):
        found = [ours["command"], ours["frame"], *ours["params"]]
        assert found == pytest.approx([getattr(theirs, key) for key in keys], abs=1e-6)
    root = ElementTree.parse(plans[2]).getroot()
    cameras = root.findall(".//{*}Camera")
    headings = [float(one.find("{*}heading").text) for one in cameras]
    assert headings == pytest.approx([items[k - 1].param4 for k in stops], abs=1e-6)
    assert len(root.find(".//{*}LineString/{*}coordinates").text.split()) >= 5


def test_a_plan_in_a_world_that_is_not_upright(run, coarse_priors, tmp_path):
    """+Y of the world, made level, is north."""
    data, up = tmp_path / "data", np.array([-0.48, 0.6, 0.64])
    shutil.copytree(open_run(run).dataset.root, data)
    shutil.rmtree(data / "prior")
    synthetic.edit(data, lambda content: content.update(up=up.tolist()))
    command("prior", data, "--gaussians", 300)
    path, plan = tmp_path / "poses.csv", tmp_path / "a.kml"
    path.write_text("name,x,y,z\na,-1.5,-2,1\n")
    command("suggest", data, "--poses", path, "--plan", plan, "--origin", "0,0,0")
    place = ElementTree.parse(plan).getroot().find(".//{*}Camera")
    longitude, latitude = (float(place.find(f"{{*}}{k}").text) for k in ("longitude", "latitude"))
    found = np.radians([longitude * 6.378e6, latitude * 6.335e6])
    north = np.array([0, 1, 0]) - up[1] * up
    north /= np.linalg.norm(north)
    position = np.array([-1.5, -2, 1])
    expected = [position @ np.cross(north, up), position @ north]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_a_plan_around_a_cylinder_does_not_cross_the_object(run, tmp_path, capsys):
    path = tmp_path / "poses.csv"
    path.write_text("name,x,y,z\na,-2.6,0.1,0.3\nb,2.6,0.3,0.3\n")
    plan = ["--plan", tmp_path / "a.plan", "--origin", "47,8,400"]
    base = ["suggest", run, "--poses", path, "--views", 2, *plan]
    assert "crosses the object, so no flight plan" in refused(capsys, base)
    assert not (tmp_path / "a.plan").exists()
    command(*base, "--set", "flight.no_fly=1.2")
    assert (tmp_path / "a.plan").is_file()


def test_poses_of_a_csv(site, tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("X, y,z,target_x,target_y,target_z,name\n3,0,1,0,0,0,east\n0,3,1,0,1,1,\n")
    (east, first), (number, second) = read_poses(path, site)
    assert (east, number) == ("east", "pose_0001")
    assert first == Camera(site.like.K, 48, 36, look_at([3, 0, 1], [0, 0, 0]))
    np.testing.assert_allclose(second.world_to_camera[2, :3], [0, -1, 0], atol=1e-9)
    path.write_text("\ufeffx,y,z,qw,qx,qy,qz\n1,2,3,2,0,0,0\n")  # as Excel saves it
    ((_, third),) = read_poses(path, site)
    assert np.allclose(third.camera_to_world[:3], np.column_stack([np.eye(3), [1, 2, 3]]))


def test_poses_leave_and_come_in_the_coordinates_of_the_data(run, site, tmp_path, monkeypatch):
    opened, far = open_run(run), np.array([448262.0, 5411932, 412])
    world = World(unit_up([0.3, -0.8, 0.2]), "m", tuple(far))
    camera = site.camera([1.4, -1.8, 1.2])
    found, written = suggest(opened, [("$x^$", camera)]), []  # no formula in a figure
    for k, one in enumerate((world.home, world)):
        (tmp_path / str(k)).mkdir()
        monkeypatch.setattr(opened, "dataset", replace(opened.dataset, world=one))
        write_suggestion(tmp_path / str(k), opened, found)
        written.append(load_cameras(tmp_path / f"{k}/transforms.json")[0][1].position)
    np.testing.assert_allclose(written[1] - written[0], far, atol=1e-6)
    site = Site(site.prior, site.like, world)
    for k in (0, 1):
        ((_, back),) = read_poses(tmp_path / f"{k}/transforms.json", site)
        np.testing.assert_allclose(back.world_to_camera, camera.world_to_camera, atol=1e-6)


def test_the_figure_marks_the_images_that_are_named_and_no_random_points(run, site, monkeypatch):
    opened = open_run(run)
    found = suggest(opened, place_poses("ring", 3, 2.6, (25, 35), site))
    named = replace(found, plan=[replace(found.plan[0], way="from 11 towards 111: 1° round")])
    frames = [replace(one, name="1" * k) for k, one in enumerate(opened.dataset.frames, 1)]
    points, prior = opened.prior.points.copy(), opened.prior
    points[-50:] *= 100
    numbers = prior.numbers | {"triangulated": len(points) - 50}
    monkeypatch.setattr(opened, "dataset", replace(opened.dataset, frames=tuple(frames)))
    monkeypatch.setattr(opened, "prior", replace(prior, points=points, numbers=numbers))
    axis = Figure().add_subplot()
    _from_above(axis, opened, named)
    assert sorted(text.get_text() for text in axis.texts) == ["1", "11", "111"]  # 1: of the stop
    assert np.ptp(axis.get_xlim()) < 10


def test_points_inside_a_mesh_with_a_hole(site):
    mesh = site.prior.mesh
    points = np.array([synthetic.CENTRE, synthetic.CENTRE + np.array([0, 0, 1]), [0.55, 0.4, 0.5]])
    assert inside(mesh, points).tolist() == [True, False, False]


@pytest.mark.parametrize("shape", ["dome", "ring", "grid"])
def test_placed_poses_keep_to_the_elevations(site, shape):
    poses = place_poses(shape, 40, 3.0, (20, 50), site)
    offset = np.array([camera.position for _, camera in poses]) - site.centre
    rise = np.degrees(np.arcsin(offset[:, 2] / np.linalg.norm(offset, axis=1)))
    assert 20 - 1e-6 <= rise.min() <= rise.max() <= 50 + 1e-6
    assert 20 <= len(poses) <= 80
    assert len({name for name, _ in poses}) == len(poses)


BAD_CSV = {
    "empty": ("", "is empty; its first line must name columns"),
    "no rows": ("x,y,z\n", "lists no poses"),
    "NaN": ("x,y,z\n1,nan,2\n", "line 2: y is 'nan', no finite number"),
    "text": ("x,y,z\n1,2,up\n", "line 2: z is 'up'"),
    "wrong column": ("x,y,height\n1,2,3\n", "has the column 'height'"),
    "missing column": ("x,y\n1,2\n", "lacks the column z"),
    "half a target": ("x,y,z,target_x\n1,2,3,0\n", "lacks the column target_y"),
    "short row": ("x,y,z\n1,2\n", "line 2 has 2 cells, not 3"),
    "zero quaternion": ("x,y,z,qw,qx,qy,qz\n1,2,3,0,0,0,0\n", "its quaternion is zero"),
    "control": ("x,y,z,name\n3,0,1,a\x1b[2J\n", r"the name 'a\x1b[2J' cannot be printed"),
    "twice": ("x,y,z,name\n3,0,1,a\n0,3,1,a\n", "lists the pose a more than once"),
    "looks at itself": ("x,y,z,target_x,target_y,target_z\n3,0,1,3,0,1\n", "at its own position"),
    "inside": ("x,y,z\n0.1,-0.05,0.3\n", "can be flown (1 inside the object)"),
    "blind": ("x,y,z,target_x,target_y,target_z\n3,0,1,9,0,1\n", "1 sees nothing of the object"),
}


@pytest.mark.parametrize(("text", "words"), BAD_CSV.values(), ids=BAD_CSV.keys())
def test_a_csv_that_is_no_list_of_poses_is_one_line(run, tmp_path, capsys, text, words):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    assert words in refused(capsys, ["suggest", run, "--poses", path])


BAD = {
    "--poses {data}": "can be flown (8 taken already)",
    "--set ring=3 --views 4": "views 4 of 3 candidates",
    "--dome 5 --set flight.length=0.1": "within the limits",
    "--dome 5 --set ring=5": "give one of them",
    "--views few": "views 'few': expected a whole number",
    "--views auto --policy random": "give the number",
    "--plan a.plan": "`plan` needs `origin`",
    "--plan a.txt --origin 1,2,3": "written as .plan, .waypoints, .kml",
    "--origin 47,8": "origin '47,8': expected LATITUDE",
    "--set elevations=50,20": "elevations = [50, 20]: expected",
    "--dome 5 --set radius=nan": "radius = nan: ",
    "--dome 5 --set radius=1e300": "radius = 1e+300: ",
    "--dome 5 --set radius=1e-300": "radius = 1e-300: ",
    "--set grid=1000000000": "grid 1,000,000,000: give at most 5,000",
    "--views 2 --set certificate.seconds=inf": "certificate.seconds = inf: ",
    "--gaussians 9": "is a run with its model; leave out `gaussians`",
}


@pytest.mark.parametrize(("given", "words"), BAD.items(), ids=BAD)
def test_a_suggestion_that_cannot_be_made_is_one_line(run, tmp_path, capsys, given, words):
    given = given.format(data=open_run(run).dataset.root / "transforms.json").split()
    assert words in refused(capsys, ["suggest", run, *given, "--out", tmp_path / "out"], tmp_path)


@pytest.mark.parametrize("given", ["--dome 5 --poses a.csv", "--dome 6000", "--poses a.csv"])
def test_candidates_are_refused_before_a_model_is_fitted(run, capsys, monkeypatch, given):
    monkeypatch.setattr("mgs.cli.suggest._run", None)
    refused(capsys, ["suggest", open_run(run).dataset.root, *given.split()])


def test_headings_straight_down_and_up_and_in_a_world_that_stands_otherwise():
    """Straight down the top of the image is ahead, straight up its bottom."""
    camera = Camera(np.diag([9.0, 9, 1]), 8, 8, look_at([0, 0, 5], [0, 0, 0], [1, 0, 0]))
    heading, pitch = flight_plan.Stop(camera.position, camera=camera).heading_and_pitch(10)
    assert (heading, pitch) == (pytest.approx(100), pytest.approx(-90))
    up = Camera(camera.K, 8, 8, look_at([0, 0, 0], [0, 0, 5], [-1, 0, 0]))
    assert heading_and_pitch(up) == pytest.approx((90, 90))
    world = World((0.0, -1.0, 0.0))
    west = Camera(camera.K, 8, 8, look_at([0, 0, 0], [-1, 0, 0], [0, -1, 0]))
    assert heading_and_pitch(world.enter(west)) == pytest.approx((270, 0))
    north = Camera(camera.K, 8, 8, look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]))
    assert heading_and_pitch(world.enter(north)) == pytest.approx((0, 0))


@pytest.mark.parametrize("policy", [None, "random"])
def test_a_suggestion_names_the_policy_that_made_it(run, site, policy):
    """A fit has chosen nothing."""
    opened, ring = open_run(run), place_poses("ring", 6, 2.6, (25, 35), site)
    made = numbers(opened, suggest(opened, ring, 2, policy=policy))
    assert made["policy"] == (policy or opened.settings.policy)
