"""The report in a real browser: Chromium without a screen."""

import csv
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from recordings import encode

from motionstereo_cli.__main__ import main

webdriver = pytest.importorskip("selenium.webdriver")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="there is no chromium with chromedriver here"
)

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--window-size=1200,900",
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.chrome.service.Service(DRIVER))
    yield driver
    driver.quit()


PROBE = (Path(__file__).parent / "page_probe.js").read_text()

#: The view among them: a recording outside the folder is not opened.
SAVED = "steering,depth,charge,depth-video,view-video,objects"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    home = tmp_path_factory.mktemp("browser") / "a <b>name</b> & #1"
    size = ["--width", "96", "--height", "64", "--frames", "24"]
    assert main(["simulate", str(home), "--scene", "cards", *size]) == 0
    views = [str(home / f"{side}.mp4") for side in ("left", "right")]
    given = ["--rig", str(home / "rig.yaml"), "--save", SAVED]
    assert main(["run", *views, "-o", str(home / "out"), *given]) == 0
    assert main(["report", str(home / "out")]) == 0
    return home / "out"


@pytest.fixture
def page(browser, run):
    browser.get((run / "report.html").as_uri())
    until(browser, "return [...document.querySelectorAll('video')].every(v => v.readyState > 1)")
    return browser


def until(browser, script):
    """Wait until a script returns something true, 10 s at most, and return it."""
    for _ in range(200):
        if found := browser.execute_script(script):
            return found
        time.sleep(0.05)
    raise AssertionError(script)


def frame(browser, number):
    return f"document.getElementById('clock').textContent.includes('frame {number} ')"


def test_it_loads_without_a_word_and_draws_something(page):
    assert page.get_log("browser") == []
    plots = page.execute_script("return [...document.querySelectorAll('.plot')].map(p => p.id)")
    assert plots == ["plot-heading", "plot-depth", "plot-shares", "plot-objects"]
    for name in plots:
        inked = """
            const canvas = document.querySelector(`#${arguments[0]} canvas`);
            const image = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
            const colours = new Set();
            for (let i = 0; i < image.data.length; i += 4)
                if (image.data[i + 3] > 200) colours.add(image.data.slice(i, i + 3).join());
            return colours.size"""
        assert page.execute_script(inked, name) > 3


def test_it_begins_with_the_frame_of_its_posters(page, run):
    with (run / "steering.csv").open() as file:
        rows = list(csv.DictReader(file))
    matched = [float(row["matched"]) for row in rows]
    best = matched.index(max(matched))
    assert best > 0
    until(page, "return " + frame(page, best))
    times = "return [...document.querySelectorAll('video')].map(video => video.currentTime)"
    best_s = float(rows[best]["time_s"])
    assert all(abs(time_s - best_s) < 0.03 for time_s in page.execute_script(times))
    poster = page.find_element("css selector", ".depth video").get_attribute("aria-label")
    assert f"of frame {best}:" in poster


def test_a_click_on_a_plot_seeks_the_videos(page):
    over = page.find_element("css selector", "#plot-depth .u-over")
    webdriver.ActionChains(page).move_to_element(over).click().perform()
    until(page, "return [...document.querySelectorAll('video')].every(v => !v.seeking)")
    times = page.execute_script(
        "return [...document.querySelectorAll('video')].map(v => v.currentTime)"
    )
    assert len(times) == 3
    assert times == pytest.approx([23 / 30 / 2] * 3, abs=0.04)
    shown = page.find_element("id", "clock").text
    assert f"frame {int(times[0] * 30)} " in shown


