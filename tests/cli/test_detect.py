"""`edgegrasp detect` and `edgegrasp models`."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.cli.commands import refused, run

from edgegrasp_cli.flags import option_flags
from edgegrasp_model.options import DetectOptions


@pytest.fixture
def file(cloud: np.ndarray, tmp_path: Path) -> str:
    np.save(tmp_path / "cloud.npy", cloud)
    return str(tmp_path / "cloud.npy")


def test_every_option_is_a_flag_which_wins_over_the_options_file(
    file, dummy_server, tmp_path
) -> None:
    assert [flag.name for flag in option_flags()] == list(DetectOptions.model_fields)
    options = tmp_path / "options.json"
    options.write_text('{"top_k": null}')  # a field left out, with a server or without
    assert "returned" in run("detect", file, "--options", options)
    options.write_text(json.dumps({"top_k": 4, "seed": 3, "collision": {"mode": "penalise"}}))
    asked = ("detect", file, "--server", dummy_server.grpc_address, "--json", "--options", options)
    assert len(json.loads(run(*asked))["grasps"]) == 4
    assert len(json.loads(run(*asked, "--top-k", 2))["grasps"]) == 2
    for text, sentence in (("[]", "a JSON object is needed"), ("{", "Expecting property name")):
        options.write_text(text)
        assert sentence in refused(*asked)


def test_json_of_a_server_needs_no_package_of_the_server(
    camera_files, dummy_server, monkeypatch
) -> None:
    """`pip install 'edgegrasp[cli,view]'` is enough."""
    monkeypatch.setitem(sys.modules, "orjson", None)
    monkeypatch.delitem(sys.modules, "edgegrasp_service.worker.answer", raising=False)
    asked = ("--server", dummy_server.grpc_address, "--json")
    assert len(json.loads(run("detect", *camera_files, *asked))["grasps"]) == 10


def test_a_table_shows_counts_and_warnings(file: str, dummy_server) -> None:
    output = run("detect", file, "--server", dummy_server.http_url, "--top-k", "3")
    assert len(re.findall(r"^\d +0\.\d{3}.* (?:yes|no) *$", output, re.MULTILINE)) == 3
    assert "500 points" in output
    assert "Warning: The dummy detector made these grasps up." in output


@pytest.fixture
def camera_files(tmp_path: Path) -> list[str]:
    """Flags of a depth image, 0.6 m everywhere, of its colours and of a mask."""
    depth, mask = np.full((24, 32), 6000, np.uint16), np.zeros((24, 32), np.uint8)
    mask[4:12, 16:30] = 255
    for name, pixels in (("depth", depth), ("mask", mask), ("color", mask[..., None].repeat(4, 2))):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    flags = [f"--{name}={tmp_path / name}.png" for name in ("depth", "mask", "color")]
    return [*flags, "--intrinsics", "300,300,15.5,11.5", "--depth-scale", "0.0001"]


def test_a_depth_image_is_grasped_where_its_mask_is(camera_files, dummy_server) -> None:
    flags = (*camera_files, "--json", "--num-approach-points", "4", "--debug", "--support", "none")
    document = json.loads(run("detect", *flags), parse_constant=pytest.fail)  # NaN is null
    assert document["counts"]["points"] == 24 * 32
    assert document["counts"]["in_approach_region"] < document["counts"]["kept"]
    debug = document["debug"]
    for name in ("approach_index", "contact_index"):
        x, y, z = np.asarray(debug["points"])[debug[name]].T
        assert np.allclose(z, 0.6, atol=1e-3)
        column, row = 300 * x / z + 15.5, 300 * y / z + 11.5
        assert ((column > 14) & (column < 31) & (row > 2) & (row < 13)).all()
    for address in (dummy_server.grpc_address, dummy_server.http_url):
        assert json.loads(run("detect", *flags, "--server", address))["counts"]["points"] == 768


def test_a_picture_shows_the_cloud_its_grasps_and_the_region(
    camera_files, file, dummy_server, tmp_path
) -> None:
    depth, _, color, *camera = camera_files
    asked = ("--server", dummy_server.http_url, "--picture")
    clouds = {"depth": (depth, *camera), "color": (depth, color, *camera), "cloud": (file,)}
    ball = '{"include":[{"kind":"sphere","center":[0,0,0],"radius":0.05}]}'
    clouds["region"] = (file, "--contact-region", ball)
    pictures = {}
    for name, flags in clouds.items():
        drawn = tmp_path / f"seen_{name}.png"
        run("detect", *flags, *asked, drawn)
        with Image.open(drawn) as picture:
            pictures[name] = np.asarray(picture.convert("RGB")).astype(int)
    white = {name: (pixels.min(axis=2) > 250).mean() for name, pixels in pictures.items()}
    assert white["color"] > white["depth"]  # the mask's white is the image's
    assert 1 - white["cloud"] > 0.02
    near = {name: np.abs(each - (76, 201, 240)).max(axis=2) for name, each in pictures.items()}
    cyan = {name: apart < 30 for name, apart in near.items()}
    assert cyan["region"].sum() > 200 > cyan["cloud"].sum()


def test_grey_colours_are_those_of_their_pixels(camera_files, dummy_server) -> None:
    depth, mask, _, *camera = camera_files
    file = mask.removeprefix("--mask=")
    for mode in ("L", "LA"):
        Image.open(file).convert(mode).save(file)
        asked = ("detect", depth, f"--color={file}", *camera, "--server", dummy_server.grpc_address)
        assert json.loads(run(*asked, "--json"))["counts"]["points"] == 24 * 32


def test_a_picture_that_cannot_be_written_is_refused_before_any_work(tmp_path) -> None:
    for name, message in (
        ("seen.gif", "Name a file .png or"),
        ("seen", "Name a file"),
        ("nowhere/seen.png", "there is no folder"),
    ):
        shown = refused("detect", tmp_path / "no.npy", "--picture", tmp_path / name)
        assert message in " ".join(shown.split())
    moved = (*ARM, "--joints", "0", "--trajectory", tmp_path / "nowhere/motion.json")
    assert "--trajectory: there is no folder" in refused("detect", tmp_path / "no.npy", *moved)


def test_several_depth_images_are_one_cloud(camera_files, dummy_server) -> None:
    depth, _, _, *camera = camera_files
    pose = "--pose", json.dumps(np.eye(4).tolist())
    asked = ("detect", depth, depth, *camera, *pose, "--server", dummy_server.grpc_address)
    assert json.loads(run(*asked, *pose, "--json"))["counts"]["points"] == 2 * 768
    assert "Give one for each of 2 images" in " ".join(refused(*asked).split())


ARM = ("--robot", "fr3", "--base", "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1")


def test_input_that_cannot_be_used_is_named(camera_files, file, dummy_server, tmp_path):
    depth, mask, *_ = camera_files
    absent, foreign, unknown = (tmp_path / name for name in ("no.npy", "foreign.npy", "cloud.las"))
    foreign.write_bytes(b"foreign")
    unknown.write_bytes(b"0 0 0")
    to_server = (file, "--server", dummy_server.grpc_address)
    for flags, sentence in (
        ((absent,), "No such file"),
        ((unknown,), "Give one of: npy, npz, ply, pcd, xyz; a depth image as"),
        ((foreign,), "cloud: got 7 bytes that are not a complete .npy file"),
        ((foreign, "--top-k", "0"), "options.top_k: got 0."),
        ((*to_server, "--model", "resnet"), "options.model: got 'resnet'. Use one of: dummy."),
        ((*to_server, "--up", "0,0"), "options.up"),
        ((depth,), "--intrinsics: got nothing. Give fx,fy,cx,cy"),
        ((), "give a cloud file, or --depth and --intrinsics"),
        ((file, *camera_files), "give a cloud file, or --depth and --intrinsics"),
        ((depth, "--intrinsics", "300,300,640,360"), "cx: got 640, outside of an image of 32 x 24"),
        ((depth, *2 * ("--intrinsics", "300")), "--intrinsics: got 2. Give one for all, or one"),
        ((depth, "--intrinsics", "300", *2 * ("--pose", "[]")), "--pose: got 2. Give one for each"),
        ((file, "--pose", "[]"), "--pose: got a cloud as well. Give --depth instead."),
        ((file, *ARM, "--joints", "0,a"), "options.robot.joints.0: got '0,a'"),
        ((file, "--place", "[0, 0, 0]"), "--robot: got nothing. Give --robot, --joints, --base"),
        ((file, "--avoid-unseen"), "--robot: got nothing. Give --robot, --joints, --base"),
        ((depth, "--intrinsics", "300"), "depth_images.0.intrinsics: got 300"),
        ((depth.removeprefix("--depth="),), "a depth image as `depth` with `intrinsics`"),
        ((file, mask), "768 values for a cloud of 500 rows"),
        ((file, "--mask", unknown), "cloud.las: got '.las'. Give a .png or .npy file."),
    ):
        assert sentence in refused("detect", *flags)


def test_a_device_that_is_not_there_is_named(file, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "edgegrasp detect: device: got 'cuda'" in refused("detect", file, "--device", "cuda")
    assert "Use auto, cpu, cuda" in refused("detect", file, "--device", "gpu")


def test_models_are_listed_from_a_server_or_from_here(dummy_server) -> None:
    for address in (dummy_server.grpc_address, dummy_server.http_url):
        assert "dummy" in run("models", "--server", address)
    assert "panda" in run("models")
    assert "edgegrasp models: " in refused("models", "--server", "127.0.0.1:1")
    for command in (("models", "--device", "cuda"), ("detect", "x.npy", "--grippers", "x.toml")):
        beside = refused(*command, "--server", dummy_server.grpc_address)
        assert f"{command[-2]}: got --server as well" in beside


def test_a_server_with_tls_and_tokens(file, pem, tmp_path, start_dummy, monkeypatch):
    token = tmp_path / "token"
    token.write_text("user-token-0123456789\n")
    names = ("certificate", ""), ("key", "_key")
    own, certificates = (
        [f"--tls-{name}={pem[who + end]}" for name, end in names] for who in ("server", "client")
    )
    with start_dummy(*own, f"--tls-client-ca={pem['ca']}", f"--token-file={token}") as server:
        for address in (server.grpc_address, server.http_url):
            asked = ("--server", address, *certificates, "--tls-ca", pem["ca"])
            document = json.loads(run("detect", file, *asked, "--token-file", token, "--json"))
            assert len(document["grasps"]) == 10
            monkeypatch.setenv("EDGEGRASP_CLIENT_TOKEN", "user-token-0123456789")
            run("models", *asked)
            monkeypatch.delenv("EDGEGRASP_CLIENT_TOKEN")
            assert "authorization: got nothing" in refused("models", *asked)
            refused("detect", file, "--server", address, "--tls-ca", pem["ca"])
    absent = ("--token-file", tmp_path / "none")
    assert "token file" in refused("models", "--server", "127.0.0.1:1", *absent)
