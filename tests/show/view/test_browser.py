"""The page in a real browser: loading, playing, and controls."""

import io
import itertools
import json
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from patience import Patience
from written_run import OBSTACLES, Writer, written, written_with_obstacles

pytestmark = pytest.mark.slow

"""Longest wait [s]; the browser uses software rendering, on a machine that may be busy."""


REMEMBER_TIMES = """
const clock = document.getElementById("clock");
window.times = [];
new MutationObserver(() => window.times.push(Number(clock.textContent.trim().split(/\\s+/)[2]))).observe(
    clock.parentNode, {subtree: true, childList: true, characterData: true});
"""
"""Script by which a page remembers all times that it has shown, as a look may come after the last one."""


class Seen:
    """Content of the page."""

    def __init__(self, browser, url):
        from selenium.webdriver.common.by import By

        self.browser, self._by = browser, By
        if url is not None:  # the page is not open yet
            browser.get("about:blank")
            for log in ("browser", "performance"):
                browser.get_log(log)
            browser.get(url)
        self.until(lambda: self.text("clock"))
        self.until(lambda: self.has_cloth(self.picture()))

    def element(self, name):
        return self.browser.find_element(self._by.ID, name)

    def elements(self, selector):
        return self.browser.find_elements(self._by.CSS_SELECTOR, selector)

    def text(self, name):
        from selenium.common.exceptions import WebDriverException

        try:
            return self.element(name).text
        except WebDriverException:  # not there yet
            return ""

    def time(self):
        """The time shown [s]."""
        return float(self.text("clock").split()[2])

    def picture(self):
        """Picture (height, width, 3) of the cloth."""
        from PIL import Image

        (view,) = self.elements(".picture")
        return np.asarray(Image.open(io.BytesIO(view.screenshot_as_png)).convert("RGB")).astype(int)

    @staticmethod
    def has_cloth(picture):
        """Whether a good part of the picture is not the background."""
        background = picture[2, 2]
        return bool((np.abs(picture - background).max(axis=2) > 20).mean() > 0.02)

    def until(self, condition):
        patience = Patience()
        while True:
            if condition():
                return
            assert not patience.over, "the page does not get there"
            time.sleep(0.2)  # a look costs the time of a picture

    def is_laid_out(self, width):
        """Whether all parts are on a page of this width, and none lies over another."""
        boxes = []
        for selector in (".bar", ".picture", "#colours", "#energies", "#iterations", ".time"):
            for box in (element.rect for element in self.elements(selector) if element.is_displayed()):
                boxes.append((box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]))
        inside = all(
            -0.5 <= left < right <= width + 0.5 and -0.5 <= top < bottom <= 800.5
            for left, top, right, bottom in boxes
        )
        apart = all(
            one[2] <= other[0] + 0.5 or other[2] <= one[0] + 0.5
            or one[3] <= other[1] + 0.5 or other[3] <= one[1] + 0.5
            for one, other in itertools.combinations(boxes, 2)
        )  # fmt: skip
        wide = "return document.documentElement.scrollWidth"
        clock = "return arguments[0].scrollWidth <= arguments[0].clientWidth"
        fits = self.browser.execute_script(wide) <= width
        return (
            len(boxes) >= 5
            and inside
            and apart
            and fits
            and self.browser.execute_script(clock, self.element("clock"))
        )

    def until_drawn(self, before, differs=True):
        """Wait for a picture other than ``before``."""

        def is_other():
            now = self.picture()
            return now.shape != before.shape or np.abs(now - before).mean() > 0.05

        self.until(lambda: is_other() == differs)

    def choose(self, list_name, words):
        self.elements(f".v-select:has(#{list_name})")[0].click()
        items = ".v-overlay--active .v-list-item"
        self.until(lambda: any(item.text == words for item in self.elements(items)))
        wanted = next(item for item in self.elements(items) if item.text == words)

        def clicked():
            from selenium.common.exceptions import ElementClickInterceptedException

            self.browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", wanted)
            try:
                wanted.click()
            except ElementClickInterceptedException:  # the list is still opening
                return False
            return True

        self.until(clicked)
        self.until(lambda: not self.elements(items))

    def complaints(self):
        """Messages of the browser's console above the level of notes, without that on its own compositing."""
        return [
            line
            for line in self.browser.get_log("browser")
            if line["level"] not in ("INFO", "DEBUG") and "GPU stall due to ReadPixels" not in line["message"]
        ]

    def asked_elsewhere(self, url):
        """Addresses asked for that are not those of our server."""
        events = [json.loads(line["message"])["message"] for line in self.browser.get_log("performance")]
        asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
        asked += [e["params"]["url"] for e in events if e["method"] == "Network.webSocketCreated"]
        assert len(asked) > 5
        ours = urlsplit(url).netloc
        return [
            a for a in asked if urlsplit(a).netloc != ours and not a.startswith(("data:", "blob:", "about:"))
        ]


