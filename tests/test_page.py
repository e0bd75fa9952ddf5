"""The page in a real browser, as people use it."""

from __future__ import annotations

import csv
import json
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from click.testing import CliRunner

import torch_ecc as te
from torch_ecc import cli
from torch_ecc.commands.jobs import TrackJob
from torch_ecc.commands.templates import choose_templates, grid_templates
from torch_ecc.config import fill
from torch_ecc.io import open_frames
from torch_ecc.sim.scene.waves import PlaneWaves

pytest.importorskip("starlette", reason="no starlette: pip install 'torch-ecc[view]'")
pytest.importorskip("uvicorn", reason="no uvicorn: pip install 'torch-ecc[view]'")
pytest.importorskip("websockets", reason="no websockets: pip install 'torch-ecc[view]'")
pytest.importorskip("playwright", reason="no playwright, which drives the browser")

from playwright.sync_api import sync_playwright

from torch_ecc.view.desk import Desk
from torch_ecc.view.run import Run
from torch_ecc.view.server import Server

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")

QUIET = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]


def until(page, condition: str, seconds: float = 20) -> None:
    """Wait for something in the page; its policy forbids what playwright's own waiting evaluates."""
    deadline = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < deadline, f"not so: {condition}"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, "--disable-sync"])
        yield opened
        opened.close()


