"""Cameras by hand: flat grey, single points and edges."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from interactive_nav_common.errors import ConfigError
from topological_nav.data.domains import PRESETS, AdaptConfig, DomainConfig, as_seen, as_seen_from, smeared


def flat(level, count=1, height=12, width=16):
    return np.full((count, height, width, 3), level, np.uint8)


def test_the_defaults_change_nothing():
    images = np.random.default_rng(0).integers(0, 256, (3, 2, 8, 8, 3), np.uint8)
    assert as_seen(images, DomainConfig(seed=7)) is images


def test_a_stop_is_twice_the_light_and_warmth_moves_red_and_blue():
    # 128 / 255 to the power of 2.2 is 0.2195; half and twice as much light.
    darker, brighter = (as_seen(flat(128), DomainConfig(exposure_ev=ev))[0, 0, 0, 0] for ev in (-1, 1))
    assert darker == round(255 * (0.2195 / 2) ** (1 / 2.2)) == 93
    assert brighter == round(255 * (0.2195 * 2) ** (1 / 2.2)) == 175
    assert as_seen(flat(255), DomainConfig(exposure_ev=3.0)).min() == 255
    red, green, blue = as_seen(flat(128), DomainConfig(warmth=0.2))[0, 0, 0]
    assert (red, green, blue) == (round(128 * 1.2 ** (1 / 2.2)), 128, round(128 * 0.8 ** (1 / 2.2)))


def test_contrast_turns_about_middle_grey():
    seen = [int(as_seen(flat(level), DomainConfig(contrast=2.0))[0, 0, 0, 0]) for level in (10, 100, 160, 250)]
    assert seen == [
        0,
        pytest.approx(2 * (100 - 127.5) + 127.5, abs=0.6),
        pytest.approx(2 * (160 - 127.5) + 127.5, abs=0.6),
        255,
    ]


def test_corners_lose_the_light_of_the_vignette_and_the_middle_none():
    seen = as_seen(flat(200, height=13, width=17), DomainConfig(vignette=0.5))[0, ..., 0]
    assert seen[6, 8] == 200
    assert [seen[y, x] for y in (0, -1) for x in (0, -1)] == [round(200 * 0.5 ** (1 / 2.2))] * 4


def test_zoom_enlarges_about_the_middle():
    images = np.zeros((1, 9, 9, 3), np.uint8)
    images[0, 3:6, 3:6] = 255
    seen = as_seen(images, DomainConfig(zoom=2.0))[0, ..., 0]
    # The square of 3 pixels, from -1 to 1 about the middle, ends at -2 and 2 now.
    assert (seen[2:7, 2:7] == 255).all()
    assert seen[0].max() == 0 and seen[:, 8].max() == 0


def test_a_barrel_keeps_corners_and_middle_and_bulges_what_is_between():
    line = np.arange(0, 255, 5, dtype=np.uint8)[:51]
    images = np.broadcast_to(line[None, None, :, None], (1, 51, 51, 3)).copy()
    seen = as_seen(images, DomainConfig(barrel=0.5))[0, ..., 0].astype(int)
    assert [seen[0, 0], seen[25, 25], seen[50, 50]] == [0, 125, 250]
    # Half way to the right border: r = 12 / (25 root 2) = 0.339, so from 12 (1 + 0.5 r^2) / 1.5 = 8.46 pixels.
    assert seen[25, 37] == pytest.approx(125 + 5 * 8.46, abs=1)


@given(st.floats(0.0, 6.0))
def test_smearing_keeps_the_light_of_a_point_and_its_place(way):
    light = np.zeros((3, 21, 3), np.float32)
    light[1, 10] = 1.0
    seen = smeared(light, way)
    assert seen.sum() == pytest.approx(3.0, abs=1e-5) and seen[[0, 2]].max() == 0
    assert (seen[1, :, 0] * np.arange(21)).sum() == pytest.approx(10.0, abs=1e-4)
    # A window of 1 + way pixels.
    assert seen[1, 10, 0] == pytest.approx(1 / (1 + way), abs=1e-6)


def test_noise_has_the_spread_that_is_asked_for():
    level = round(255 * 0.25 ** (1 / 2.2))
    config = DomainConfig(shot_noise=0.04, read_noise=0.01)
    seen = as_seen(flat(level, 4, 64, 64), config).astype(float)
    light = (seen / 255) ** 2.2
    assert light.mean() == pytest.approx(0.25, abs=0.003)
    assert light.std() == pytest.approx(np.sqrt(0.04**2 * 0.25 + 0.01**2), rel=0.05)


def test_chance_follows_from_seed_and_stream_alone():
    images = np.random.default_rng(1).integers(0, 256, (5, 12, 16, 3), np.uint8)
    camera = PRESETS["camera"]
    first = as_seen(images, camera)
    assert (as_seen(images, camera) == first).all()
    assert (as_seen(images, camera, 1) != first).any()
    assert (as_seen(images, dataclasses.replace(camera, seed=1)) != first).any()
    # Not on how the set is shaped.
    assert (as_seen(images[None], camera)[0] == first).all()


def test_chance_may_follow_from_where_an_image_was_taken():
    images = np.random.default_rng(1).integers(0, 256, (4, 12, 16, 3), np.uint8)
    images[1] = images[0]
    xy, heading = np.array([[1.0, 2.0], [1.0, 2.0], [-1.0, 2.0], [1.0, -2.0]]), np.array([0.3, 0.3, 0.3, -0.3])
    camera = PRESETS["camera"]
    seen = as_seen_from(images, camera, xy, heading)
    assert (seen[0] == seen[1]).all()
    assert (as_seen_from(images[2:], camera, xy[2:], heading[2:]) == seen[2:]).all()
    moved = as_seen_from(images, camera, xy + [0.0, 1e-5], heading + [0.0, 0.002, 0.0, 0.0])
    assert (moved[[0, 2, 3]] == seen[[0, 2, 3]]).all() and (moved[1] != seen[1]).any()
    assert (as_seen_from(images, dataclasses.replace(camera, seed=1), xy, heading) != seen).any(axis=(1, 2, 3)).all()
    # Without chance it is the camera of every set.
    lens = PRESETS["lens"]
    assert (as_seen_from(images, lens, xy, heading) == as_seen(images, lens)).all()
    assert as_seen_from(images, DomainConfig(), xy, heading) is images


def test_unknown_cameras_and_impossible_ones_are_refused():
    with pytest.raises(ConfigError, match="domain is 'fog', expected one of clean, lens, light, noise, blur, camera"):
        AdaptConfig(domain="fog")
    with pytest.raises(ConfigError, match="zoom is 0.5, expected between 1 and 10"):
        DomainConfig(zoom=0.5)
