"""The packaged networks as ONNX files against JAX, on pictures of a committed scene."""

import json
from pathlib import Path

import numpy as np
import pytest

from interactive_nav.interop import onnx_file
from interactive_nav.interop.onnx_file import OnnxError, OnnxFile
from topological_nav import commands
from topological_nav.__main__ import main
from topological_nav.drives.driving import load_policy
from topological_nav.learn.training import load_networks
from topological_nav.weights.export import level_images, packaged_weights

onnxruntime = pytest.importorskip("onnxruntime")
SCENE = Path(__file__).parents[3] / "scenes_mjcf" / "cedar"
RUNS = [packaged_weights() / name for name in ("rooms", "passages", "policy")]
pytestmark = pytest.mark.skipif(not RUNS[-1].is_dir(), reason="no weights are committed")
WORDS = [*("--onnx", "--localiser", str(RUNS[0]), "--detector", str(RUNS[1]), "--policy", str(RUNS[2]))]


@pytest.fixture(scope="module")
def images():
    """Three pictures around a place: [1, 3, 96, 128, 3]."""
    return level_images(SCENE, load_networks(RUNS[0], RUNS[1]), 1)[:, ::6]


@pytest.fixture(scope="module")
def files(images, tmp_path_factory):
    out = tmp_path_factory.mktemp("onnx") / "files"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands, "level_images", lambda *_: images)
        assert main(["export", *WORDS, "-o", str(out)]) == 0
    return {path.stem: OnnxFile(path) for path in out.iterdir()}


def test_the_files_compute_what_jax_computes_and_describe_it(files, images):
    networks, driver, images = load_networks(RUNS[0], RUNS[1]), load_policy(RUNS[2]), images[0]
    assert images.shape == (3, 96, 128, 3) and images.std() > 10
    for name, network in (("rooms", networks.localiser), ("passages", networks.detector)):
        for output, expected in (("embedding", network.embed(images)), ("logits", network.logits(images))):
            got = files[name].run(output, {"image": images})
            assert np.abs(got - expected).max() <= 1e-5 * max(1.0, np.abs(expected).max())
    state, memory = driver.start(1), [np.zeros((1, 256), np.float32)] * 2
    for image in images:
        parts = [files[name].run("embedding", {"image": image[None]}) for name in ("rooms", "passages")]
        embedding = np.concatenate(parts, -1)
        inputs = dict(zip(("embedding", "linear_memory", "angular_memory"), (embedding, *memory), strict=True))
        state, linear, angular = driver.act(state, image[None])
        assert files["policy"].run("twist", inputs)[0] == pytest.approx([*linear, *angular])
        memory = [files["policy"].run(f"next_{name}_memory", inputs) for name in ("linear", "angular")]
        np.testing.assert_allclose(memory, state, atol=1e-4)  # rounded in three files one after the other
    about = files["policy"].about
    assert about["robot"] == {"name": "ttbot", "control_mode": "twist", "rate_hz": 10.0}
    image = files["rooms"].about["inputs"]["image"]
    assert (image["shape"], image["dtype"], image["range"]) == ([96, 128, 3], "uint8", [0, 255])
    assert image["scale"] == pytest.approx(1 / 255) and (image["frame"], image["rate_hz"]) == ("camera", 10.0)
    twist = about["outputs"]["twist"]
    assert (twist["low"], twist["high"], twist["frame"]) == ([0.0, -0.5], [0.5, 0.5], "base")
    camera = about["cameras"][0]
    assert (camera["vertical_fov_deg"], camera["width"], camera["height"]) == (120.0, 128, 96)
    assert files["passages"].about["outputs"]["logits"]["names"][1] == "free to 1.0 m"
    digest = json.loads((RUNS[0] / "network.json").read_text())["digest"]
    assert files["rooms"].about["network"]["digest"] == digest


def test_what_differs_from_jax_is_refused():
    values = np.ones((2, 3), np.float32)
    with pytest.raises(OnnxError, match="output y differs by 1.0e-0[34] between ONNX and JAX over 2 observations"):
        onnx_file.convert(lambda x: x * 1.001, {"x": values}, {"y": values}, {})


def test_what_onnx_files_do_not_have_is_refused(capsys):
    assert main(["export", "--onnx", "--maps", "M"]) == 2
    assert capsys.readouterr().err == "topological_nav: --maps has no effect with --onnx; leave it out\n"
