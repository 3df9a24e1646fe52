"""The page in a real browser: picture, time, play, field, pick, screenshot, and a run that goes on."""

import io
import json
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from patience import Patience
from written_run import OBSTACLES, Writer, written, written_with_obstacles

pytestmark = pytest.mark.slow


class Seen:
    """Content of the page."""

    def __init__(self, browser, url):
        from selenium.webdriver.common.by import By

        self.browser, self._by = browser, By
        browser.get("about:blank")
        for log in ("browser", "performance"):
            browser.get_log(log)
        browser.get(url)
        self.until(lambda: self.text("state"))
        self.until(self.has_sheet)

    def elements(self, selector):
        return self.browser.find_elements(self._by.CSS_SELECTOR, selector)

    def text(self, name):
        from selenium.common.exceptions import WebDriverException

        try:
            return "".join(element.text for element in self.elements(f"#{name}"))
        except WebDriverException:  # replaced meanwhile
            return ""

    def state(self):
        """Number of the state shown."""
        return int(self.text("state").partition(" ")[0])

    def picture(self):
        """Picture (height, width, 3) that PyVista has drawn."""
        from PIL import Image

        (view,) = self.elements("#picture")
        return np.asarray(Image.open(io.BytesIO(view.screenshot_as_png)).convert("RGB")).astype(int)

    def has_sheet(self):
        """Whether a good part of the picture has the strong colours of a sheet."""
        return bool((np.ptp(self.picture(), axis=2) > 60).mean() > 0.02)

    def until(self, condition):
        patience = Patience()
        while not condition():
            assert not patience.over, "the page does not get there"
            time.sleep(0.2)  # a look costs the time of a picture

    def until_drawn(self, before):
        """Wait for a picture other than ``before``."""
        self.until(lambda: np.abs(self.picture() - before).mean() > 0.05)

    def choose(self, words):
        self.elements(".v-select")[0].click()
        items = ".v-overlay--active .v-list-item"
        self.until(lambda: any(item.text == words for item in self.elements(items)))
        wanted = next(item for item in self.elements(items) if item.text == words)
        self.browser.execute_script("arguments[0].click()", wanted)
        self.until(lambda: not self.elements(items))

    def complaints(self):
        """Messages of the browser's console above the level of notes."""
        return [line for line in self.browser.get_log("browser") if line["level"] not in ("INFO", "DEBUG")]

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


def test_the_page_plays_and_reacts_to_its_controls(serve, browser, tmp_path):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    level = ["render.camera.position=[1.5,1.5,12]", "render.camera.target=[1.5,1.5,0]"]
    page = serve(written(tmp_path / "run", states=9), *(word for text in level for word in ("--set", text)))
    seen = Seen(browser, page.url)
    assert seen.text("title") == "run"
    assert "8 vertices · 9 states" in seen.text("status")
    assert browser.title == "run – lyra_petsc"
    assert seen.state() == 8  # the newest state of the unfinished run
    last = seen.picture()

    # time
    (thumb,) = seen.elements(".v-slider-thumb")
    thumb.send_keys(Keys.HOME)
    seen.until(lambda: seen.state() == 0)
    seen.until_drawn(last)
    thumb.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    seen.until(lambda: seen.state() == 3)

    # play
    first = seen.picture()
    seen.elements("#play")[0].click()
    seen.until(lambda: seen.state() == 8)
    seen.until_drawn(first)
    seen.until(lambda: seen.elements("#play .mdi-play"))

    # field
    before = seen.picture()
    seen.choose("stress")
    seen.until_drawn(before)

    # pick: the ring's hole is in the middle, a vertex at its side
    (picture,) = seen.elements("#picture")
    step = 3 * picture.size["height"] // 20
    ActionChains(browser).move_to_element_with_offset(picture, -step, 0).click().perform()
    seen.until(lambda: "vertex " in seen.text("picked"))
    assert "largest principal stress [N/m]: " in seen.text("picked")
    ActionChains(browser).move_to_element(picture).click().perform()
    seen.until(lambda: not seen.text("picked"))

    # camera
    before = seen.picture()
    drag = (
        ActionChains(browser, duration=10).move_to_element(picture).click_and_hold()
    )  # [ms] as a hand moves
    for _ in range(10):
        drag.move_by_offset(12, 5)
    drag.release().perform()
    seen.until_drawn(before)
    assert not seen.text("picked")

    # screenshot
    folder = tmp_path / "saved"
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)})
    seen.elements(".mdi-file-png-box")[0].click()
    seen.until(lambda: list(folder.glob("*.png")))

    assert seen.complaints() == []
    assert seen.asked_elsewhere(page.url) == []


def test_obstacles_are_shown_and_move(serve, browser, tmp_path):
    """A ball that moves to the right, above the middle of the picture in the newest state."""
    from selenium.webdriver.common.keys import Keys

    looks = ("position=[1.5,1.5,12]", "target=[1.5,1.5,0]")
    settings = [word for look in looks for word in ("--set", f"render.camera.{look}")]
    seen = Seen(browser, serve(written_with_obstacles(tmp_path / "run", OBSTACLES), *settings).url)

    def ball_is_there():
        picture = seen.picture()
        return bool(picture[picture.shape[0] // 10, picture.shape[1] // 2].max() < 175)

    seen.until(ball_is_there)
    seen.elements(".v-slider-thumb")[0].send_keys(Keys.HOME)
    seen.until(lambda: not ball_is_there())


def test_a_run_that_goes_on_is_followed_until_its_end(browser, tmp_path):
    from lyra_petsc.show.view.live import LivePage

    writer = Writer(tmp_path / "run")
    writer.write()
    messages = []
    page = LivePage(tmp_path / "run", "127.0.0.1", 0, messages.append, messages.append)
    try:
        while not messages:
            time.sleep(0.1)
        seen = Seen(browser, messages[0])
        before = seen.picture()
        writer.write()
        writer.write()
        seen.until(lambda: seen.state() == 2)
        seen.until_drawn(before)
        assert "3 states" in seen.text("status")
        writer.write()
    finally:
        page.end()
    seen.until(lambda: "The run has ended" in seen.text("notice"))
    assert seen.state() == 3
    assert len(messages) == 1
