"""The page of the frontier: its file, and what a browser makes of it."""

import base64
import io
import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from experiments.frontier.chart import front
from experiments.frontier.page import save_page
from experiments.frontier.pictures import picture
from experiments.frontier.view import View

from .browser import Browser, find_browser

HOSTILE = """</script><img src=x onerror="document.title='hit'"><!-- <b>&amp;'"\u2028@data@.obj"""
SCENES = ("default", HOSTILE)
TECHNIQUES = ("nearest", "pcf", "vsm")
ERRORS = ("rmse", "acne", "error_interior", "flip")
COSTS = ("total_ms", "gradient_ms_median", "kept_bytes")
TIMES, TO = "\N{MULTIPLICATION SIGN}", "\N{EN DASH}"
MADE_WITH = {"versions": {"python": "3.x", "jax": "0.x"}, "device": "a <device>", "commit": None}


def view_of(share, covered=None):
    """Return a view as far as a picture asks it."""
    covered = np.ones(share.shape, bool) if covered is None else covered
    nothing = dict.fromkeys(View._fields)
    return View(**nothing | {"share": share, "surface": SimpleNamespace(covered=covered)})


def halves(webp):
    shown = np.asarray(Image.open(io.BytesIO(webp)).convert("RGB")).astype(int)
    side = (shown.shape[1] - 8) // 2
    return shown[:, :side], shown[:, -side:]


def hue(pixels):
    """Return red less blue: orange is above 0, blue below, gray 0."""
    return pixels[..., 0] - pixels[..., 2]


# Pictures


def test_orange_is_darker_and_blue_is_lighter_than_truth():
    truth = np.zeros((64, 64), np.float32)
    truth[:, :32] = 1.0
    color = np.full((64, 64, 3), 0.5, np.float32)
    image, right = halves(picture(view_of(truth), truth, color))
    assert abs(hue(right)).max() <= 2
    assert abs(image - 188).max() <= 2  # sRGB of 0.5
    _, wrong = halves(picture(view_of(truth), 1 - truth, color))
    assert hue(wrong)[:, 4:28].min() > 150
    assert hue(wrong)[:, 36:-4].max() < -100


def test_a_large_image_is_averaged_and_its_wrong_pixels_are_seen():
    truth = np.ones((512, 300), np.float32)
    visibility = truth.copy()
    visibility[::2, ::2] = 0.0  # one of each four
    color = np.zeros((512, 300, 3), np.float32)
    color[:, ::2] = 1.0
    webp = picture(view_of(truth), visibility, color)
    image, wrong = halves(webp)
    assert image.shape == wrong.shape == (256, 150, 3)
    assert abs(image - 188).max() <= 2  # mean of light, not of its encoding
    assert hue(wrong).min() > 150
    assert webp[8:12] == b"WEBP"


def test_what_has_no_surface_is_background():
    share = np.zeros((32, 32), np.float32)
    covered = np.zeros((32, 32), bool)
    color = np.zeros((32, 32, 3), np.float32)
    image, wrong = halves(picture(view_of(share, covered), share + 1, color))
    assert min(image.min(), wrong.min()) > 230


# The file


def invent():
    """Return rows of two scenes of shadows and one of shading, and pictures of some."""
    rng = np.random.default_rng(0)
    rows = []
    for scene in SCENES:
        for technique in TECHNIQUES:
            for map_size in (256, 1024):
                low, median, high = np.sort(rng.uniform(2, 60, 3))
                errors = dict(zip(ERRORS, rng.lognormal(-4, 1, 4), strict=True))
                rows.append(
                    {"scene": scene, "kind": "shadow", "technique": technique,
                     "name": f"{technique} <b>@ {map_size}", "setting": technique,
                     "map_size": map_size, "image_size": 512, **errors, "bias": "none <1>",
                     "total_ms": median, "total_ms_low": low, "total_ms_high": high,
                     "gradient_ms_median": rng.uniform(1, 9), "gradient_ms_low": 0.9,
                     "gradient_ms_high": 9.5, "kept_bytes": map_size**2 * 8, "stable": True}
                )  # fmt: skip
    for row in rows[1:4]:
        row["error_interior"] = 0.0
    rows[4]["acne"] = math.nan
    rows[5]["gradient_ms_median"] = None
    empty = dict.fromkeys(rows[0])
    for k, name in enumerate(("exact", "per vertex")):
        rows.append(
            empty | {"scene": "default", "kind": "shading", "technique": name, "name": name,
                     "setting": name, "rmse": 0.1 * k, "flip": 0.01 * k, "total_ms": 3.0 - k,
                     "kept_bytes": 0}
        )  # fmt: skip
    rows.append(
        empty | {"scene": "default", "kind": "peer", "technique": "other", "name": "other",
                 "setting": "other", "rmse": 1e-5, "total_ms": 80.0}
    )  # fmt: skip
    truth = np.ones((16, 16), np.float32)
    color = np.zeros((16, 16, 3), np.float32)
    pictures = {
        (row["scene"], row["name"]): picture(view_of(truth), truth * k / 20, color + k / 20)
        for k, row in enumerate(rows)
        if row["kind"] == "shadow"
    }
    return rows, pictures


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    rows, pictures = invent()
    path = tmp_path_factory.mktemp("page") / "frontier.html"
    save_page(rows, pictures, path, made_with=MADE_WITH)
    return rows, pictures, path


