"""The viewer's page in a real browser: what is shown, asked, clicked, and that nothing complains."""

from __future__ import annotations

import io
import logging
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import Watched, open_browser, serving
from labeled_rooms import labeled_room
from PIL import Image

import freeocc3d
from freeocc3d.query.scan_map import Map
from freeocc3d.viewer.browser import notebooks
from freeocc3d.viewer.browser.single_file import write_whole_page


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return labeled_room(tmp_path_factory)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def address(room: Map) -> Iterator[str]:
    with serving([room.path]) as opened:
        yield opened


def picture(watched: Watched) -> np.ndarray[Any, Any]:
    """What the canvas shows, without the labels and panels over it."""
    watched.page.add_style_tag(content="#viewer > :not(#stage), #labels { visibility: hidden }")
    shown = watched.page.screenshot()
    watched.page.evaluate("document.head.lastElementChild.remove()")
    return np.asarray(Image.open(io.BytesIO(shown)).convert("RGB"), np.int16)


def region_box(watched: Watched) -> list[float]:
    """Pixels around the box of the first region: left, top, right, bottom."""
    return watched.page.evaluate(
        """() => {
          const { region } = freeocc3d.regions[0], at = [];
          for (let k = 0; k < 8; k += 1) {
            const corner = [0, 1, 2].map((axis) => (k >> axis) & 1 ? region.box_max[axis] : region.box_min[axis]);
            at.push(freeocc3d.scene.onScreen(freeocc3d.scene.toView(corner)));
          }
          const xs = at.map((each) => each.x), ys = at.map((each) => each.y);
          return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
        }"""
    )


def look_and_ask(watched: Watched) -> None:
    """A word is typed; one region is listed; the picture changes there and nowhere else; a click opens a photograph."""
    before = picture(watched)
    watched.ask("table")
    assert watched.page.locator("#answers .region").count() == 1
    changed = np.abs(picture(watched) - before).max(axis=2) > 8
    left, top, right, bottom = (round(value) for value in region_box(watched))
    inside = np.zeros_like(changed)
    margin = 14  # the upright box may reach beyond the one along the axes
    inside[max(top - margin, 0) : bottom + margin, max(left - margin, 0) : right + margin] = True
    assert changed[inside].mean() > 0.05
    assert not changed[~inside].any()
    watched.page.click("#answers .region")
    watched.page.wait_for_selector("#photograph img", state="visible")
    watched.page.wait_for_function("document.querySelector('#photograph img').naturalWidth > 0")
    assert "% of it" in watched.page.inner_text("#photograph-name")
    assert watched.page.locator("#photograph .mark").is_visible()
    assert not watched.complaints


def test_a_word_lights_up_and_opens_its_photograph(browser: Any, address: str) -> None:
    watched = Watched(browser, address)
    look_and_ask(watched)
    watched.ask("bathtub")
    assert "no match" in watched.page.inner_text("#answers")
    assert not watched.complaints
    watched.context.close()


def test_the_page_as_a_file_needs_no_network(browser: Any, room: Map, tmp_path: Path) -> None:
    path = tmp_path / "room.html"
    write_whole_page(room, path)
    first = path.read_bytes()
    write_whole_page(room, path, overwrite=True)
    assert path.read_bytes() == first
    context = browser.new_context(offline=True)
    asked: list[str] = []
    context.on("request", lambda request: asked.append(request.url))
    context.close()
    watched = Watched(browser, path.as_uri(), offline=True)
    watched.page.on("request", lambda request: asked.append(request.url))
    look_and_ask(watched)
    assert all(url.startswith(("blob:", "data:", "file:")) for url in asked)
    watched.ask("unheard of")
    assert "This file holds no answer to 'unheard of'" in watched.page.inner_text("#answers")
    watched.context.close()


