"""Words in, settings out; wrong ones refused by name."""

import importlib
import typing

import pytest

from interactive_nav_common.config import Bounds, Settings, overlay, overridden, settings_help, to_dict
from interactive_nav_common.errors import ConfigError
from topological_nav.config import TASKS, DataConfig, NetworkTrainConfig, PolicyConfig
from topological_nav.data.domains import AdaptConfig


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


@pytest.mark.parametrize(
    ("kind", "name", "wrong"),
    [
        (PolicyConfig, "learning_rate", 0.0),
        (AdaptConfig, "critic_learning_rate", 11.0),
    ],
)
def test_ranges_with_small_ends_are_checked(kind, name, wrong):
    with pytest.raises(ConfigError, match=f"{name} is {wrong}, expected between"):
        kind(**{name: wrong})


def _inner(hint):
    yield from getattr(hint, "__metadata__", ())
    for argument in typing.get_args(hint):
        yield from _inner(argument)


def _subclasses(kind):
    for below in kind.__subclasses__():
        yield below
        yield from _subclasses(below)


def test_every_annotation_of_a_setting_is_bounds():
    """Pydantic passes over what it does not know: a plain pair would check nothing."""
    for module in ("train.sweep.spec", "converters.generate.homes.config"):
        importlib.import_module(module)
    kinds = {kind for kind in _subclasses(Settings) if not kind.__module__.startswith("tests")}
    hints = [hint for kind in kinds for hint in typing.get_type_hints(kind, include_extras=True).values()]
    marks = [mark for hint in hints for mark in _inner(hint)]
    assert len(kinds) > 20 and len(marks) > 200
    assert [mark for mark in marks if not isinstance(mark, Bounds)] == []
