"""Words in, settings out; wrong ones refused by name."""

import pytest

from interactive_nav_common.config import overlay, overridden, settings_help, to_dict
from interactive_nav_common.errors import ConfigError
from topological_nav.config import TASKS, DataConfig, NetworkTrainConfig


def test_words_are_read_by_the_types_of_the_settings():
    config = overridden(NetworkTrainConfig(), ["learning_rate=1e-4", "epochs=3", "augment=false", "init=7"])
    assert (config.learning_rate, config.epochs, config.augment, config.init) == (1e-4, 3, False, "7")
    data = overridden(DataConfig(), ["fov_deg=60", "num_rooms=auto"])
    assert (data.fov_deg, data.num_rooms) == (60.0, None)


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("epoch=3", "unknown key 'epoch', did you mean 'epochs'?"),
        ("epochs", "expected key=value"),
        ("epochs=2.5", "epochs is 2.5, expected a whole number"),
        ("epochs=0", "epochs is 0, expected between 1"),
        ("network=vgg", "network is 'vgg', expected one of resnet18, alexnet"),
        ("augment=1", "augment is 1, expected true or false"),
        ("learning_rate=fast", "learning_rate is 'fast', expected a number"),
    ],
)
def test_wrong_words_are_refused(word, told):
    with pytest.raises(ConfigError, match=told.replace("?", r"\?")):
        overridden(NetworkTrainConfig(), [word])


def test_headings_must_leave_every_third_for_testing():
    with pytest.raises(ConfigError, match="headings is 16, expected a multiple of 3"):
        DataConfig(headings=16)


def test_settings_written_down_are_read_back():
    config = DataConfig(seed=3, fov_deg=None, room_method="spectral")
    assert to_dict(config)["fov_deg"] == "auto"
    assert overlay(DataConfig(), to_dict(config), "file") == config


def test_defaults_are_the_reports():
    rooms, passages = TASKS["rooms"], TASKS["passages"]
    assert (rooms.batch, rooms.epochs, rooms.learning_rate, rooms.hidden) == (20, 15, 1e-4, 512)
    assert (passages.batch, passages.epochs, passages.learning_rate) == (32, 20, 1e-4)
    data = DataConfig()
    assert (data.positions, data.clearance_m, data.max_per_room, data.headings) == (100, 0.2, 10, 18)
    assert (data.width * data.supersample, data.height * data.supersample) == (640, 480)
    assert (data.passage_sources, data.passage_targets, data.passage_points) == (10, 10, 50)


def test_help_names_every_setting_with_its_meaning():
    text = settings_help(NetworkTrainConfig())
    assert "network=resnet18" in text and "[resnet18 | alexnet]" in text
    assert len(text.splitlines()) == len(to_dict(NetworkTrainConfig()))
