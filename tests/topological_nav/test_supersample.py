"""Drawing smaller is compared with drawing as the networks learned."""

import dataclasses

import pytest

from docs.studies import supersample
from interactive_nav.scenes.scene import load_scene
from tests.topological_nav.conftest import Made
from topological_nav.learn.training import Networks, load_networks


def test_the_largest_is_compared_with_itself_and_the_others_with_it(made: Made, monkeypatch):
    networks = load_networks(made.rooms, made.passages)
    learned = dataclasses.replace(networks.camera, supersample=2)
    monkeypatch.setattr(Networks, "camera", learned)
    (two, one), typical = supersample.compare(load_scene(made.scene), *networks, places=7)
    assert two[2:] == (0.0, 0.0, 0.0, 0.0) and (two.supersample, one.supersample) == (2, 1)
    assert 0.0 < one.embedding < typical and 0.0 < one.mean_p < one.largest_p < 1.0
    assert one.flips * 14 == pytest.approx(round(one.flips * 14)) and min(one.images_per_s, two.images_per_s) > 0
