"""Who may open the page, and how much a connection may send: over real connections."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http.client import HTTPConnection
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.http11 import Response
from websockets.sync.client import connect

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config, seed_everything
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.viewers import web_guard
from isaacgymenvs_lite.viewers.web_page import WebPage, check_page
from tests.tiny import ONE_THREAD
from tests.viewers.browser import CHROMIUM, Browser

MB = 2**20


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    seed_everything(0)
    cfg = compose([*ONE_THREAD, "task=Cartpole", "num_envs=1"])
    env = make_from_config(cfg, sim_device="cpu", rl_device="cpu")
    env.reset()
    yield env
    env.close()


class Pages:
    """Opens one page at a time, and keeps it for the next test."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self._settings: Any = None
        self._page: WebPage | None = None

    def open(self, host: str, *allowed_hosts: str) -> WebPage:
        if self._page is None or self._settings != (host, allowed_hosts):
            self.close()
            self._page = WebPage(self._env, host, 0, real_time=False, allowed_hosts=allowed_hosts)
            self._settings = (host, allowed_hosts)
        return self._page

    def close(self) -> None:
        if self._page is not None:
            self._page.close()


@pytest.fixture(scope="module")
def pages(env) -> Iterator[Pages]:
    pages = Pages(env)
    yield pages
    pages.close()


@pytest.fixture
def local(pages) -> WebPage:
    """A page for this machine only, and for the name of a proxy."""
    return pages.open("localhost", "proxy.example.org")


@pytest.fixture
def public(pages) -> WebPage:
    """A page that other machines reach."""
    return pages.open("0.0.0.0")


def get(page: WebPage, path: str = "/model", host: str = "localhost:{}", **headers: str) -> Any:
    """Return the answer to a request, with its body as `text`.

    Args:
        page: listens at localhost, too.
        path: what is requested.
        host: the header; {} is the port.
        headers: others; _ in names is -, {} is the port.
    """
    return get_from(page.process.port, path, host, **headers)


def get_from(port: int, path: str, host: str = "localhost:{}", **headers: str) -> Any:
    """Return the answer of a server at this machine; as `get`."""
    with contextlib.closing(HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
        connection.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": host, **headers}.items():
            connection.putheader(name.replace("_", "-"), value.format(port))
        connection.endheaders()
        answer: Any = connection.getresponse()
        answer.text = answer.read().decode(errors="replace")
        return answer


def open_socket(page: WebPage, path: str, host: str = "localhost:{}", **options) -> Any:
    """Open a WebSocket of the page under any Host."""
    port = page.process.port
    url = f"ws://{host.format(port)}{path}"
    raw = socket.create_connection(("127.0.0.1", port), timeout=10)
    return connect(url, sock=raw, max_size=None, **options)


def status_of_socket(page: WebPage, path: str = "/state?sid=a", **options) -> int:
    try:
        with open_socket(page, path, **options):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


@pytest.mark.parametrize("host", ["localhost:{}", "127.0.0.1:{}", "[::1]:{}", "LocalHost.:{}"])
def test_own_addresses_are_served(local, host):
    for origin in ({}, {"Origin": f"http://{host.lower()}"}):
        answer = get(local, host=host, **origin)
        assert answer.status == 200
        assert answer.headers["Access-Control-Allow-Origin"] is None
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    origin = f"http://{host}".format(local.process.port)
    assert status_of_socket(local, host=host, origin=origin) == 101


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:{}", "localhost", "localhost:1", "localhost:{}:1"),
        *("localhost.evil.example:{}", "user@localhost:{}", "192.0.2.1:{}", "", "[::1"),
    ],
)
def test_other_hosts_are_refused(local, host):
    answer = get(local, "/", host)
    assert answer.status == 403
    assert "no address of this page" in answer.text
    assert answer.text.count("\n") == 1


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "http://evil.example:{}", "null", "http://localhost"),
        *("http://localhost:1", "http://127.0.0.1:{}", "file://", "localhost:{}", ""),
        "http://localhost:{}@evil.example",
    ],
)
def test_pages_of_other_sites_are_refused(local, origin):
    assert get(local, Origin=origin).status == 403
    for path in ("/state?sid=a", "/ui?sid=a"):
        assert status_of_socket(local, path, origin=origin.format(local.process.port)) == 403


def test_a_foreign_host_gets_no_socket(local):
    url = "evil.example:{}"
    origin = f"http://evil.example:{local.process.port}"
    assert status_of_socket(local, host=url, origin=origin) == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_another_sites_page_cannot_embed_the_model(local, site):
    """A script or picture is requested without an Origin."""
    headers = {"Sec_Fetch_Site": site, "Sec_Fetch_Mode": "no-cors"}
    assert get(local, **headers, Sec_Fetch_Dest="script").status == 403
    assert get(local, "/", **headers, Sec_Fetch_Dest="iframe").status == 403
    assert get(local, "/", **headers, Sec_Fetch_Dest="document").status == 200  # a link


