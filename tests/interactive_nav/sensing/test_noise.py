"""Errors of cameras against their formulas, on flat pictures and by hand."""

import functools
import math
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav.camera_config import KINECT, CameraNoise
from interactive_nav.config import NavConfig
from interactive_nav.sensing.sensors import blurred, disturbed, noisy_depth
from interactive_nav_common.errors import ConfigError
from scenes_mjcf.look import Lens

LENS = Lens(80, 60, 60.0)


def key_of(name, seed=0):
    return jax.random.fold_in(jax.random.PRNGKey(seed), zlib.crc32(name.encode()))


def pictures(depth_m, rgb=(0.5, 0.5, 0.5)):
    shape = (LENS.height, LENS.width)
    return {
        "depth": jnp.full(shape, depth_m),
        "segmentation": jnp.full(shape, 2, jnp.uint8),
        "rgb": jnp.broadcast_to(jnp.asarray(rgb, jnp.float32), (*shape, 3)),
        "normals": jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), (*shape, 3)),
    }


@functools.cache
def drawn(noise):
    return jax.jit(lambda images, seed: disturbed(noise, LENS, images, key_of=lambda name: key_of(name, seed)))


def seen(noise, images, seed=0):
    return {name: np.asarray(value) for name, value in drawn(noise)(images, seed).items()}


def test_without_settings_nothing_is_disturbed():
    clean = pictures(2.0)
    for name, value in seen(CameraNoise(), clean).items():
        np.testing.assert_array_equal(value, clean[name])


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_error_of_depth_grows_with_its_square(z):
    depth = seen(CameraNoise(depth_disparity_noise=0.0014), pictures(z))["depth"]
    assert depth.std() == pytest.approx(0.0014 * z**2, rel=0.05)
    assert depth.mean() == pytest.approx(z, abs=0.0014 * z**2 / 10)


def test_depth_is_read_in_steps_of_disparity():
    depth = jnp.linspace(0.5, 5.0, 4800).reshape(60, 80)
    out = np.asarray(noisy_depth(CameraNoise(depth_disparity_step=0.0028), LENS, depth, None, key_of))
    steps = 1 / out / 0.0028
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    # Khoshelham and Elberink: 7 cm between neighbouring readings at 5 m.
    far = np.unique(out)[-2:]
    assert far[1] - far[0] == pytest.approx(0.0028 * 25, rel=0.05)
    assert np.abs(out - depth).max() <= 0.5 * 0.0028 * 25 * 1.05


def test_depth_is_lost_at_grazing_angles_behind_edges_and_out_of_range():
    # A floor 1 m below a level camera is seen at the angle by which a pixel's ray falls.
    up = np.asarray(LENS.rows)[:, None] + 0 * np.asarray(LENS.columns)
    floor = jnp.asarray(np.where(up < 0, -1 / np.minimum(up, -1e-6), 0.0).astype(np.float32))
    normals = jnp.asarray(np.where((up < 0)[..., None], [0.0, 1.0, 0.0], 0.0).astype(np.float32))
    out = np.asarray(noisy_depth(CameraNoise(depth_grazing_deg=20.0), LENS, floor, normals, key_of))
    angle = np.degrees(np.arcsin(-up / np.sqrt(1 + up**2 + np.asarray(LENS.columns) ** 2)))
    np.testing.assert_array_equal(out > 0, angle > 20.0)
    assert (out > 0).any() and ((out == 0) & (up < 0)).any()
    step = jnp.where(jnp.arange(80)[None] < 40, 1.0, 2.0) * jnp.ones((60, 1))
    out = np.asarray(noisy_depth(CameraNoise(depth_edge_m=0.5), LENS, step, None, key_of))
    lost = np.zeros((60, 80), bool)
    lost[:, 40] = True
    np.testing.assert_array_equal(out == 0, lost)
    for low, high, kept in ((1.5, 0.0, 2.0), (0.0, 1.5, 1.0)):
        out = np.asarray(noisy_depth(CameraNoise(depth_min_m=low, depth_max_m=high), LENS, step, None, key_of))
        np.testing.assert_array_equal(out, np.where(step == kept, kept, 0.0))


def test_colours_have_exposure_blur_and_the_sensors_two_noises():
    clean = pictures(2.0, (0.16, 0.16, 0.64))
    rgb = seen(CameraNoise(rgb_noise=0.01, rgb_shot_noise=0.03), clean)["rgb"]
    for channel, value in ((0, 0.16), (2, 0.64)):
        assert rgb[..., channel].std() == pytest.approx(math.hypot(0.01, 0.03 * math.sqrt(value)), rel=0.05)
    frames = [seen(CameraNoise(rgb_exposure=0.2), clean, seed)["rgb"] for seed in range(200)]
    stops = np.log2(np.stack([frame[0, 0, 0] for frame in frames]) / 0.16)
    assert stops.std() == pytest.approx(0.2, rel=0.15)
    np.testing.assert_allclose(frames[0], frames[0][:1, :1] * np.ones((60, 80, 1)), atol=1e-6)
    point = jnp.zeros((41, 41, 1)).at[20, 20].set(1.0)
    spread = np.asarray(blurred(point, 2.0))[..., 0]
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    offset = np.arange(41) - 20
    assert math.sqrt((spread.sum(0) * offset**2).sum()) == pytest.approx(2.0, rel=0.03)
    np.testing.assert_allclose(blurred(jnp.ones((5, 5, 1)), 2.0), 1.0, atol=1e-6)


def test_pixels_and_whole_frames_drop_out():
    clean = pictures(2.0)
    out = seen(CameraNoise(rgb_dropout=0.2), clean)
    assert (out["rgb"] == 0).all(-1).mean() == pytest.approx(0.2, abs=0.03)
    assert ((out["rgb"] == 0).all(-1) == (out["rgb"] == 0).any(-1)).all()
    frames = [seen(CameraNoise(frame_dropout=0.3), clean, seed) for seed in range(150)]
    lost = np.array([not frame["depth"].any() for frame in frames])
    assert lost.mean() == pytest.approx(0.3, abs=0.12)
    for frame, gone in zip(frames[:20], lost, strict=False):
        for name, value in frame.items():
            np.testing.assert_array_equal(value, 0 if gone else clean[name])


def test_settings_of_noise_stand_among_the_environments_and_are_checked():
    config = NavConfig.of(observations=("depth",), **KINECT)
    assert {name: getattr(config, name) for name in KINECT} == KINECT
    for settings, message in (
        ({"rgb_nois": 1.0}, "unknown setting 'rgb_nois'; did you mean 'rgb_noise'"),
        ({"rgb_noise": 0.1, "observations": ("depth",)}, "rgb_noise is 0.1, which changes .* rgb among observations"),
        ({"depth_edge_m": 0.1, "observations": ("rgb",)}, "depth_edge_m is 0.1, .* depth among observations"),
        ({"frame_dropout": 0.1}, "frame_dropout is 0.1, which changes nothing here"),
        ({"depth_max_m": 1.0, "depth_min_m": 2.0, "observations": ("depth",)}, "depth_max_m is 1.0, expected more"),
        ({"rgb_noise": -1.0, "observations": ("rgb",)}, "rgb_noise is -1.0, expected 0 or more"),
    ):
        with pytest.raises(ConfigError, match=message):
            NavConfig.of(**settings)
