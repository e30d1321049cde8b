"""The viewer towards strangers: other websites, other machines, hostile names and messages."""

import math
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from mgs.view import server
from mgs.view.access import COOKIE, Access, plain
from mgs.view.server import Viewer, window_camera

pytest.importorskip("viser", reason="viser is not installed")


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