def test_two_values_of_a_header_are_refused(local):
    port = local.process.port
    with socket.create_connection(("127.0.0.1", port), timeout=10) as raw:
        host = f"Host: localhost:{port}\r\n"
        raw.sendall(f"GET /model HTTP/1.1\r\n{host}{host}\r\n".encode())
        assert raw.recv(100).startswith(b"HTTP/1.1 403 ")


def test_an_allowed_host_is_served_behind_its_proxy(local):
    for origin in ("https://proxy.example.org", "http://proxy.example.org:8888"):
        assert get(local, host="proxy.example.org", Origin=origin).status == 200
        assert get(local, Origin=origin).status == 200  # a proxy that replaces the Host
    assert get(local, host="other.example.org").status == 403


@pytest.mark.parametrize("host", ["https://proxy", "a b", "*", "host:port", "", "a/b", "x" * 999])
def test_a_misspelt_allowed_host_is_one_line(host):
    with pytest.raises(ConfigError, match="viewer_allowed_hosts: got") as caught:
        check_page("localhost", 0, [host])
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


def test_nothing_can_be_dropped(local):
    with open_socket(local, "/ui?sid=a"):  # the controller, from whom MuJoCo takes models
        assert status_of_socket(local, "/drop?sid=a") == 403


@pytest.mark.parametrize("method", ["POST", "HEAD", "PUT"])
def test_other_methods_are_refused(local, method):
    port = local.process.port
    with socket.create_connection(("127.0.0.1", port), timeout=10) as raw:
        raw.sendall(f"{method} /model HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode())
        assert b" 405 " in raw.recv(100)


def memory_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / MB


@contextlib.contextmanager
def bounded(pid: int) -> Iterator[None]:
    """Fail if a process has grown by 200 MB; a few answers may be in memory."""
    before = memory_mb(pid)
    yield
    assert memory_mb(pid) - before < 200


@pytest.fixture
def bounded_page(local) -> Iterator[WebPage]:
    """A page whose memory stays bounded."""
    with bounded(local.process.pid):
        yield local


def test_a_flood_of_messages_ends_its_connection(bounded_page):
    for path in ("/state?sid=a", "/ui?sid=a"):
        with open_socket(bounded_page, path) as client, pytest.raises(ConnectionClosedError):
            client.send(b"x" * MB for _ in range(300))
        assert client.close_code == 1009  # message too big


def test_a_head_without_end_ends_its_connection(bounded_page):
    port = bounded_page.process.port
    with socket.create_connection(("127.0.0.1", port), timeout=10) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\n")
        with pytest.raises(OSError):
            for number in range(200_000):
                raw.sendall(b"X-%d: %s\r\n" % (number, b"x" * 1000))


@pytest.fixture
def impatient(monkeypatch) -> Iterator[int]:
    """Port of a server behind a guard, in this process, to which a request must come in 0.5 s."""
    monkeypatch.setattr(web_guard, "HEAD_TIMEOUT_S", 0.5)
    listening = socket.create_server(("127.0.0.1", 0))
    port = listening.getsockname()[1]
    guard = web_guard.PageGuard("localhost", "127.0.0.1", port, ())
    loop, stop = asyncio.new_event_loop(), asyncio.Event()

    def answer(connection: Any, request: Any) -> Response:
        return Response(200, "OK", Headers({"Content-Length": str(8 * MB)}), bytes(8 * MB))

    async def serve() -> None:
        async with await guard.serve(
            lambda connection: None,
            process_request=answer,
            process_response=lambda *_: None,
            sock=listening,
        ):
            await stop.wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
    thread.start()
    yield port
    loop.call_soon_threadsafe(stop.set)
    thread.join()
    loop.close()


def test_the_page_is_not_announced_before_it_listens():
    async def started_and_reachable() -> tuple[bool, bool]:
        with socket.socket() as bound:
            bound.bind(("127.0.0.1", 0))
            address = bound.getsockname()
            guard = web_guard.PageGuard("localhost", *address, ())
            serving = guard.serve(
                lambda connection: None,
                process_request=lambda *_: None,
                process_response=lambda *_: None,
                sock=bound,
            )
            was_started = guard.started.is_set()
            async with await serving:
                with socket.create_connection(address, timeout=10):
                    return was_started, guard.started.is_set()

    assert asyncio.run(started_and_reachable()) == (False, True)


def test_slow_clients_are_dropped(impatient):
    """They send half a request, or do not read the answer, hundreds at a time."""
    half = "GET / HTTP/1.1\r\n"
    with bounded(os.getpid()), contextlib.ExitStack() as clients:
        for request in (half, f"{half}Host: localhost:{impatient}\r\n\r\n"):
            for _ in range(150):
                raw = clients.enter_context(socket.socket())
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                raw.connect(("127.0.0.1", impatient))
                with contextlib.suppress(OSError):
                    raw.sendall(request.encode())
            time.sleep(0.7)
    wait_until(lambda: get_from(impatient, "/").status == 200)


def test_half_a_request_is_ended(impatient):
    with socket.create_connection(("127.0.0.1", impatient), timeout=10) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\n")
        with contextlib.suppress(ConnectionError):
            assert raw.recv(100) == b""


def wait_until(holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 10.0
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.1)


def token_of(page: WebPage) -> str:
    (token,) = re.findall(r"\?token=([\w-]{32,})$", page.url)
    return token


def test_the_page_for_this_machine_has_no_token(local):
    assert local.url == f"http://localhost:{local.process.port}/"


def test_the_page_for_other_machines_names_this_one(public):
    assert public.url.startswith(f"http://{socket.gethostname()}:{public.process.port}/?token=")


@pytest.mark.parametrize("path", ["/", "/model", "/web_client.js", "/no_such_file"])
def test_without_the_token_nothing_is_served(public, path):
    token = token_of(public)
    for wrong in ("", "?token=", "?token=x", f"?token={token[:-1]}", f"?token={token}x"):
        answer = get(public, path + wrong)
        assert answer.status == 403
        assert "with its token" in answer.text
        assert answer.headers["Set-Cookie"] is None
    cookie = f"isaacgymenvs_lite_{{}}={token[:-1]}"
    assert get(public, path, Cookie=cookie).status == 403


def test_without_the_token_there_is_no_socket(public):
    token = token_of(public)
    for path in ("/state?sid=a", "/ui?sid=a", f"/state?sid=a&token={token[:-1]}"):
        assert status_of_socket(public, path) == 403
    assert status_of_socket(public, f"/state?sid=a&token={token}") == 101


def test_the_printed_address_stores_the_token_as_a_cookie(public):
    token = token_of(public)
    answer = get(public, f"/?token={token}")
    assert answer.status == 200
    assert "url=/" in answer.text  # without the token
    assert token not in answer.text
    cookie, *flags = answer.headers["Set-Cookie"].split("; ")
    assert set(flags) == {"Path=/", "HttpOnly", "SameSite=Strict"}
    assert "<canvas" in get(public, "/", Cookie=f"a=b; {cookie}").text
    headers = {"Cookie": cookie}
    assert status_of_socket(public, additional_headers=headers) == 101
    assert status_of_socket(public, additional_headers=headers, origin="http://a.example") == 403


def test_the_token_does_not_replace_the_host(public):
    assert get(public, f"/model?token={token_of(public)}", "evil.example:{}").status == 403


PROBES = """
(async () => {
  const socket = new Promise((done) => {
    const socket = new WebSocket("ws://%(host)s/state?sid=probe");
    socket.onopen = () => done("open");
    socket.onerror = () => done("refused");
  });
  const model = fetch("http://%(host)s/model").then((answer) => answer.status, () => "refused");
  const hidden = fetch("http://%(host)s/model", { mode: "no-cors" }).then(
    (answer) => answer.type, () => "refused");
  return [location.href, await socket, await model, await hidden].join(" ");
})()
"""


def probe(browser: Browser, host: str) -> list[str]:
    """Return the address of the browser's page, and how its attempts to reach `host` ended."""
    code = PROBES % {"host": host}
    answer = browser.call(
        "Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True
    )
    return answer["result"]["value"].split() if "result" in answer else [""]  # on its way


@pytest.fixture
def other_site(tmp_path) -> Iterator[str]:
    """A page of another origin on this machine."""
    (tmp_path / "index.html").write_text("<!doctype html><html></html>")
    handler = functools.partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}/"
        server.shutdown()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
def test_a_browser_gets_in_by_the_printed_address_and_another_site_does_not(
    public, other_site, tmp_path
):
    host = f"localhost:{public.process.port}"
    with Browser(tmp_path / "profile", f"http://{host}/?token={token_of(public)}") as browser:
        # The token is stored, and gone from the address.
        wait_until(lambda: probe(browser, host) == [f"http://{host}/", "open", "200", "basic"])
        browser.call("Page.navigate", url=other_site)
        wait_until(lambda: probe(browser, host)[0] == other_site)
        assert probe(browser, host)[1:] == ["refused", "refused", "refused"]