def test_the_page_refuses_a_wrong_token_loads_plays_and_reacts_to_controls(serve, browser, tmp_path):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    page = serve(written(tmp_path / "run", states=9))  # 0.1 s apart; unfinished: begins at the newest
    browser.get(page.url.partition("?")[0] + "?token=guess")
    assert "403" in browser.page_source
    assert "canvas" not in browser.page_source

    seen = Seen(browser, page.url)
    assert seen.text("title") == "run"
    assert "8 vertices · 9 states" in seen.text("status")
    assert browser.title == "run – lyra_petsc"
    for plot in ("energies", "iterations"):
        seen.until(lambda plot=plot: len(seen.elements(f"#{plot} .scatterlayer path.js-line")) >= 2)
    last = seen.picture()
    assert seen.time() == pytest.approx(0.8)

    # plays: the picture and the time change, and it stops at the end
    seen.choose("speed", "0.1 ×")
    seen.element("play").click()
    seen.until(lambda: seen.time() < 0.7)
    seen.until_drawn(last)
    seen.choose("speed", "4 ×")
    seen.until(lambda: seen.time() == pytest.approx(0.8))
    seen.until_drawn(last, differs=False)

    # to the first state and back by the slider
    seen.element("first").click()
    seen.until(lambda: seen.time() == 0.0)
    seen.until_drawn(last)
    first = seen.picture()
    (thumb,) = seen.elements(".v-slider-thumb")
    thumb.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    seen.until(lambda: seen.time() == pytest.approx(0.3))
    seen.until_drawn(first)
    thumb.send_keys(Keys.END)
    seen.until(lambda: seen.time() == pytest.approx(0.8))

    # orbit, and back
    before = seen.picture()
    (view,) = seen.elements(".picture canvas")
    drag = ActionChains(browser, duration=10).move_to_element(view).click_and_hold()  # [ms] as a hand moves
    for _ in range(10):
        drag.move_by_offset(12, 5)
    drag.release().perform()
    seen.until_drawn(before)
    seen.element("fit").click()
    seen.until_drawn(before, differs=False)

    # another quantity, another unit; and none
    assert "speed [m/s]" in seen.text("colours")
    before = seen.picture()
    seen.choose("quantity", "stress")
    seen.until(lambda: "[N/m]" in seen.text("colours"))
    seen.until_drawn(before)
    seen.choose("quantity", "none")
    seen.until(lambda: not seen.elements("#colours"))
    seen.until(lambda: seen.has_cloth(seen.picture()))
    before = seen.picture()
    seen.element("edges").click()
    seen.until_drawn(before)

    # at any width nothing lies over another
    seen.choose("quantity", "speed")
    seen.until(lambda: seen.elements("#colours"))
    try:
        for width in (820, 420, 1280):
            size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            seen.until(lambda width=width: seen.is_laid_out(width))
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

    assert seen.complaints() == []
    assert seen.asked_elsewhere(page.url) == []