def test_a_cell_of_a_notebook_shows_the_map(
    browser: Any, room: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = freeocc3d.load_map(room.path)
    (tmp_path / "cell.html").write_text(loaded._repr_html_())
    context = browser.new_context(bypass_csp=True, offline=True)
    page = context.new_page()
    page.goto((tmp_path / "cell.html").as_uri())
    page.frame_locator("iframe").locator("html[data-ready=true]").wait_for()
    context.close()
    monkeypatch.setattr(notebooks, "MOST_BYTES", 1000)
    assert loaded._repr_html_().startswith('<img alt="The map" src="data:image/png;base64,')
    gone = freeocc3d.load_map(shutil.copytree(room.path, tmp_path / "gone"))
    shutil.rmtree(gone.path)
    assert str(gone.path) in gone._repr_html_()


def test_a_click_tells_of_a_voxel_and_opens_its_photographs(browser: Any, address: str) -> None:
    watched = Watched(browser, address)
    watched.page.uncheck("#show-path")
    watched.ask("table")
    left, top, right, bottom = region_box(watched)
    found = False
    for share in (0.5, 0.4, 0.6, 0.3, 0.7):
        watched.page.mouse.click(left + share * (right - left), top + 0.5 * (bottom - top))
        watched.page.wait_for_timeout(150)
        found = watched.page.locator("#facts").is_visible() and "table" in watched.page.inner_text("#facts")
        if found:
            break
    assert found, "no click on the table's box hit a voxel of it"
    watched.page.wait_for_selector("#facts-list button")
    told = watched.page.inner_text("#facts")
    assert "depth images end here" in told
    watched.page.click("#facts-list button")
    watched.page.wait_for_function("document.querySelector('#photograph img').naturalWidth > 0")
    watched.page.keyboard.press("Escape")
    assert not watched.page.locator("#photograph").is_visible()
    assert not watched.complaints
    watched.context.close()


def test_layers_colors_and_conditions(browser: Any, address: str) -> None:
    watched = Watched(browser, address)
    seen = [picture(watched)]
    page = watched.page
    changes = [
        lambda: page.check("#show-splats"),
        lambda: page.uncheck("#show-voxels"),
        lambda: page.check("#show-free"),
        lambda: page.check("#show-unknown"),
        lambda: page.check("#show-voxels"),
        lambda: page.select_option("#colors", "class"),
        lambda: page.select_option("#colors", "height"),
        lambda: page.fill("#cut", "0.2"),
        lambda: page.select_option("#colors", "evidence"),
        lambda: page.click("#theme"),
    ]
    for change in changes:
        change()
        watched.page.wait_for_timeout(250)
        watched.settle()
        seen.append(picture(watched))
        assert (np.abs(seen[-1] - seen[-2]).max(axis=2) > 8).mean() > 0.001
    watched.ask("table")
    watched.page.click("details.asks-anything summary")
    watched.page.check("#within")
    watched.page.wait_for_function("freeocc3d.answers.box && !document.querySelector('[aria-busy]')")
    handle = watched.page.evaluate(
        "(() => { const b = freeocc3d.box.corners; const c = [b[3], (b[1] + b[4]) / 2, (b[2] + b[5]) / 2];"
        " return freeocc3d.scene.onScreen(freeocc3d.scene.toView(c)); })()"
    )
    before = watched.page.evaluate("freeocc3d.answers.box.slice()")
    camera = watched.page.evaluate("freeocc3d.scene.camera.position.toArray()")
    frame = watched.page.locator("#canvas").bounding_box()
    watched.page.mouse.move(frame["x"] + handle["x"], frame["y"] + handle["y"])
    watched.page.mouse.down()
    watched.page.mouse.move(frame["x"] + handle["x"] + 60, frame["y"] + handle["y"] - 20, steps=4)
    watched.page.mouse.up()
    after = watched.page.evaluate("freeocc3d.answers.box.slice()")
    assert after[3] != before[3]
    assert after[:3] + after[4:] == before[:3] + before[4:]
    assert watched.page.evaluate("freeocc3d.scene.camera.position.toArray()") == camera, "the drag turned the view"
    assert not watched.complaints
    watched.context.close()


def test_maps_side_by_side(browser: Any, room: Map) -> None:
    with serving([room.path, room.path]) as address:
        context = browser.new_context(bypass_csp=True, viewport={"width": 1000, "height": 600})
        page = context.new_page()
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(address)
        page.wait_for_function("document.querySelectorAll('iframe').length === 2")
        frames = [frame for frame in page.frames if "map=" in frame.url]
        for frame in frames:
            frame.wait_for_function("document.documentElement.dataset.ready")
        frames[0].fill("input[name=words]", "table")
        frames[0].press("input[name=words]", "Enter")
        frames[1].wait_for_selector("#answers .region")
        frames[0].locator("#canvas").click(position={"x": 200, "y": 100})
        page.keyboard.press("7")
        looks = "freeocc3d.scene.camera.position.toArray().map((value) => Math.round(100 * value))"
        frames[1].wait_for_function(f"JSON.stringify({looks}) === '{str(frames[0].evaluate(looks)).replace(' ', '')}'")
        assert not complaints
        context.close()


def test_a_phone_shows_map_and_answers(browser: Any, address: str) -> None:
    watched = Watched(browser, address, viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True)
    watched.ask("table")
    canvas = picture(watched)
    assert (np.abs(canvas[60:400] - canvas[2, 2]).max(axis=2) > 20).mean() > 0.05, "the map is not in the free part"
    watched.page.tap("#answers .region")
    watched.page.wait_for_selector("#photograph img", state="visible")
    assert not watched.complaints
    watched.context.close()


TYPED = ("table", "sofa, chair", "", ",,,", "<b>x</b>", "not red", "\u6905\u5b50", "a" * 300, "cup", "'\"\\", "wall")


def play(watched: Watched, rng: random.Random, times: int) -> None:
    """Clicks, types, drags and presses keys at random."""
    page = watched.page
    keys = ("Home", "1", "3", "7", "f", "v", "g", "p", "t", "c", "h", "Escape", "w", "a", "ArrowLeft", "/", "?", "q")
    for _ in range(times):
        kind = rng.choice(("click", "type", "drag", "key", "wheel", "control"))
        x, y = rng.randrange(5, 990), rng.randrange(5, 690)
        if kind == "click":
            page.mouse.click(x, y, button=rng.choice(("left", "left", "right")), click_count=rng.choice((1, 1, 2)))
        elif kind == "type":
            page.evaluate("document.getElementById('keys').close()")
            page.evaluate("document.body.classList.remove('folded')")
            page.fill("input[name=words]", rng.choice(TYPED))
            page.press("input[name=words]", "Enter")
        elif kind == "drag":
            page.mouse.move(x, y)
            page.mouse.down(button=rng.choice(("left", "right")))
            page.mouse.move(rng.randrange(5, 990), rng.randrange(5, 690), steps=3)
            page.mouse.up(button="left")
            page.mouse.up(button="right")
        elif kind == "key":
            page.keyboard.press(rng.choice(keys))
        elif kind == "wheel":
            page.mouse.wheel(0, rng.choice((-400, 400)))
        else:
            page.evaluate(
                """(at) => {
                  const all = [...document.querySelectorAll('button, input[type=checkbox], summary, select')];
                  const one = all[Math.floor(at * all.length)];
                  if (one.tagName !== 'SELECT') one.click();
                  else {
                    one.selectedIndex = Math.floor(at * 9973) % one.options.length;
                    one.dispatchEvent(new Event('change'));
                  }
                }""",
                rng.random(),
            )


def test_random_use_of_two_pages_while_the_map_is_replaced_raises_nothing(
    browser: Any, room: Map, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, other = tmp_path / "map", tmp_path / "other"
    shutil.copytree(room.path, folder)
    settings = {"capture": {"stop": 4, "color_focal": 1.0, "synthetic": {"width": 160, "height": 120}},
                "tracking": {"backend": "known"}, "fitting": {"passes": 0}}  # fmt: skip
    freeocc3d.reconstruct("builtin:room", other, settings)
    with caplog.at_level(logging.WARNING), serving([folder]) as address:
        pages = [Watched(browser, address) for _ in range(2)]
        for turn in range(4):
            for seed, watched in enumerate(pages):
                play(watched, random.Random(10 * turn + seed), 25)
            folder.rename(tmp_path / f"old-{turn}")
            shutil.copytree(other if turn % 2 == 0 else room.path, folder)
        for watched in pages:
            watched.page.wait_for_timeout(2500)
            expected = len(room.occupancy.colors)
            assert watched.page.evaluate("freeocc3d.meta.voxels.count") == expected
            refusals = [each for each in watched.complaints if "Failed to load resource" not in each]
            assert not refusals
            watched.context.close()
    assert not [record for record in caplog.records if record.exc_info], caplog.text


def test_a_server_that_ended_is_told(browser: Any, room: Map) -> None:
    with serving([room.path]) as address:
        watched = Watched(browser, address)
    watched.page.wait_for_selector("#message", state="visible", timeout=10_000)
    assert "start 'freeocc3d view' again" in watched.page.inner_text("#message")
    watched.page.fill("input[name=words]", "table")
    watched.page.press("input[name=words]", "Enter")
    watched.page.wait_for_function("document.querySelector('#answers').innerText.includes('does not answer')")
    assert not [each for each in watched.complaints if "Failed to load resource" not in each]
    watched.context.close()
