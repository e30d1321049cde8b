"""The viewer: what it reads and draws, what it refuses, and the whole of it in a real browser.
Towards strangers: other websites, other machines, hostile names and messages."""

import functools
import io
import math
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from browser import opened
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import pinhole

from mgs import Camera, Run, evaluate_run, load_dataset, look_at, open_run, render, write_ply
from mgs.colour import srgb_from_linear
from mgs.view import layers, server
from mgs.view.access import COOKIE, Access, plain
from mgs.view.layers import read_subject, scaled
from mgs.view.server import FILLED, Viewer, window_camera

pytest.importorskip("viser", reason="viser is not installed")


def steps(run, budget):
    """Let a run on stand-ins go on to this many chosen views."""
    opened = open_run(run)
    settings = opened.settings.model_copy(update={"budget": budget})
    tiny.go(run, settings, opened.dataset)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of three seeds and two of four views, measured; and a PLY of its model."""
    root = tmp_path_factory.mktemp("view")
    dataset = load_dataset(tiny.write_dataset(root / "data"))
    prior = tiny.write_prior(root / "prior")
    tiny.start(root / "run", dataset, budget=4, prior=prior)
    steps(root / "run", 2)
    evaluate_run(root / "run", pictures=False)
    return root / "run"


def test_a_run_is_read(run):
    subject = read_subject(run)
    assert subject.title == f"run: d-optimal, 5 of 7 views, {tiny.POINTS} Gaussians"
    assert [view.role for view in subject.taken] == ["seed"] * 3 + ["chosen"] * 2
    assert [view.step for view in subject.taken] == [0, 0, 0, 1, 2]
    assert len(subject.views) == tiny.FRAMES
    assert subject.mesh is not None
    names = ["colour", "alpha", "depth", "information", "uncertainty", "unobserved"]
    assert layers.layers(subject) == names
    facts = dict(subject.taken[-1].facts)
    assert facts["images then"] == "5"
    assert facts["PSNR of the model here"].endswith(" dB")
    candidate = next(view for view in subject.views if view.role == "candidate")
    assert "PSNR of the model here" in dict(candidate.facts)


@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_a_ply_is_read(run, tmp_path, space):
    path = tmp_path / "gaussians.ply"
    write_ply(path, read_subject(run).gaussians)
    if space == "srgb":  # another tool's file does not say that its colours are linear
        path.write_bytes(re.sub(rb"comment [^\n]*\n", b"", path.read_bytes()))
    subject = read_subject(path)
    assert (subject.views, subject.mesh) == ([], None)
    assert layers.layers(subject) == ["colour", "alpha", "depth"]
    rgb = subject.gaussians.rgb
    assert subject.gaussians.linear == (space == "linear")
    expected = srgb_from_linear(rgb) if space == "linear" else np.clip(rgb, 0, 1)
    colours = layers.gaussian_colours(subject, "colour")
    np.testing.assert_allclose(colours, 255 * expected, atol=0.51)


def test_what_the_kernel_draws(run):
    """Every layer against the renderer, or against the scalars of the Gaussians by another way."""
    subject, camera = read_subject(run), tiny.orbit()[1].resized(64)
    image = render(subject.gaussians, camera)
    rgb, alpha, depth = (np.asarray(x) for x in (image.rgb, image.alpha, image.depth))
    seen = alpha >= 0.5
    assert 0.05 < seen.mean() < 0.95
    drawn = {layer: layers.kernel_image(subject, camera, layer) for layer in layers.layers(subject)}
    np.testing.assert_allclose(drawn["colour"][0], 255 * srgb_from_linear(rgb), atol=0.51)
    np.testing.assert_allclose(drawn["alpha"][0], 255 * alpha[..., None].repeat(3, 2), atol=0.51)
    for layer, (picture, z, (low, high)) in drawn.items():
        assert picture.dtype == np.uint8
        np.testing.assert_allclose(z, np.where(seen, depth, layers.FAR), rtol=1e-6)
        assert layers.legend(layer, (low, high), "m")
        if layer not in ("colour", "alpha"):
            assert (picture[~seen] == 0).all()
    low, high = drawn["depth"][2]
    assert (low, high) == pytest.approx((depth[seen].min(), depth[seen].max()))
    informed = subject.scalars["information"]
    assert drawn["information"][2] == (0, pytest.approx(np.quantile(informed, 0.999)))


def test_a_whole_scene_opens_at_a_camera(run, monkeypatch):
    monkeypatch.setattr(Run, "of_scene", True)
    with closing(Viewer(run, port=0)) as viewer:
        first, camera = viewer.server.initial_camera, viewer.subject.taken[0].frame.camera
    np.testing.assert_allclose(first.position, camera.position)
    np.testing.assert_allclose(first.look_at - first.position, camera.world_to_camera[2, :3])


def test_a_world_of_large_numbers_is_shown_smaller(run):
    """Depth in a browser ends at 160, in front of a run of 1,000 times the lengths."""
    subject, factor = read_subject(run), 1000
    assert scaled(subject) is subject
    g, mesh = subject.gaussians, subject.mesh
    frames = [replace(v.frame, camera=v.frame.camera.scaled(factor)) for v in subject.views]
    views = [replace(v, frame=frame) for v, frame in zip(subject.views, frames, strict=True)]
    scales = g.log_scales + np.float32(np.log(factor))
    larger = replace(g, means=factor * g.means, log_scales=scales)
    large = replace(subject, gaussians=larger, views=views)
    large = replace(large, mesh=replace(mesh, vertices=factor * mesh.vertices))
    shown = scaled(large)
    assert np.ptp(shown.mesh.vertices) == pytest.approx(shown.scale * np.ptp(large.mesh.vertices))
    camera, shown_camera = (one.views[1].frame.camera for one in (subject, shown))
    picture, depth, ends = layers.kernel_image(shown, shown_camera, "depth")
    expected, _, true_ends = layers.kernel_image(subject, camera, "depth")
    np.testing.assert_allclose(picture, expected, atol=2)
    assert depth[depth < layers.FAR].max() < 2.5 * 40
    assert ends == pytest.approx((factor * true_ends[0], factor * true_ends[1]), rel=1e-4)


def test_covariances_have_the_scales_and_the_axes(run):
    g = read_subject(run).gaussians
    flat = replace(g, log_scales=g.log_scales - np.array([0, 1, 3]))
    axes = Rotation.from_quat(g.quats, scalar_first=True).as_matrix()
    variances = np.exp(2 * flat.log_scales)
    expected = axes @ (variances[:, :, None] * axes.transpose(0, 2, 1))
    found = layers.covariances(flat)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * variances.max())


POINTS = st.tuples(*[st.floats(-5, 5)] * 3)
SIDES = st.integers(1, 5000)


@given(POINTS, POINTS, st.floats(0.3, 2), SIDES, SIDES)
def test_the_camera_of_a_window(eye, target, fov, width, height):
    """Its target is in the middle of the image, and the rim of its field of view at the rim."""
    if np.linalg.norm(np.subtract(eye, target)) < 0.1:
        return
    pose = np.linalg.inv(look_at(eye, target))
    wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    size = {"image_width": width, "image_height": height}
    camera = window_camera(SimpleNamespace(**size, fov=fov, wxyz=wxyz, position=np.array(eye)))
    assert camera.width * camera.height <= 1e6 + camera.width + camera.height
    (pixel,), (z,) = camera.project([target])
    middle, near = camera.width / 2, {"atol": 1e-3 * camera.height}
    np.testing.assert_allclose(pixel, [middle, camera.height / 2], **near)
    top = pose[:3, 3] + z * (pose[:3, 2] - np.tan(fov / 2) * pose[:3, 1])
    np.testing.assert_allclose(camera.project([top])[0][0], [middle, 0], **near)


def test_refusals(capsys, run, dataset, prior, tmp_path, monkeypatch):
    def view(*arguments):
        return refused(capsys, ["view", *arguments])

    (tmp_path / "file.ply").write_text("no PLY")
    assert "file.ply" in view(tmp_path / "file.ply")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert "in use" in view(run, "--port", taken.getsockname()[1])
    tiny.start(tmp_path / "begun", load_dataset(dataset), prior=prior)
    assert "no finished step yet" in view(tmp_path / "begun")
    monkeypatch.setitem(sys.modules, "viser", None)
    assert 'pip install "mgs[view]"' in view(run)


@contextmanager
def viewing(*arguments):
    """`mgs view` in a process of its own; gives its address. Ctrl-C must end it in peace."""
    command = [sys.executable, "-m", "mgs", "view", *map(str, arguments), "--port", "0"]
    # A shell starts what runs in the background deaf to SIGINT, which is what ends the viewer.
    hearing = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, **pipes, preexec_fn=hearing)
    try:
        line = process.stdout.readline()
        found = re.search(r"open (http://\S+) in a browser", line)
        assert found, line + process.stderr.read()
        yield found[1]
        process.send_signal(2)
        said = process.communicate(timeout=20)
        assert (process.returncode, said) == (0, ("", ""))
    finally:
        process.kill()
        process.wait()


def test_a_run_is_followed_from_its_beginning(dataset, prior, tmp_path):
    tiny.start(tmp_path / "run", load_dataset(dataset), prior=prior, budget=2)
    with closing(Viewer(tmp_path / "run", port=0, follow=True)) as viewer:
        viewer.tick()
        assert viewer.title.content == "**run: no finished step yet**"
        assert viewer.layer.options == ("colour", "alpha", "depth")
        steps(tmp_path / "run", 1)
        viewer.next_look = 0.0
        viewer.tick()
        assert "4 of 5 views" in viewer.title.content
        assert "uncertainty" in viewer.layer.options
        assert len(viewer.frusta) == tiny.FRAMES
        viewer.select("kf_0000")
        assert "seed" in viewer.facts.content
        viewer.subject.views[0].frame.image_path.unlink()
        viewer.select("kf_0000")
        assert "no such image" in viewer.facts.content
        assert not viewer.image.visible


def test_what_a_window_asks_for_during_a_failed_drawing_is_drawn(run, monkeypatch):
    drawn = []

    def draw(client):
        drawn.append(client)
        viewer._again()
        raise ValueError

    with closing(Viewer(run, port=0)) as viewer:
        monkeypatch.setattr(viewer, "_draw", draw)
        viewer.clients[0] = SimpleNamespace(moved=0.0, drawn=None)
        viewer.tick()
        viewer.tick()
    assert len(drawn) == 2


def of_viser(message) -> bool:
    """Whether an error on the console is one that viser 1.1.1 makes by itself, with any Gaussians:
    three.js reads past the end of the corners of its squares."""
    return "Computed radius is NaN" in message.text


WIDTH, HEIGHT = 800, 520


def start_camera(subject) -> Camera:
    """The camera of a new window, as docs and code describe it, written out again."""
    first = subject.views[0].frame.camera
    centre = np.median(subject.gaussians.means, axis=0).astype(float)
    offset = first.position - centre
    focal = HEIGHT * first.K[1, 1] / first.height
    away = offset + np.linalg.norm(offset) * np.array([0, 0, 1])
    size = np.quantile(np.linalg.norm(subject.gaussians.means - centre, axis=1), 0.95)
    distance = size / (FILLED * np.tan(np.arctan(HEIGHT / 2 / focal)))
    eye = centre + distance * away / np.linalg.norm(away)
    return pinhole(focal, WIDTH, HEIGHT, eye, centre)


def screenshot(tab) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)


def screen_becomes(tab, wanted, seconds=60.0) -> np.ndarray:
    """A screenshot for which `wanted` is true; the last one if the time is up."""
    until = time.monotonic() + seconds
    while not wanted(picture := screenshot(tab)) and time.monotonic() < until:
        tab.wait_for_timeout(300)
    return picture


def choose(tab, label, option):
    tab.get_by_label(label, exact=True).first.click()
    tab.get_by_role("option", name=option, exact=True).click()


def tick(tab, label, on):
    """Set a checkbox. A click before the page listens is lost, so it may take several."""
    box = tab.get_by_label(label, exact=True).first
    for _ in range(10):
        if box.is_checked() == on:
            break
        box.click(force=True)
        tab.wait_for_timeout(1000)
    assert box.is_checked() == on


def test_the_viewer_in_a_browser(browser, run):
    subject = read_subject(run)
    camera = start_camera(subject)
    centre = camera.project(subject.gaussians.means)[0].mean(0)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    # Where nothing else is drawn.
    inside = (np.abs(u - centre[0]) < 60) & (np.abs(v - centre[1]) < 60)

    expected = layers.kernel_image(subject, camera, "colour")[0].astype(int)

    def off(picture):
        return np.abs(picture - expected)[inside].mean()

    with (
        viewing(run, "--follow") as address,
        opened(browser, address, WIDTH, HEIGHT, known=of_viser) as (tab, wrong),
    ):
        tab.get_by_text(subject.title).wait_for()
        # Before any click: one before the page listens is lost.
        assert off(screen_becomes(tab, lambda picture: off(picture) < 1)) < 1
        tick(tab, "Cameras", False)
        for layer in ("uncertainty", "colour"):
            choose(tab, "Layer", layer)
            expected = layers.kernel_image(subject, camera, layer)[0].astype(int)
            assert expected[inside].std() > 2
            assert off(screen_becomes(tab, lambda picture: off(picture) < 1)) < 1, layer
        tick(tab, "Exact at rest", False)
        black = np.abs(expected)[inside].mean()
        own = off(screen_becomes(tab, lambda picture: 1 < off(picture) < 0.4 * black))
        assert 1 < own < 0.4 * black  # near, but by another renderer

        tick(tab, "Cameras", True)
        chosen = next(view for view in subject.taken if view.role == "chosen")
        free = []
        for view in subject.views:
            ((x, y),), (z,) = camera.project([view.frame.camera.position])
            # Neither under the panel nor under the notice of viser.
            if z > 0 and 30 < x < 430 and 250 < y < HEIGHT - 30:
                free.append((view, x, y))
        clicked, x, y = free[-1]
        tab.wait_for_timeout(1500)
        tab.mouse.click(x, y)
        tab.get_by_text(f"{clicked.frame.name}:").wait_for()
        # The frame's image comes after the words, in place of another or as a new one.
        last = "const i = [...document.images].at(-1)"
        size = f"([w, h]) => {{ {last}; return i.naturalWidth == w && i.naturalHeight == h }}"
        tab.wait_for_function(size, arg=[tiny.WIDTH, tiny.HEIGHT], timeout=30_000)
        image = tab.locator("img").last
        shown = np.asarray(Image.open(io.BytesIO(image.screenshot())).convert("RGB")).astype(float)
        frame = 255 * srgb_from_linear(clicked.frame.rgb())
        np.testing.assert_allclose(shown.mean((0, 1)), frame.mean((0, 1)), atol=6)
        choose(tab, "View", chosen.frame.name)
        tab.get_by_text("chosen at step 1").wait_for()
        tab.get_by_text("Gaussians observed then").wait_for()

        tab.get_by_text("Look from there").click()
        own = chosen.frame.camera
        there = own.resized(round(own.width * HEIGHT / own.height))
        narrow = layers.kernel_image(subject, there, "colour")[0].astype(int)
        rows, columns = slice(260, 420), slice(WIDTH // 2 - 100, WIDTH // 2 + 50)
        shift = (WIDTH - there.width) // 2
        expected_there = narrow[rows, columns.start - shift : columns.stop - shift]
        tick(tab, "Exact at rest", True)
        tick(tab, "Cameras", False)

        def off_there(picture):
            return np.abs(picture[rows, columns] - expected_there).mean()

        assert off_there(screen_becomes(tab, lambda picture: off_there(picture) < 3)) < 3

        steps(run, 3)
        tab.get_by_text("6 of 7 views").wait_for(timeout=10_000)
        assert wrong == []


@pytest.fixture(scope="module")
def viewer(seeded):
    with closing(Viewer(seeded, port=0)) as made:
        yield made


def connect(viewer: Viewer, **options):
    import viser
    from websockets.sync.client import connect

    versions = [f"viser-v{viser.__version__}"]
    return connect(f"ws://127.0.0.1:{viewer.port}", subprotocols=versions, **options)


def test_no_other_website_gets_a_connection(viewer):
    from websockets.exceptions import InvalidStatus

    own = f"http://127.0.0.1:{viewer.port}"
    with connect(viewer, origin=own) as socket:
        assert socket.recv()
    for other in ("http://example.org", f"http://127.0.0.1:{viewer.port + 1}", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(viewer, origin=other)


@pytest.mark.parametrize(
    ("host", "headers", "answered"),
    [
        ("127.0.0.1", {"Host": "localhost:8080"}, True),
        ("127.0.0.1", {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}, True),
        ("127.0.0.1", {"Host": "evil.example:8080"}, False),  # its name now leads to this machine
        ("127.0.0.1", {}, False),
        ("0.0.0.0", {"Host": "10.0.0.7:8080"}, False),
        ("0.0.0.0", {"Host": "10.0.0.7:8080", "Cookie": f"{COOKIE}=guess"}, False),
    ],
)
def test_requests_are_answered_by_host_origin_and_token(host, headers, answered):
    access = Access(host)
    assert (access.refusal("/", headers) is None) == answered
    if access.token:
        assert access.refusal(f"/?token={access.token}", headers) is None
        cookie = {**headers, "Cookie": f"{COOKIE}={access.token}"}
        assert access.refusal("/assets/x.js", cookie) is None
        assert access.refusal("/", {**cookie, "Origin": "http://example.org"})


def test_names_titles_and_errors_are_shown_as_they_are(viewer, monkeypatch):
    evil = "<iframe srcdoc=x>{1+1}**_`![a](b)"
    assert not set(plain(evil)) & set("<>{}*_`![]()=+")
    view = viewer.subject.views[0]
    monkeypatch.setattr(server, "plain", lambda text: f"PLAIN({text})")
    viewer.select(view.frame.name)
    assert f"**PLAIN({view.frame.name})**" in viewer.facts.content
    viewer._show_views()
    assert viewer.title.content == f"**PLAIN({viewer.subject.title})**"
    viewer.select(evil)  # a view that is not there
    assert view.frame.name in viewer.facts.content


BAD = {
    "fov": (0.0, math.pi, math.nan, -1.0),
    "image_width": (0, 2**40, -5),
    "wxyz": (np.zeros(4), np.full(4, np.nan)),
    "position": (np.full(3, np.inf), np.full(3, 1e300)),
}


@pytest.mark.parametrize(("name", "value"), [(k, v) for k, values in BAD.items() for v in values])
def test_a_camera_that_is_none_is_not_drawn(name, value):
    good = {"fov": 1.0, "image_width": 32, "image_height": 24}
    good |= {"wxyz": np.array([1.0, 0, 0, 0]), "position": np.zeros(3)}
    assert window_camera(SimpleNamespace(**good)) is not None
    assert window_camera(SimpleNamespace(**good | {name: value})) is None


@pytest.mark.parametrize("message", [b"", b"\xff", "text", b"\x81\xa4type\xa4Nope"])
def test_a_message_of_no_kind_ends_its_connection_alone(viewer, message, capfd):
    from websockets.exceptions import ConnectionClosed

    own = f"http://127.0.0.1:{viewer.port}"
    with connect(viewer, origin=own) as socket:
        socket.send(message)
        with pytest.raises(ConnectionClosed):
            list(socket)
    with connect(viewer, origin=own) as socket:
        assert socket.recv()
    assert capfd.readouterr().err == ""


def test_no_message_of_a_window_ends_the_server(viewer):
    class Broken:
        @property
        def scene(self):
            raise RuntimeError("whatever")

    viewer.clients[-1] = server._Client(Broken(), None, 0.0)
    viewer.layer.value = viewer.layer.options[0]
    viewer.tick()
    assert viewer.clients[-1].drawn is not None
    del viewer.clients[-1]