def test_what_it_says_of_a_frame_is_what_the_table_says(page, run):
    with (run / "steering.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    row = max(rows, key=lambda row: sum(map(bool, row.values())))
    seek = """
        const slider = document.getElementById("slider");
        slider.value = arguments[0];
        slider.dispatchEvent(new Event("input"))"""
    page.execute_script(seek, row["frame"])
    said = {
        name: page.find_element("css selector", f"[data-live={name}]").text
        for name in ("depth_m", "nearest_m", "charged", "matched", "steer")
    }
    for name, factor, digits in (("depth_m", 1, 2), ("nearest_m", 1, 2), ("charged", 100, 1)):
        if row[name]:
            known = pytest.approx(float(row[name]) * factor, abs=0.51 * 10**-digits)
            assert float(said[name]) == known
        else:
            assert said[name] == "\N{EN DASH}"
    assert float(said["steer"]) == pytest.approx(float(row["steer_rad"]) * 57.29578, abs=0.051)
    assert row["status"] in page.find_element("id", "clock").text


def test_keys_step_and_play(page):
    keys = webdriver.Keys
    page.execute_script("document.activeElement.blur()")
    body = page.find_element("tag name", "body")
    body.send_keys(keys.HOME)
    body.send_keys(keys.ARROW_RIGHT)
    body.send_keys(keys.ARROW_RIGHT)
    assert page.execute_script(f"return {frame(page, 2)}")
    body.send_keys(keys.SPACE)
    until(page, f"return {frame(page, 23)}")
    until(page, "return document.querySelector('video').ended")


def test_a_phone_needs_no_scrolling_sideways(page):
    size = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        assert page.execute_script("return document.documentElement.scrollWidth") <= 390
        until(page, "return document.querySelector('.uplot').clientWidth < 390")
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """A run without a rig that never has a heading, and one with a map and a warning."""
    home = tmp_path_factory.mktemp("others")
    flat = [np.full((48, 64), 40, np.uint8) for _ in range(12)]
    for n, image in enumerate(flat):
        image[10:20, 3 * n : 3 * n + 9] = 200
    for side in ("left", "right"):
        encode(home / f"{side}.mp4", flat, "libx264", "yuv420p")
    blind = [str(home / f"{side}.mp4") for side in ("left", "right")]
    assert main(["run", *blind, "-o", str(home / "blind"), "--save", "report"]) == 0
    size = ["--width", "96", "--height", "64", "--frames", "300:340"]
    assert main(["simulate", str(home / "way"), *size]) == 0
    views = [str(home / f"way/{side}.mp4") for side in ("left", "right")]
    given = ["--rig", str(home / "way/rig.yaml"), "--poses", str(home / "way/poses.txt")]
    given += ["--max-disparity", "8", "--save", "report,map,poses", "-o", str(home / "mapped")]
    assert main(["run", *views, *given]) == 0
    return home


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["cards", "blind", "mapped"])
def test_nothing_overlaps_is_cut_or_leaves_the_screen(browser, run, others, name, width, dark):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
    try:
        out = run if name == "cards" else others / name
        if not (out / "report.html").exists():
            assert main(["report", str(out)]) == 0
        browser.get_log("browser")  # of the pages before
        browser.get((out / "report.html").as_uri())
        until(browser, "return document.querySelectorAll('.plot canvas').length")
        browser.execute_script(
            "for (const e of document.querySelectorAll('details')) e.open = true"
        )
        assert browser.execute_script(PROBE) == []
        assert browser.get_log("browser") == []
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_the_probe_finds_what_is_wrong(page):
    spoil = """
        const [text, next] = document.querySelectorAll("figcaption b");
        text.style = next.style = "position: absolute; left: 9px; top: 200px; white-space: nowrap";
        document.querySelector("h1").style = "position: absolute; left: 3000px";
        document.querySelector(".about").style = "overflow: hidden; white-space: nowrap; width: 9px"
    """
    page.execute_script(spoil)
    faults = "; ".join(page.execute_script(PROBE))
    found = [word for word in ("overlap by", "leaves the screen", "is cut") if word in faults]
    assert len(found) == 3, faults


def test_without_the_videos_it_shows_a_frame_of_each(browser, run, tmp_path):
    alone = tmp_path / "alone.html"
    shutil.copy(run / "report.html", alone)
    browser.get(alone.as_uri())
    until(browser, "return document.getElementById('play').disabled")
    text = browser.find_element("tag name", "body").text
    assert text.count("the video is not beside this page") == 3
    assert browser.execute_script("return document.querySelectorAll('video[poster]').length") == 3


def test_a_batch_is_sorted_and_filtered_by_a_click(browser, tmp_path):
    (tmp_path / "batch.csv").write_text(
        "name,status,frames,seconds,charged,matched,damage,reason,worker\n"
        "b,done,9,1,0.5,0.4,,,1\na,done,100,1,0.5,0.4,,,1\nc,failed,,,,,,broken,1\n"
    )
    assert main(["report", str(tmp_path)]) == 0
    browser.get_log("browser")  # of the pages before
    browser.get((tmp_path / "report.html").as_uri())
    rows = "document.querySelectorAll('tbody tr:not([hidden]) .name')"
    shown = f"return [...{rows}].map(cell => cell.innerText)"

    def after_click_on(text):
        browser.find_element("xpath", f"//button[contains(., '{text}')]").click()
        return browser.execute_script(shown)

    assert browser.execute_script(shown) == ["c", "b", "a"]
    assert after_click_on("frames") == ["b", "a", "c"]
    assert after_click_on("frames") == ["a", "b", "c"]
    assert after_click_on("recording") == ["a", "b", "c"]
    assert after_click_on("failed") == ["c"]
    assert after_click_on("failed") == ["a", "b", "c"]
    assert browser.get_log("browser") == []


def test_a_batch_fits_a_phone(browser, tmp_path):
    wrong = "rows do not agree: " + 9 * "objects are 1.7 px higher or lower on the right, "
    (tmp_path / "batch.csv").write_text(
        "name,status,frames,seconds,charged,matched,damage,warnings,said,reason,worker\n"
        f"a,done,9,1,0.5,0.4,0,1,{wrong.replace(',', ';')},,1\nc,failed,,,,,,,,broken,1\n"
    )
    assert main(["report", str(tmp_path)]) == 0
    screen = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    try:
        browser.get((tmp_path / "report.html").as_uri())
        wide = "return [document.documentElement.scrollWidth, document.querySelector('.reason')"
        assert browser.execute_script(f"{wide}.getBoundingClientRect().width > 300]") == [390, True]
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