class Opened:
    """A page of a desk, and all that it has asked for."""

    def __init__(self, browser, source, width: int = 1280) -> None:
        self.desk = Desk({"input": str(source)})
        self.server = Server(self.desk)
        threading.Thread(target=self.server.run, daemon=True).start()
        self.context = browser.new_context(viewport={"width": width, "height": 900}, accept_downloads=True)
        self.asked: list[str] = []
        self.errors: list[str] = []
        self.page = self.tab()

    def tab(self):
        page = self.context.new_page()
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("websocket", lambda socket: self.asked.append(socket.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.goto(self.server.url)
        until(page, "document.querySelector('#what').textContent !== ''")
        return page

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of the frame is on the screen, the whole of it being shown."""
        box, (h, w) = self.page.locator("#canvas").bounding_box(), self.desk.source.shape
        scale = min(box["width"] / w, box["height"] / h)
        left, top = (box["width"] - scale * w) / 2, (box["height"] - scale * h) / 2
        return box["x"] + left + (x + 0.5) * scale, box["y"] + top + (y + 0.5) * scale

    def drag(self, *points: tuple[float, float]) -> None:
        self.page.mouse.move(*self.at(*points[0]))
        self.page.mouse.down()
        for point in points[1:]:
            self.page.mouse.move(*self.at(*point))
        self.page.mouse.up()

    def sigma(self, count: int = 1) -> list[list[float]]:
        """What stands beside each of so many patches."""
        until(self.page, f"document.querySelectorAll('#patches tbody tr').length === {count}")
        rows = self.page.locator("#patches tbody tr")
        return [json.loads(rows.nth(k).get_attribute("data-sigma")) for k in range(count)]

    def clear(self) -> None:
        self.desk.mark([])
        self.page.wait_for_selector("#patches .empty:visible")


@pytest.fixture(scope="module")
def clockwork(browser, data):
    opened = Opened(browser, data / "mechanism_video")
    yield opened
    assert opened.errors == []
    hosts = {url.split("/")[2] for url in opened.asked if not url.startswith("blob:")}
    assert hosts == {f"127.0.0.1:{opened.server.port}"}  # nothing else was ever asked
    assert {url.split("/")[3] for url in opened.asked} == {opened.server.token}


def test_a_dragged_rectangle_says_what_texture_says(clockwork, data):
    first = open_frames(data / "mechanism_video").first
    page = clockwork.page
    page.mouse.move(*clockwork.at(260, 180))
    page.mouse.down()
    page.mouse.move(*clockwork.at(330, 250))
    page.mouse.move(*clockwork.at(380, 300))
    page.wait_for_selector("#tip:has-text('121 × 121 px'):has-text('σ of θ')")  # while it is dragged
    page.mouse.up()
    wanted = te.texture(first, [(320.0, 240.0)], 121)[0]
    assert clockwork.sigma() == [wanted.tolist()]
    shown = page.locator("#patches tbody td").all_inner_texts()
    assert shown[2] == f"{wanted[0]:.4f}"
    assert shown[4] == f"{torch.rad2deg(wanted[2]):.4f}"
    clockwork.clear()


def test_an_outline_is_clicked(clockwork, data):
    page, corners = clockwork.page, [(380, 250), (470, 300), (400, 380), (330, 320)]
    page.keyboard.press("p")
    for corner in corners:
        page.mouse.click(*clockwork.at(*corner))
    page.wait_for_selector("#tip:has-text('4 corners')")
    page.keyboard.press("Enter")
    found = clockwork.sigma()
    told = clockwork.desk.values["polygons"][0]
    assert np.abs(np.array(told) - corners).max() <= 0.5
    job = fill(TrackJob, {"input": "", "polygons": [told]}, "test")
    centers, size, mask = choose_templates(job, clockwork.desk.frame)
    assert found == [te.texture(clockwork.desk.frame, centers, size, mask=mask)[0].tolist()]
    page.keyboard.press("r")
    clockwork.clear()


def test_a_grid_the_best_places_and_imagej(clockwork):
    page, desk = clockwork.page, clockwork.desk
    page.fill("#many [name=size]", "61")
    page.fill("#many [name=count]", "5")
    page.click("text=Grid")
    job = fill(TrackJob, {"input": "", "grid": 5, "size": 61}, "test")
    wanted = grid_templates(job, desk.frame).centers
    found = clockwork.sigma(len(wanted))
    torch.testing.assert_close(torch.tensor(found).double(), te.texture(desk.frame, wanted, 61))
    assert "--grid 5" in desk.told()["command"]
    page.check("#map")
    page.click("text=Best places")
    best = clockwork.sigma(5)
    assert max(x for x, _, _ in best) < np.median([x for x, _, _ in found])
    page.wait_for_selector("#legend:visible")
    page.uncheck("#map")
    page.click("text=An outline from ImageJ")
    page.fill("#paste textarea", "makeRectangle(260, 180, 121, 121)")
    page.click("text=Add it")
    clockwork.sigma(6)
    assert desk.marks[-1] == {"x": 320, "y": 240, "w": 121, "h": 121}
    page.fill("#paste textarea", "what is this")
    page.click("text=Add it")
    page.wait_for_selector("#error:has-text('expected a line')")
    clockwork.clear()


def test_files_of_imagej_and_undo(clockwork, tmp_path):
    """Chosen or dropped; what was marked is taken back and made again."""
    roifile = pytest.importorskip("roifile", reason="pip install 'torch-ecc[view]'")
    page, desk, path = clockwork.page, clockwork.desk, tmp_path / "one.roi"
    roifile.ImagejRoi(roitype=roifile.ROI_TYPE.RECT, left=260, top=180, right=381, bottom=301).tofile(path)
    box = {"x": 320, "y": 240, "w": 121, "h": 121}
    page.set_input_files("#roi", path)
    clockwork.sigma()
    assert desk.marks == [box]
    dropped = page.evaluate_handle(
        "bytes => { const all = new DataTransfer();"
        " all.items.add(new File([new Uint8Array(bytes)], 'two.roi')); return all; }",
        list(path.read_bytes()),
    )
    page.dispatch_event("#canvas", "drop", {"dataTransfer": dropped})
    clockwork.sigma(2)
    page.keyboard.press("Control+z")
    clockwork.sigma(1)
    page.click("#undo")
    page.wait_for_selector("#patches .empty:visible")
    page.keyboard.press("Control+Shift+z")
    clockwork.sigma(1)
    assert desk.marks == [box]
    path.write_bytes(b"no region")
    page.set_input_files("#roi", path)
    page.wait_for_selector("#error:has-text('one.roi is no region')")
    clockwork.clear()


def test_two_fingers_zoom(clockwork):
    """To twice the size, and across: a rectangle that is then drawn is half as large, where the fingers have led."""
    page, session = clockwork.page, clockwork.context.new_cdp_session(clockwork.page)
    (x, y), (right, _) = clockwork.at(320, 240), clockwork.at(420, 240)
    scale = (right - x) / 100

    def touch(kind: str, *points: tuple[float, float]) -> None:
        dots = [{"x": px, "y": py, "id": number} for number, (px, py) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": dots})

    touch("touchStart", (x - 40, y))
    touch("touchStart", (x - 40, y), (x + 40, y))
    touch("touchMove", (x - 60, y), (x + 60, y))
    touch("touchMove", (x - 80 + 50, y + 20), (x + 80 + 50, y + 20))
    touch("touchEnd")
    assert clockwork.desk.marks == []  # no finger has marked anything
    page.mouse.move(x + 50 - 60 * scale, y + 20 - 60 * scale)
    page.mouse.down()
    page.mouse.move(x + 50 + 60 * scale, y + 20 + 60 * scale)
    page.mouse.up()
    clockwork.sigma()
    mark = clockwork.desk.marks[0]
    assert [mark[name] for name in "xywh"] == pytest.approx([320, 240, 61, 61], abs=2)
    page.keyboard.press("0")
    clockwork.clear()


def test_by_keyboard_alone(clockwork):
    page = clockwork.page
    page.focus("#many [name=size]")
    page.fill("#many [name=size]", "81")
    page.focus("#many [value=one]")
    page.keyboard.press("Enter")
    clockwork.sigma()
    before = dict(clockwork.desk.marks[0])
    page.focus("#canvas")
    for key in ("ArrowRight", "ArrowRight", "Shift+ArrowDown"):
        page.keyboard.press(key)
        time.sleep(0.02)
    until(page, f"document.querySelector('#selected [name=y]').value == {before['y'] + 10}")
    deadline = time.monotonic() + 5
    while clockwork.desk.marks[0] != before | {"x": before["x"] + 2, "y": before["y"] + 10}:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    page.keyboard.press("Delete")
    page.wait_for_selector("#patches .empty:visible")


def test_the_scale_is_a_line_of_known_length(clockwork):
    page = clockwork.page
    page.keyboard.press("s")
    clockwork.drag((100, 100), (300, 100), (400, 100))
    page.fill("#unit [name=um]", "60")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#unit [name=um_per_px]').value !== ''")
    assert clockwork.desk.values["um_per_px"] == pytest.approx(0.2, rel=0.01)
    clockwork.desk.set({"um_per_px": None})


@pytest.fixture
def gate(monkeypatch):
    """A run waits at frame 10 until it is opened."""
    opened, watch = threading.Event(), Run._watch

    def held(run, frame, estimate):
        watch(run, frame, estimate)
        if frame.number == 10:
            opened.wait(20)

    monkeypatch.setattr(Run, "_watch", held)
    yield opened
    opened.set()


def test_a_run_is_watched_and_a_reload_loses_nothing(clockwork, data, gate, tmp_path):
    page, desk = clockwork.page, clockwork.desk
    desk.set({"out": str(tmp_path / "page"), "frames": "0:29"})
    clockwork.drag((260, 180), (330, 250), (380, 300))
    clockwork.sigma()
    page.click("#track")
    page.wait_for_selector("#progressed:has-text('11 of 30')")
    until(page, "document.querySelector('#number').textContent === '10 of 55'")  # the overlay follows
    other = clockwork.tab()
    page.reload()
    for each in (page, other):
        each.wait_for_selector("#progressed:has-text('11 of 30')")
        assert each.locator("#patches tbody tr").count() == 1
        assert each.is_visible("#curves")
        assert not each.is_visible("#track")
        assert each.is_visible("#stop")
    gate.set()
    for each in (page, other):
        each.wait_for_selector("#files:visible")
        assert "Tracked 30 frames" in each.inner_text("#words")
    other.close()
    page.bring_to_front()  # a tab that nobody sees draws nothing
    with page.expect_download() as download:
        page.click("#files >> text=track.csv")
    assert_same_track(Path(download.value.path()), data, tmp_path)
    click_a_curve(page)


def test_a_run_is_stopped_and_goes_on(clockwork, gate, tmp_path):
    page, desk = clockwork.page, clockwork.desk
    desk.set({"out": str(tmp_path / "page"), "overlay": False, "frames": "0:29"})
    page.click("#track")
    page.wait_for_selector("#progressed:has-text('11 of 30')")
    page.click("#stop")
    page.wait_for_selector("#stop:has-text('Stopping')")
    gate.set()
    page.wait_for_selector("#words:has-text('Stopped after 11 frames')")
    page.click("#resume")
    page.wait_for_selector("#words:has-text('Tracked 30 frames')")
    assert desk.rows.rows[:, 0].tolist() == list(range(30))
    assert not page.is_visible("#resume")


def assert_same_track(csv_of_the_page: Path, data: Path, folder: Path) -> None:
    """To 1e-12, as the command line has it."""
    words = [
        "track",
        str(data / "mechanism_video"),
        "--center",
        "320",
        "240",
        "--size",
        "121",
        "--frames",
        "0:29",
        "--no-overlay",
    ]
    done = CliRunner().invoke(cli.app, [*words, "--out", str(folder / "command")])
    assert done.exit_code == 0, done.output
    one, two = (list(csv.reader(path.open())) for path in (csv_of_the_page, folder / "command/track.csv"))
    assert one[0] == two[0]
    assert len(one) == len(two) == 31
    for a, b in zip(one[1:], two[1:], strict=True):
        for left, right in zip(a, b, strict=True):
            try:
                assert float(left) == pytest.approx(float(right), rel=1e-12, abs=1e-12)
            except ValueError:
                assert left == right


def click_a_curve(page) -> None:
    """Its frame is shown, and what is known of it."""
    chart = page.locator(".chart canvas").first
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    for _ in range(20):  # until what came last is drawn
        page.mouse.click(box["x"] + 66 + (box["width"] - 74) * 10 / 29, box["y"] + 40)
        page.wait_for_timeout(500)
        if "Frame 10" in page.inner_text("#said"):
            break
    page.wait_for_selector("#said:has-text('Frame 10')")
    assert page.inner_text("#number") == "10 of 55"
    assert " ± " in page.inner_text(".chart figcaption >> nth=0")


def textured(size: tuple[int, int], frames: int, dtype: type, gain: float) -> np.ndarray:
    h, w = size
    poses = torch.tensor([(w / 2 + k, h / 2, 0.01 * k) for k in range(frames)]).double()
    stack = PlaneWaves.random(seed=3, count=40).render(poses, (h, w))[:, 0].clamp(0, 255)
    return (stack * gain).round().numpy().astype(dtype)


def test_deep_large_and_broken_files(browser, tmp_path):
    """16 bits are stretched to be seen; 2048 x 2048 px are shown whole; what is broken is a sentence."""
    tifffile.imwrite(tmp_path / "deep.tif", textured((200, 300), 3, np.uint16, 40.0), photometric="minisblack")
    big = np.repeat(np.repeat(textured((512, 512), 2, np.uint8, 1.0), 4, 1), 4, 2)
    np.save(tmp_path / "large.npy", big)
    (tmp_path / "broken.mp4").write_bytes(b"no video at all" * 50)
    for name, words in (("deep.tif", "300 × 200 px · 3 frames · uint16"), ("large.npy", "2048 × 2048 px · 2 frames")):
        opened = Opened(browser, tmp_path / name)
        assert words in opened.page.inner_text("#what")
        h, w = opened.desk.source.shape
        opened.drag((w * 0.4, h * 0.4), (w * 0.45, h * 0.5), (w * 0.6, h * 0.6))
        assert all(0 < value < 1 for value in opened.sigma()[0])
        brightness = opened.page.evaluate(
            "[...document.querySelector('#canvas').getContext('2d').getImageData(0, 0, 2000, 1000).data]"
            ".filter((_, k) => k % 404 === 0).reduce((a, b) => Math.max(a, b), 0)"
        )
        assert brightness > 150
        assert opened.errors == []
        opened.context.close()
    broken = Opened(browser, tmp_path / "broken.mp4")
    assert "broken.mp4" in broken.page.inner_text("#problem")
    assert not broken.page.is_visible("main")
    broken.context.close()


def test_it_fits_a_narrow_window_and_the_dark(clockwork):
    page = clockwork.page
    page.set_viewport_size({"width": 390, "height": 844})
    page.emulate_media(color_scheme="dark")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(18, 22, 28)"
    page.set_viewport_size({"width": 1280, "height": 900})