def test_obstacles_are_shown_and_move(serve, browser, tmp_path):
    """A ball behind the sheet that moves to the right, a post at rest, and a transparent plane."""
    above = {"plane": {"point": [0, 0, 5], "normal": [0, 0, -1]}}
    run = written_with_obstacles(tmp_path / "run", OBSTACLES | {"above": above})
    looks = ("position=[1.5,1.5,12]", "target=[1.5,1.5,0]")
    served = serve(run, *(word for look in looks for word in ("--set", f"render.camera.{look}")))
    seen = Seen(browser, served.url)

    def ball():
        """Mean column of what is dark grey in the upper part of the picture, over its width."""
        picture = seen.picture()
        top = picture[: len(picture) // 6]
        found = (np.ptp(top, axis=2) < 22) & (top.max(axis=2) < 175)
        return float(np.flatnonzero(found.any(axis=0)).mean()) / top.shape[1] if found.any() else 0.0

    seen.until(lambda: 0.49 < ball() < 0.6)  # the newest state of the unfinished run
    assert seen.picture()[2, 2].max() < 225  # the background through the plane
    seen.element("first").click()
    seen.until(lambda: 0.2 < ball() < 0.4)
    assert seen.complaints() == []


def test_keys_picking_colours_handles_and_pictures(serve, browser, tmp_path):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    run = written(tmp_path / "run", states=9)
    scene = (run / "scene.yaml").read_text(encoding="utf-8").replace("handles: []\n", "")
    more = "handles: [{nodes: [0, 2]}]\nwind: {velocity: [1, 0, 0], density: 1}\n"
    (run / "scene.yaml").write_text(scene + more, encoding="utf-8")
    level = ["render.camera.position=[1.5,1.5,12]", "render.camera.target=[1.5,1.5,0]"]
    settings = [word for text in level for word in ("--set", text)]
    page = serve(run, "--field", "stress", "--range", "0,4", *settings)
    seen = Seen(browser, page.url)
    ticks = seen.text("colours").split("\n")
    assert ticks[:6] == ["largest principal stress [N/m]", "4", "3", "2", "1", "0"]

    def press(*keys):
        ActionChains(browser).send_keys(*keys).perform()

    press(Keys.HOME)
    seen.until(lambda: seen.time() == 0.0)
    press(Keys.ARROW_RIGHT)
    seen.until(lambda: seen.time() == pytest.approx(0.1))
    press(Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    seen.until(lambda: seen.time() == pytest.approx(0.1))
    press(Keys.END)
    seen.until(lambda: seen.time() == pytest.approx(0.8))
    browser.execute_script(REMEMBER_TIMES)
    press(" ")  # at the last state: from the first one on
    seen.until(lambda: min(browser.execute_script("return window.times"), default=1.0) < 0.7)
    seen.until(lambda: seen.time() == pytest.approx(0.8))

    # the ring's hole is in the middle: nothing is picked there, at its side a vertex is
    (canvas,) = seen.elements(".picture canvas")
    aside = canvas.size["width"] // 2 - canvas.size["height"] // 2
    step = canvas.size["height"] // 5
    assert aside > 0
    ActionChains(browser).move_to_element_with_offset(canvas, -step, 0).click().perform()
    seen.until(lambda: "vertex " in seen.text("picked"))
    assert "stress [N/m]: " in seen.text("picked")
    assert " m\n" in seen.text("picked")
    ActionChains(browser).move_to_element(canvas).click().perform()
    seen.until(lambda: not seen.text("picked"))

    before = seen.picture()
    seen.element("around").click()
    seen.until_drawn(before)
    before = seen.picture()
    seen.choose("map", "gray")
    seen.until_drawn(before)
    field = seen.element("range")
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys("0%,100%")
    seen.until(lambda: seen.text("colours").split("\n")[1] not in ("", "4"))

    browser.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path / "saved")}
    )
    seen.element("shot").click()
    seen.until(lambda: list((tmp_path / "saved").glob("*.png")))
    assert seen.complaints() == []


def test_a_running_simulation_is_followed_and_its_end_reported_by_open_pages(browser, tmp_path):
    from lyra_petsc.show.view.live import LivePage

    writer = Writer(tmp_path / "run")
    writer.write()
    messages = []
    page = LivePage("127.0.0.1", 0, messages.append, messages.append)
    page.show(tmp_path / "run")
    try:
        while not messages:
            time.sleep(0.1)
        seen = Seen(browser, messages[0])
        assert "1 states" in seen.text("status")
        before = seen.picture()
        for _ in range(3):
            writer.write()
        seen.until(lambda: "4 states" in seen.text("status"))
        seen.until(lambda: seen.time() == pytest.approx(0.3))
        seen.until_drawn(before)

        for file in (tmp_path / "run").iterdir():
            file.unlink()
        seen.until(lambda: "is not the folder of a run" in seen.text("notice"))

        # another run takes its place, with fewer states and without velocities
        writer = Writer(tmp_path / "run", fields=False)
        writer.write()
        writer.write()
        seen.until(lambda: "2 states" in seen.text("status"))
        seen.until(lambda: not seen.elements("#notice"))
        seen.until(lambda: not seen.elements("#colours"))
        writer.write()
    finally:
        page.end()
    seen.until(lambda: f"later: lyra-petsc view {tmp_path / 'run'}" in seen.text("notice"))
    assert seen.time() == pytest.approx(0.2)
    seen.element("first").click()
    seen.until(lambda: seen.time() == 0.0)
    seen.until(lambda: seen.has_cloth(seen.picture()))
    assert "The run has ended" in seen.text("notice")
    assert seen.complaints() == []


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_notebook_shows_the_page_inside(browser, tmp_path, host):
    """Under both names of this machine; a server of files stands for the notebook's."""
    import functools
    import http.server
    import threading

    import lyra_petsc

    page = lyra_petsc.Run(written(tmp_path / "run")).view()
    (tmp_path / "notebook.html").write_text(page._repr_html_(), encoding="utf-8")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as notebook:
        threading.Thread(target=notebook.serve_forever, daemon=True).start()
        try:
            browser.get(f"http://{host}:{notebook.server_port}/notebook.html")
            browser.switch_to.frame(0)
            assert Seen(browser, None).time() == pytest.approx(0.2)
        finally:
            browser.switch_to.default_content()
            notebook.shutdown()
