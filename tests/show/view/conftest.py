"""A run's page, served by a separate process, and a headless browser."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from patience import communicate

sys.path.insert(0, str(Path(__file__).parents[2] / "cli"))


@dataclass
class Served:
    """A page that can be opened."""

    process: subprocess.Popen[str]
    url: str

    @property
    def port(self) -> int:
        return urlsplit(self.url).port

    @property
    def token(self) -> str:
        return self.url.partition("token=")[2]

    def get(self, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Send a request without a browser; ``_`` in names of headers stands for ``-``."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=600)
        connection.request(method, path, headers={k.replace("_", "-"): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()

    def cookie(self) -> str:
        """The cookie that a browser sends after it has opened the address."""
        return self.get(f"/?token={self.token}")[1]["Set-Cookie"].split(";")[0]


Serve = Callable[..., Served]


@contextmanager
def serving(place: Path) -> Iterator[Serve]:
    """Start ``view`` for folders, in the folder ``place``; it ends with the context."""
    from launch import start

    pytest.importorskip("trame")
    started = []

    def work(folder: Path, *options: str, ranks: int = 1) -> Served:
        process = start(["view", folder, "--no-browser", *options], place, ranks)
        started.append(process)
        line = process.stdout.readline()
        found = re.fullmatch(r"view: (http://\S+)\n", line)
        assert found, line + communicate(process)[1]
        return Served(process, found[1])

    try:
        yield work
    finally:
        for process in started:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Start ``view`` for a folder; it ends with the test."""
    with serving(tmp_path) as start:
        yield start


@pytest.fixture(scope="module")
def quiet_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A page for several tests, which must write nothing to stderr."""
    from launch import finish
    from written_run import written

    place = tmp_path_factory.mktemp("page")
    with serving(place) as start:
        page = start(written(place / "run"))
        yield page
        page.process.send_signal(signal.SIGINT)
        left = finish(page.process)
        assert (left.code, left.err) == (0, "")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium with software rendering."""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    try:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service
    except ImportError:
        driver = None
    if not (chromium and driver):
        pytest.skip("needs Debian's packages chromium and chromium-driver, and selenium from PyPI")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in ("headless=new", "disable-dev-shm-usage", "window-size=1280,800", "no-proxy-server"):
        options.add_argument(f"--{word}")
    options.add_argument("--enable-unsafe-swiftshader")
    options.add_argument("--use-angle=swiftshader")
    # for WebGL only: to draw the page around it with this renderer takes as long again
    options.add_argument("--disable-gpu-rasterization")
    options.add_argument("--disable-gpu-compositing")
    if os.geteuid() == 0:
        options.add_argument("--no-sandbox")  # it does not start as root otherwise
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    opened = webdriver.Chrome(service=Service(driver), options=options)
    yield opened
    opened.quit()