def data_of(page):
    (content,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(content, parse_constant=lambda word: pytest.fail(word))


def test_all_is_in_the_one_file(made):
    rows, pictures, path = made
    assert list(path.parent.iterdir()) == [path]
    data = data_of(path.read_text("utf-8"))
    assert len(data["rows"]) == len(rows)
    for row, kept in zip(rows, data["rows"], strict=True):
        assert set(row) <= set(kept)
        wanted = {k: None if v != v else v for k, v in row.items()}
        assert {key: kept[key] for key in row} == wanted
    for k, webp in data["pictures"].items():
        row = rows[int(k)]
        assert base64.b64decode(webp) == pictures[row["scene"], row["name"]]
    assert len(data["pictures"]) == len(pictures)


def test_nothing_is_loaded_and_nothing_escapes(made):
    page = made[2].read_text("utf-8")
    links = re.findall(r"\w+://[^\s\"'`]*", page)
    assert links == ["http://www.w3.org/2000/svg"]  # a name, not a place
    assert re.findall(r"(?:src|href)=\S+", page.split("<script")[0]) == ['href="data:,">']
    assert "default-src 'none'" in page
    assert page.count("<script") == page.count("</script") == 2
    assert not re.search(r"@(style|script|acne|leak)@", page)


def test_rows_may_lack_kind_and_name(tmp_path):
    row = {"scene": "a", "technique": "pcf", "setting": "pcf 3x3", "map_size": 256, "rmse": 0.1}
    save_page([row], {("a", "pcf 3x3 @ 256"): b"webp"}, tmp_path / "a.html", made_with=MADE_WITH)
    data = data_of((tmp_path / "a.html").read_text("utf-8"))
    assert data["rows"][0]["name"] == "pcf 3x3 @ 256"
    assert data["families"][0]["label"] == "pcf"
    assert list(data["pictures"]) == ["0"]


def test_the_page_of_a_full_run_is_small(made, tmp_path):
    rows = [made[0][0] | {"scene": f"{k // 110}", "name": f"{k}"} for k in range(770)]
    pictures = {(row["scene"], row["name"]): bytes(8000) for row in rows}  # 6100 measured
    save_page(rows, pictures, tmp_path / "a.html", made_with=MADE_WITH)
    assert (tmp_path / "a.html").stat().st_size < 12e6  # 9.0e6


# In a browser


@pytest.fixture(scope="module")
def shared_browser(tmp_path_factory):
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium on the path (or named by $CHROME) to open the page in")
    browser = Browser(program, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture
def browser(shared_browser, made):
    """A browser at the page, which says nothing and asks for nothing else."""
    shared_browser.resize(1280, 800)
    shared_browser.open(made[2])
    yield shared_browser
    assert shared_browser.complaints() == []
    assert shared_browser.requests() == [made[2].as_uri()]


def drawn(browser, selector=".point"):
    """Return the indices of the rows of some points."""
    script = f"Array.from(document.querySelectorAll('{selector}'), (p) => +p.dataset.row)"
    return browser.run(script)


def drawable(rows, scene, cost, error):
    known = lambda value: value is not None and value == value
    shadows = [r for r in rows if r["scene"] == scene and r["kind"] != "shading"]
    return [row for row in shadows if known(row[cost]) and known(row[error])]


def best(rows, cost, error):
    """Return the names on the front, by the chart's own function."""
    return {row["name"] for row in front(rows, error, cost=cost)}


def figure(value):
    """Return a number as the page writes it."""
    if value == 0:
        return "0"
    digits, power = f"{value:.2e}".split("e")
    if int(power) < -3:
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{digits}{TIMES}10{raised}"
    return f"{value:#.3g}".rstrip(".")


def facts(row):
    """Return what is said of a row of shadows."""
    side = lambda n: f"{n} {TIMES} {n}"
    time = lambda name, low, high: (
        f"{figure(row[name])} ms ({figure(row[low])} {TO} {figure(row[high])})"
    )
    return [
        ["setting", row["setting"]], ["map", side(row["map_size"])],
        ["image", side(row["image_size"])], ["bias", row["bias"]],
        ["RMSE", figure(row["rmse"])],
        ["wrong pixels away from edges", figure(row["error_interior"])],
        ["acne", figure(row["acne"])], ["FLIP", figure(row["flip"])],
        ["time of an image", time("total_ms", "total_ms_low", "total_ms_high")],
        ["time of a gradient",
         time("gradient_ms_median", "gradient_ms_low", "gradient_ms_high")],
        ["memory kept", {256: "512 KiB", 1024: "8 MiB"}[row["map_size"]]],
        ["steady timing", "yes"],
    ]  # fmt: skip


def table(browser, selector):
    return browser.run(
        f"Array.from(document.querySelectorAll('{selector} tr'), (line) =>"
        " Array.from(line.children, (cell) => cell.innerText))"
    )


@pytest.mark.parametrize("scene", SCENES)
def test_the_front_is_the_charts(browser, made, scene):
    rows = made[0]
    browser.pick("#scene", scene)
    for cost in COSTS:
        browser.pick("#cost", cost)
        for error in ERRORS:
            browser.pick("#error", error)
            there = drawable(rows, scene, cost, error)
            assert sorted(rows[k]["name"] for k in drawn(browser)) == sorted(
                row["name"] for row in there
            )
            found = {rows[k]["name"] for k in drawn(browser, ".point.best")}
            assert found == best(there, cost, error)


def test_a_name_is_text(browser):
    browser.pick("#scene", HOSTILE)
    assert browser.run("document.getElementById('title').textContent").startswith(HOSTILE)
    assert browser.run("document.querySelectorAll('#scene option')[1].textContent") == HOSTILE
    assert browser.run("document.title") == "Error against time"
    assert browser.run("document.images.length") == 1
    assert browser.run("document.scripts.length") == 2
    assert "a <device>, commit unknown; python 3.x, jax 0.x" in browser.text("#made")


def test_a_point_tells_its_row(browser, made):
    rows = made[0]
    for k in (0, 3, 2):
        browser.move(f"[data-row='{k}']")
        assert browser.text("#tip strong") == rows[k]["name"]
        assert table(browser, "#tip") == facts(rows[k])
        chosen = "Array.from(document.querySelectorAll('#tip .chosen th'), (c) => c.innerText)"
        assert browser.run(chosen) == ["RMSE", "time of an image"]
    browser.move("h1")
    assert browser.run("document.getElementById('tip').hidden")


def test_bars_reach_from_quartile_to_quartile(browser, made):
    across = "document.querySelector('[data-row=\"{}\"]').transform.baseVal[0].matrix.e"
    (x0, x1) = (browser.run(across.format(k)) for k in (0, 3))
    a, b = made[0][0], made[0][3]
    per_log = (x1 - x0) / math.log(b["total_ms"] / a["total_ms"])
    browser.move("[data-row='0']")
    box = browser.run(
        "(() => { const box = document.getElementById('bar').getBBox();"
        "return [box.x, box.x + box.width]; })()"
    )
    ends = [
        x0 + per_log * math.log(a[f"total_ms_{side}"] / a["total_ms"]) for side in ("low", "high")
    ]
    assert box == pytest.approx(ends, abs=0.01)


def test_a_click_shows_the_picture(browser, made):
    rows, pictures, _ = made
    for k in (0, 3, 1):
        browser.move(f"[data-row='{k}']", click=True)
        browser.wait("document.getElementById('picture').complete")
        assert browser.text("#name") == rows[k]["name"]
        assert table(browser, "#facts") == facts(rows[k])
        assert browser.run("document.getElementById('picture').naturalWidth") == 16 + 8 + 16
        source = browser.run("document.getElementById('picture').src").partition(",")[2]
        assert base64.b64decode(source) == pictures["default", rows[k]["name"]]
        assert browser.run("document.getElementById('picture').width") > 200
    assert "darker than truth" in browser.text("#hues")
    browser.pick("#scene", HOSTILE)  # the same method there
    assert browser.text("#name") == rows[1]["name"]
    source = browser.run("document.getElementById('picture').src").partition(",")[2]
    assert base64.b64decode(source) == pictures[HOSTILE, rows[1]["name"]]


def test_keys_do_what_the_mouse_does(browser, made):
    rows = made[0]
    in_order = sorted(drawable(rows, "default", "total_ms", "rmse"), key=lambda r: r["total_ms"])
    browser.run("document.querySelector('.point[tabindex=\"0\"]').focus()")
    assert browser.text("#tip strong") == in_order[0]["name"]
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft"):
        browser.press(key)
    assert browser.text("#tip strong") == in_order[1]["name"]
    browser.press("Enter")
    assert browser.text("#name") == in_order[1]["name"]
    browser.press("Escape")
    assert browser.run("document.getElementById('tip').hidden")


def test_the_legend_takes_methods_away(browser, made):
    rows = made[0]
    there = drawable(rows, "default", "total_ms", "rmse")
    assert len(drawn(browser)) == len(there)
    for technique in ("other", "nearest"):
        there = [row for row in there if row["technique"] != technique]
        k = browser.text("#families").split("\n").index(technique)
        browser.move(f"#families button:nth-child({k + 1})", click=True)
        assert {rows[k]["name"] for k in drawn(browser)} == {row["name"] for row in there}
        found = {rows[k]["name"] for k in drawn(browser, ".point.best")}
        assert found == best(there, "total_ms", "rmse")
    assert browser.run("document.querySelectorAll('[aria-pressed=false]').length") == 2
    assert browser.run("document.activeElement.innerText") == "nearest"
    browser.press("Enter")  # back
    assert len(drawn(browser)) == len(there) + 2
    browser.move("#families .plain", click=True)  # all
    assert len(drawn(browser)) == len(drawable(rows, "default", "total_ms", "rmse"))


def test_zeros_have_their_place(browser, made):
    browser.pick("#error", "error_interior")
    strip = browser.run("document.querySelector('.strip').getBoundingClientRect().top")
    place = "document.querySelector('[data-row=\"{}\"] path').getBoundingClientRect()"
    for k, row in enumerate(made[0][:6]):
        below = browser.run(f"{place.format(k)}.top") > strip
        assert below == (row["error_interior"] == 0)
    assert "0" in browser.run(
        "Array.from(document.querySelectorAll('#chart text'), (t) => t.textContent)"
    )


def test_shading_is_on_a_chart_of_its_own(browser):
    browser.pick("#error", "acne")
    browser.pick("#scene", "default: its normal map")
    offered = "Array.from(document.querySelectorAll('#{} option'), (o) => o.value)"
    assert browser.run(offered.format("error")) == ["rmse", "flip"]
    assert browser.run(offered.format("cost")) == ["total_ms", "kept_bytes"]
    assert len(drawn(browser)) == 2
    labels = "Array.from(document.querySelectorAll('#chart .label'), (t) => t.textContent)"
    assert browser.run(labels) == ["lighting (ms)", "RMSE of color, linear"]
    assert browser.text("#name") == "exact"
    assert browser.text("#none") == "There is no image of it."
    browser.pick("#cost", "kept_bytes")  # 0 for both
    assert browser.run("document.querySelectorAll('.strip').length") == 2


def test_rows_without_the_figure_are_counted(browser):
    assert browser.text("#missing") == ""
    browser.pick("#error", "acne")
    assert browser.text("#missing") == "2 of 7 have no such figure."


@pytest.mark.parametrize("width", [1280, 800, 360])
def test_it_fits(browser, width):
    browser.resize(width, 800)
    for error in ERRORS:
        browser.pick("#error", error)
        assert browser.run("document.documentElement.scrollWidth") <= width
        outside = (
            "(() => { const box = document.getElementById('chart').getBoundingClientRect();"
            "return Array.from(document.querySelectorAll('#chart text, .point path'),"
            "  (node) => node.getBoundingClientRect()).filter((b) => b.left < box.left - 1 ||"
            "  b.top < box.top - 1 || b.right > box.right + 1 || b.bottom > box.bottom + 1).length;"
            "})()"
        )
        assert browser.run(outside) == 0
