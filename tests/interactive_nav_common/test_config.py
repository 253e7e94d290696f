"""One mechanism of settings: composed dataclasses with flat words, and values refused by their types."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Annotated, Literal

import numpy as np
import pytest

from interactive_nav.config import NavConfig
from interactive_nav_common.config import (
    AtLeastOne,
    Bounds,
    Positive,
    Settings,
    flatten,
    overlay,
    replace,
    settings_help,
    to_dict,
)
from interactive_nav_common.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Wheels(Settings):
    """Turn."""

    radius_m: Positive | None = None
    """Of one."""
    kind: Literal["rubber", 4] = "rubber"
    """What they are."""
    spokes: int = 3
    """Of a rubber one."""

    IDLE = (("spokes", "kind rubber", lambda c: c.kind == "rubber"),)


@dataclasses.dataclass(frozen=True)
class Cart(Wheels):
    """Is pushed."""

    sizes: tuple[AtLeastOne, ...] = (2, 3)
    """Of it."""
    tilt_deg: Annotated[float, Bounds(0, 90, open=True)] = 1.0
    """Of it."""


@dataclasses.dataclass(frozen=True)
class Train(Settings):
    """Carts."""

    cart: Cart = dataclasses.field(default_factory=Cart)
    """Of it."""
    cars: AtLeastOne = 1
    """Of it."""


def test_numbers_of_numpy_become_pythons():
    train = Train.of(cart=Cart.of(tilt_deg=np.float32(2.5)), cars=np.int64(3))
    assert (type(train.cars), train.cars) == (int, 3)
    assert (type(train.cart.tilt_deg), train.cart.tilt_deg) == (float, 2.5)
    with pytest.raises(ConfigError, match="cars is 0, expected at least 1"):
        Train.of(cars=np.int64(0))


def test_inherited_settings_are_among_those_of_the_whole():
    train = Train(cart=Cart.of(radius_m=0.1, sizes=[4]))
    assert isinstance(train.cart, Wheels) and train.cart.radius_m == 0.1
    assert list(flatten(train)) == [
        *("cart.radius_m", "cart.kind", "cart.spokes", "cart.sizes", "cart.tilt_deg"),
        "cars",
    ]
    plain = {"cart": {"radius_m": 0.1, "kind": "rubber", "spokes": 3, "sizes": [4], "tilt_deg": 1.0}, "cars": 1}
    assert to_dict(train) == plain and overlay(Train(), plain, "file") == train
    assert replace(train.cart, kind=4, tilt_deg=2.0) == Cart(0.1, 4, 3, (4,), 2.0)
    assert "cart.kind=rubber    What they are. [rubber | 4]" in settings_help(Train(), {"cars": "many"})
    assert "cars=1              Of it. [many]" in settings_help(Train(), {"cars": "many"})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius_m": 0.0}, "radius_m is 0.0, expected a positive number"),
        ({"radius_m": math.inf}, "radius_m is inf, expected a positive number"),
        ({"kind": "ruber"}, "kind is 'ruber', expected one of rubber, 4, did you mean 'rubber'?"),
        ({"kind": 4, "spokes": 5}, "spokes is 5, which changes nothing here: expected kind rubber; or leave it out"),
        ({"sizes": (1, 0)}, "sizes[1] is 0, expected at least 1"),
        ({"tilt_deg": 90.0}, "tilt_deg is 90.0, expected between 0 and 90, both excluded"),
        ({"tilt": 1.0}, "unknown setting 'tilt'; did you mean 'tilt_deg'? known settings: kind, radius_m, sizes"),
    ],
)
def test_what_types_do_not_allow_is_refused_in_words(settings, message):
    with pytest.raises(ConfigError) as caught:
        Cart.of(**settings)
    assert message in str(caught.value)
    if "tilt" not in settings:
        with pytest.raises(ConfigError) as caught:
            overlay(Train(), {"cart": settings}, "file")
        assert str(caught.value).startswith(f"file: cart.{message}")


def test_no_two_parts_of_the_environments_settings_have_one_of_the_same_name():
    names = [name for part in NavConfig.__mro__[:-2] for name in inspect.get_annotations(part)]
    assert len(set(names)) == len(names) == len(flatten(NavConfig()))
