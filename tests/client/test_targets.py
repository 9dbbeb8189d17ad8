import numpy as np

from edgegrasp_client import object_in_scene, on_mask


def test_a_mask_narrows_the_regions_that_are_asked_for() -> None:
    ball = {"kind": "sphere", "center": [0, 0, 0.5], "radius": 0.1}
    asked = {"top_k": 3, "contact_region": {"include": [ball]}}
    mask = np.zeros((2, 3, 4), np.uint8)
    mask[0, 1, 2] = 255  # red, green, blue
    mask[1, 2, 3] = 255  # transparency says nothing
    options = on_mask(mask, asked)
    assert options["top_k"] == 3
    assert options["contact_region"]["include"] == [ball]
    for name in ("approach_region", "contact_region"):
        (outside,) = options[name]["exclude"]
        np.testing.assert_array_equal(outside["mask"], [[True, False, True], [True] * 3])
    assert "exclude" not in asked["contact_region"]


def test_an_object_is_cut_out_of_the_scene_that_repeats_it() -> None:
    rng = np.random.default_rng(0)
    scene = rng.uniform(-0.3, 0.3, (4000, 3))
    wanted = np.linalg.norm(scene - 0.1, axis=1) < 0.08
    holed = np.concatenate([scene, [[np.nan] * 3]])
    for around in (holed, scene[~wanted]):
        cloud, segment_ids = object_in_scene(scene[wanted], around)
        np.testing.assert_array_equal(cloud[segment_ids == 1], scene[wanted].astype(np.float32))
        far = np.linalg.norm(cloud[segment_ids == 0] - 0.1, axis=1)
        assert far.min() > 0.07
        assert 0.97 * (~wanted).sum() < len(far) <= (~wanted).sum()
