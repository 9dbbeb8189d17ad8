"""The playground, in a browser without a screen."""

import io
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.cloud_files import npy, npz, pcd, ply, xyz
from tests.end_to_end.test_tracking import STEP, image
from tests.programs import run

from edgegrasp_client.conversions import read_isaac_grasps
from edgegrasp_service import server

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")

SAMPLES = Path(server.__file__).parent / "playground" / "samples"
FLAGS = (
    *("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
PATIENCE = 180_000  # milliseconds; longer than anything takes


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser) -> Iterator[Callable[..., Any]]:
    """Open a server's front page, and wait; no page may complain, or ask others for anything."""
    pages, trouble = [], []

    def open_page(url: str, width: int = 1600, height: int = 900) -> Any:
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(PATIENCE)
        page.on("console", lambda message: trouble.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.on(
            "request", lambda sent: sent.url.startswith((url, "blob:")) or trouble.append(sent.url)
        )
        page.goto(url)
        page.get_by_text(re.compile("detecting, by|needs a token")).wait_for()
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert [each for each in trouble if "401 (Unauthorized)" not in each] == []


def shown(page: Any) -> list[Any]:
    """The grasps in the list, once there are any."""
    page.locator("#grasps li").first.wait_for()
    return page.locator("#grasps li:visible").all()


def answer_to(page: Any, act: Callable[..., Any], *given: Any) -> Any:
    """The answer to the request that something makes a page send, once it is shown."""
    with page.expect_response(lambda sent: "/v1/grasps" in sent.url) as answered:
        act(*given)
    assert answered.value.ok
    page.get_by_text("detecting, by").wait_for()
    return answered.value.json()


def bright(page: Any) -> int:
    """Pixels of the picture that have the colour of a good score."""
    picture = Image.open(io.BytesIO(page.locator("#stage").screenshot())).convert("RGB")
    red, green, blue = np.moveaxis(np.asarray(picture).astype(int), 2, 0)
    return int(((red > 150) & (blue > 150) & (green < 0.6 * red)).sum())


def test_grasps_of_the_sample_are_seen_and_asked_for_again_in_a_region(real_server, open_page):
    page = open_page(real_server.http_url)
    assert len(shown(page)) == 12
    assert page.inner_text("#summary").endswith("on 7 of 7 objects")
    save_screenshot(page)
    answer_to(page, page.locator("#sample").select_option, "objects that touch")
    scores = [float(line.inner_text().split()[1]) for line in shown(page)]
    assert scores == sorted(scores, reverse=True)
    assert page.inner_text("#rank") == "1"
    with_hands = bright(page)
    page.locator("#min_score").fill("1")
    assert page.locator("#grasps li:visible").count() == 0
    assert with_hands > bright(page) + 500
    page.locator("#min_score").fill("0")

    page.locator("#grasps button").first.click()
    chosen = json.loads(page.locator("#chosen_json").text_content())
    assert page.inner_text("#numbers").startswith(f"score\n{chosen['score']:.3f}")

    stage = page.locator("#stage").bounding_box()
    page.locator("[data-draw=region]").click()
    page.mouse.move(stage["x"] + 0.55 * stage["width"], stage["y"] + 0.5 * stage["height"])
    page.mouse.down()
    page.mouse.move(stage["x"] + 0.72 * stage["width"], stage["y"] + 0.8 * stage["height"])
    page.mouse.up()
    center = page.locator("#region_center")
    drawn = center.input_value()
    page.locator("[data-edit=region][data-mode=translate]").click()
    center.fill(",".join(f"{float(part) + 0.005:.3f}" for part in drawn.split(",")))
    center.press("Tab")
    page.locator("#debug").check()
    answer = answer_to(page, page.get_by_text("Find grasps").click)
    page.locator("#reasons button").first.click()
    reasons = page.locator("#reasons").bounding_box()
    assert reasons["y"] + reasons["height"] < 900
    region = np.array([float(part) for part in center.input_value().split(",")])
    contacts = np.array([grasp["contact_point"] for grasp in answer["grasps"]])
    assert 0 < len(contacts) <= 50
    half = [float(part) for part in page.locator("#region_half_extents").input_value().split(",")]
    assert np.linalg.norm(contacts - region, axis=1).max() < np.linalg.norm(half) + 0.002

    curl, python = (page.locator(name).text_content() for name in ("#curl", "#python"))
    assert json.loads(run("bash", "-c", curl, cwd=SAMPLES).stdout)["grasps"] == answer["grasps"]
    assert run(sys.executable, "-c", python, cwd=SAMPLES).stdout.count("[[") == len(contacts)


def test_objects_and_points_are_asked_for_and_answers_saved(real_server, open_page) -> None:
    page = open_page(real_server.http_url)
    answer_to(page, page.locator("#sample").select_option, "objects that touch")
    number = int(page.locator("#grasps small").first.inner_text().removeprefix("object "))
    answer = answer_to(page, page.locator("#objects").get_by_text(str(number), exact=True).click)
    assert {grasp["object"] for grasp in answer["grasps"]} == {number}
    page.locator("#pick").click()
    stage = page.locator("#stage").bounding_box()
    middle = stage["x"] + stage["width"] / 2, stage["y"] + stage["height"] / 2
    answer_to(page, page.mouse.click, *middle)
    assert '"at":[' in page.locator("#curl").text_content()

    page.locator("#more").fill('{"order": "clearance"}')
    answer = answer_to(page, page.locator("#all").click)
    scores = [f"{grasp['score']:.3f}" for grasp in answer["grasps"][:12]]
    assert [line.inner_text().split()[1] for line in shown(page)] == scores
    page.locator("#more").fill("")
    answer_to(page, page.locator("#all").click)
    saved = {}
    for kind in ("json", "isaac", "picture"):
        with page.expect_download() as download:
            page.locator(f"[data-save={kind}]").click()
        saved[kind] = Path(download.value.path())
    grasps = json.loads(saved["json"].read_text())["grasps"]
    for grasp, each in zip(grasps, read_isaac_grasps(saved["isaac"].read_text()), strict=True):
        np.testing.assert_allclose(each.T_object_gripper, grasp["T_cloud_hand"], atol=1e-5)
    with Image.open(saved["picture"]) as picture:
        assert min(picture.size) > 300

    seen = [page.locator("#stage").screenshot()]
    for change in ("top", "side", "camera"):
        page.locator(f"[data-look={change}]").click()
        seen.append(page.locator("#stage").screenshot())
    page.locator("#point_size").fill("6")
    seen.append(page.locator("#stage").screenshot())
    assert len({*seen}) == len(seen)


def test_an_arm_is_drawn_and_moves(real_server, open_page) -> None:
    pytest.importorskip("roboplan", reason="the extra robot is not installed")
    page = open_page(real_server.http_url)
    without = page.locator("#stage").screenshot()
    best = answer_to(page, page.locator("#robot").select_option, "fr3")["grasps"][0]
    page.locator("#play").wait_for()
    assert len(page.locator("#base").input_value().split(",")) == 16
    assert "within reach" in page.inner_text("#numbers")
    assert f"{best['arm']['trajectory']['times'][-1]:.1f} s" in page.inner_text("#numbers")
    page.locator("[data-look=side]").click()
    save_screenshot(page)
    at_grasp = page.locator("#stage").screenshot()
    assert at_grasp != without
    page.locator("#play").click()
    assert page.locator("#stage").screenshot() != at_grasp
    page.locator("#robot").select_option("")
    page.get_by_text("detecting, by").wait_for()
    assert not page.locator("#play").is_visible()


def save_screenshot(page: Any) -> None:
    """Keep what a person would see: build/playground-WIDTH.png."""
    folder = Path(__file__).parents[2] / "build"
    folder.mkdir(exist_ok=True)
    page.screenshot(path=folder / f"playground-{page.viewport_size['width']}.png", full_page=True)


def test_the_button_covers_no_field(dummy_server, open_page) -> None:
    page = open_page(dummy_server.http_url, 1600, 500)  # lower than the form
    fields = page.locator("#ask input:visible, #ask select:visible").all()
    assert len(fields) > 5
    for field in fields:
        field.scroll_into_view_if_needed()
        box, button = field.bounding_box(), page.locator("button.go").bounding_box()
        assert box["y"] + box["height"] <= button["y"] or box["y"] >= button["y"] + button["height"]


def scenes(folder: Path) -> Iterator[tuple[int, list[Path]]]:
    """Clouds in every format that the API takes, and images; each with its number of points."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0.3, 0.5, (640, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (640, 3), dtype=np.uint8)
    clouds = {
        "npy": npy(points[:601]),
        "npz": npz(points=points[:602], colors=colors[:602]),
        "xyz": xyz(points[:603]),
        "ply": ply(points[:604], "ascii"),
        "pcd": pcd(points[:605], "ascii"),
    }
    for number, (name, content) in enumerate(clouds.items(), start=601):
        (folder / f"cloud.{name}").write_bytes(content)
        yield number, [folder / f"cloud.{name}"]
    depth, camera = rng.integers(400, 600, (20, 30)).astype(np.uint16), (30.0, 30.0, 15.0, 10.0)
    rgb = colors[:600].reshape(20, 30, 3)
    np.savez(folder / "camera.npz", depth=depth, intrinsics=np.array(camera, np.float32), rgb=rgb)
    yield 600, [folder / "camera.npz"]
    np.save(folder / "depth.npy", depth)
    np.save(folder / "color.npy", np.zeros((9, 9, 3), np.uint8))
    yield 0, [folder / "depth.npy", folder / "color.npy"]
    depth, rgb = depth.reshape(15, 40), rgb.reshape(15, 40, 3)
    depth[0, 0] = 0  # a hole
    Image.fromarray(depth).save(folder / "depth.png")
    Image.fromarray(rgb).save(folder / "color.png")
    yield 599, [folder / "depth.png", folder / "color.png"]


def test_files_of_every_kind_are_shown_and_sent(dummy_server, open_page, tmp_path: Path) -> None:
    page = open_page(dummy_server.http_url)
    for points, files in scenes(tmp_path):
        page.set_input_files("#files", files)
        if files[0].name == "depth.npy":  # the colours are seen: that they do not fit is
            page.get_by_text("color.npy and depth.npy differ in size").wait_for()
            continue
        if files[0].name == "depth.png":
            page.get_by_text("give the camera's fx, fy, cx, cy").wait_for()
            page.locator("#intrinsics").fill("30,30,15,")
            page.get_by_text("Find grasps").click()
            page.get_by_text("give the camera's fx, fy, cx, cy").wait_for()
            page.locator("#intrinsics").fill("30,30,15,10")
            page.get_by_text("Find grasps").click()
        if files[0].name == "camera.npz":
            page.locator("#depth_scale").fill("0.0005")
            page.get_by_text("Find grasps").click()
            page.locator("#curl").get_by_text("depth_scale=0.0005").wait_for()
        counted = page.locator("#counts td").get_by_text(str(points), exact=True).first
        counted.wait_for(state="attached")  # the table is folded
        assert len(shown(page)) == 10
    page.set_input_files("#files", [tmp_path / "cloud.npy"])
    for typed, told in (("0,1", "3 numbers are needed"), ("[0, 0, 1]", "detecting, by")):
        page.locator("#viewpoint").fill(typed)
        page.get_by_text("Find grasps").click()
        page.get_by_text(told).wait_for()
    assert '"viewpoint":[0,0,1]' in page.locator("#curl").text_content()
    page.set_input_files("#files", [tmp_path / "color.png"])
    page.get_by_text("add the depth image").wait_for()
    assert page.inner_text("#summary") == "No grasps yet"
    page.set_input_files("#files", [tmp_path / "cloud.npy"])
    page.locator("#approach").select_option("cone")
    for angle, sent in (("22.5", '"max_angle":0.3927'), ("60", '"max_angle":1.0472')):
        page.locator("#cone_angle").fill(angle)
        page.locator("#approach").select_option("")
        page.locator("#approach").select_option("cone")
        page.get_by_text("Find grasps").click()
        page.locator("#curl").get_by_text(sent).wait_for(state="attached")
    page.set_input_files("#files", [tmp_path / "cloud.npy", tmp_path / "camera.npz"])
    page.get_by_text("Open one cloud").wait_for()
    (tmp_path / "cut.npy").write_bytes((tmp_path / "cloud.npy").read_bytes()[:301])
    page.set_input_files("#files", [tmp_path / "cut.npy"])
    page.get_by_text("cut.npy: the file is damaged").wait_for()
    assert not page.locator("#curl").text_content()
    page.locator("#stage canvas").click()  # nothing is drawn any more


@pytest.mark.parametrize("name", ["mustard_bottle", "milk_clorox"])  # an image; a cloud
def test_grasps_of_a_real_camera_are_seen(real_server, open_page, shared_dir, name) -> None:
    page = open_page(real_server.http_url)
    answer_to(page, page.set_input_files, "#files", shared_dir / "real_scenes" / f"{name}.npz")
    assert page.locator("#grasps li:visible").count() == 12
    with_hands = bright(page)
    page.locator("#min_score").fill("1")
    assert with_hands > bright(page) + 500
    page.locator("#min_score").fill("0")
    if name == "milk_clorox":
        page.locator("#viewpoint").fill("0,0,0")
        page.get_by_text("Find grasps").click()
        page.locator("#warnings li").first.wait_for(state="detached")  # none is left
        assert len(shown(page)) == 12


def test_the_chosen_grasp_is_followed_in_the_next_image(real_server, open_page, tmp_path) -> None:
    page = open_page(real_server.http_url)
    for number in range(2):
        np.save(tmp_path / f"{number}.npy", image(number)["cloud"])
    page.set_input_files("#files", tmp_path / "0.npy")
    page.locator("#viewpoint").fill("0.35,0,0.55")
    answer_to(page, page.locator("#follow").check)
    page.locator("#grasps button").nth(2).click()
    before = json.loads(page.locator("#chosen_json").text_content())
    page.locator("#base").evaluate("base => base.value = 'its own'")  # hidden without an arm
    page.set_input_files("#files", tmp_path / "1.npy")
    page.get_by_text("detecting, by").wait_for()
    after = json.loads(page.locator("#chosen_json").text_content())
    assert after["id"] == before["id"]
    assert page.locator("#base").input_value() == "its own"
    y = [grasp["T_cloud_hand"][1][3] for grasp in (before, after)]
    assert y[1] - y[0] == pytest.approx(STEP, abs=0.002)


def test_a_server_with_tokens_is_asked_with_one(start_dummy, open_page, tmp_path: Path) -> None:
    (tmp_path / "tokens").write_text("a-token-of-this-test\n")
    with start_dummy("--token-file", str(tmp_path / "tokens")) as server:
        page = open_page(server.http_url)
        page.get_by_text("This server needs a token.").wait_for()
        page.locator("#token").fill("a-token-of-this-test")
        page.locator("#token").press("Enter")
        assert len(shown(page)) == 10
        assert "Authorization: Bearer $EDGEGRASP_CLIENT_TOKEN" in page.inner_text("#curl")
        assert "a-token" not in page.inner_text("#curl")


def test_a_narrow_page_has_all_and_the_keyboard_reaches_it(dummy_server, open_page) -> None:
    page = open_page(dummy_server.http_url, 400, 800)
    save_screenshot(page)
    controls = page.locator(
        "button:visible, input:visible, select:visible, textarea:visible, pre:visible"
    )
    boxes = [control.bounding_box() for control in controls.all()]
    assert all(box["x"] >= 0 and box["x"] + box["width"] <= 400 for box in boxes)
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        focused = page.locator(":focus")
        reached.add(focused.get_attribute("id") or focused.inner_text() if focused.count() else "")
    wanted = {"files", "sample", "model", "approach", "more", "debug", "min_score", "count", "curl"}
    assert wanted | {"Draw", "Find grasps", "Copy"} <= reached
    page.locator("[data-draw=region]").focus()
    page.keyboard.press("Enter")
    assert page.locator("#region_center").input_value().count(",") == 2
    page.locator("#grasps button").nth(1).focus()
    page.keyboard.press("Enter")
    assert page.inner_text("#rank") == "2"
