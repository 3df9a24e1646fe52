"""Access to the page."""

import asyncio
import signal
import socket

from launch import finish
from patience import SECONDS
from written_run import written

SOCKET = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


def test_everything_is_refused_without_the_token(quiet_page):
    page = quiet_page
    wrong = page.token[:-1] + ("A" if page.token[-1] != "A" else "B")

    for path in ("/", "/index.html", "/vue.global.js", "/ws", "/paraview/", "/nothing"):
        assert page.get(path)[0] == 403, path
        assert page.get(f"{path}?token={wrong}")[0] == 403, path
        assert page.get(path, Cookie=f"lyra-view={page.token}")[0] == 403, path
    assert page.get("/ws", **SOCKET)[0] == 403
    assert page.get(f"/ws?token={wrong}", **SOCKET)[0] == 403
    assert page.get("/?token=%C3%A9%FF%00")[0] == 403
    assert page.get("/paraview/", "POST")[0] == 403
    assert page.token.encode() not in page.get("/")[2]


def test_the_token_gives_access_to_the_page_and_its_cookie_to_the_rest(quiet_page):
    page = quiet_page
    code, headers, _ = page.get(f"/?token={page.token}")
    assert code == 302
    assert "HttpOnly" in headers["Set-Cookie"]
    assert "SameSite=Strict" in headers["Set-Cookie"]
    assert page.get(f"/index.html?token={page.token}")[0] == 200
    code, headers, body = page.get("/vue.global.js", Cookie=page.cookie())
    assert code == 200
    assert len(body) > 10000
    assert headers["Content-Security-Policy"].startswith("default-src 'self'; ")
    assert headers["Referrer-Policy"] == "no-referrer"
    assert page.get("/ws", Cookie=page.cookie(), **SOCKET)[0] == 101
    assert page.get("/../../../../../../etc/passwd", Cookie=page.cookie())[0] == 404
    assert page.get("/nothing", Cookie=page.cookie())[0] == 404


def test_requests_that_open_no_web_socket_are_answered(quiet_page):
    page = quiet_page
    for change in (
        dict.fromkeys(SOCKET),
        {"Sec_WebSocket_Key": None},
        {"Sec_WebSocket_Key": "x"},
        {"Sec_WebSocket_Version": "1"},
        {"Connection": "close"},
    ):
        headers = {name: value for name, value in (SOCKET | change).items() if value is not None}
        for method in ("GET", "HEAD", "POST"):
            assert page.get(f"/ws?token={page.token}", method, **headers)[0] == 426
    assert page.get(f"/index.html?token={page.token}")[0] == 200


def test_malformed_requests_are_answered_without_a_traceback(quiet_page):
    page = quiet_page
    for origin in ("http://[", "null", "http://[::1", "://", "\x80"):
        assert page.get(f"/index.html?token={page.token}", Origin=origin)[0] == 403, origin
    for request in (
        b"GET / HTTP/9.9",
        b"\x16\x03\x01",
        b"FOO",
        b"GET /\xe9 HTTP/1.1",
        b"GET / HTTP/1.1\r\nHost",
    ):
        with socket.create_connection(("127.0.0.1", page.port), 10 * SECONDS) as connection:
            connection.sendall(request + b"\r\n\r\n")
            assert connection.recv(12).endswith(b" 400"), request


def test_unknown_messages_end_their_web_socket_only(serve, tmp_path):
    import aiohttp

    page = serve(written(tmp_path / "run"))

    async def send() -> None:
        address = f"http://127.0.0.1:{page.port}/ws?token={page.token}"
        async with aiohttp.ClientSession() as session:
            for message in (b"\xff\x00", b"\x81\xa6wslink\xa31.0", b""):
                async with session.ws_connect(address) as socket:
                    await socket.send_bytes(message)
                    assert (await socket.receive(timeout=10 * SECONDS)).type is not aiohttp.WSMsgType.TEXT

    asyncio.run(send())
    assert page.get(f"/index.html?token={page.token}")[0] == 200
    page.process.send_signal(signal.SIGINT)
    left = finish(page.process)
    assert left.code == 0
    assert "Traceback" not in left.err


def test_other_host_names_and_sites_are_refused_despite_the_token(quiet_page):
    page = quiet_page
    cookie, path = page.cookie(), "/vue.global.js"

    for host in (
        "evil.example",
        f"evil.example:{page.port}",
        "127.0.0.1.evil.example",
        "10.1.2.3",
        "",
        "a@b:c",
    ):
        assert page.get(path, Cookie=cookie, Host=host)[0] in (400, 403), host
        assert page.get(f"{path}?token={page.token}", Host=host)[0] in (400, 403), host
    for host in (f"localhost:{page.port}", "127.0.0.1:1", "[::1]:9", "LOCALHOST"):  # behind ssh -L
        assert page.get(path, Cookie=cookie, Host=host)[0] == 200, host
    ours = f"127.0.0.1:{page.port}"
    assert page.get("/ws", Cookie=cookie, Origin="http://evil.example", **SOCKET)[0] == 403
    assert page.get("/ws", Cookie=cookie, Origin="null", **SOCKET)[0] == 403
    assert page.get("/ws", Cookie=cookie, Origin="http://127.0.0.1:1", **SOCKET)[0] == 403
    assert page.get("/ws", Cookie=cookie, Origin=f"http://{ours}", **SOCKET)[0] == 101


def test_another_address_is_used_on_request_only(serve, tmp_path):
    folder = written(tmp_path / "run")
    own, all_ = serve(folder), serve(folder, "--host", "0.0.0.0")

    assert own.url.startswith(f"http://127.0.0.1:{own.port}/?token=")
    assert len(own.token) >= 30
    assert own.token != all_.token
    assert own.process.stdout.readline() == "Ctrl-C ends\n"
    assert "other machines" in all_.process.stdout.readline()
    assert all_.get("/index.html?token=" + all_.token, Host="192.168.7.8")[0] == 200
    assert all_.get("/index.html?token=" + all_.token, Host="evil.example")[0] == 403


def test_a_given_port_is_used_and_refused_if_taken(serve, tmp_path):
    from launch import lyra

    page = serve(written(tmp_path / "run"))
    left = lyra(["view", tmp_path / "run", "--port", page.port], tmp_path)

    assert left.code == 2
    assert len(left.ours) == 1
    assert f"--port: 127.0.0.1:{page.port} cannot be used: Address already in use" in left.ours[0]
    page.process.terminate()
    page.process.wait(10 * SECONDS)
    assert serve(tmp_path / "run", "--port", str(page.port)).port == page.port
