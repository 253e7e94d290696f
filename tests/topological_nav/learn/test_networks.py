"""Sizes against the originals', embeddings of known length, losses by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from topological_nav.learn.learning import initial, variable_shapes
from topological_nav.learn.networks import Network, augmented, falling, joined
from topological_nav.learn.training import Networks, Trained


def sizes(network: Network, height: int = 224, width: int = 224) -> dict:
    """Parameters by part, without computing anything."""
    made = variable_shapes(network, (height, width))
    return {name: sum(x.size for x in jax.tree.leaves(tree)) for name, tree in made["params"].items()}


def test_first_values_have_the_stated_spread_and_follow_from_the_seed():
    shapes = variable_shapes(Network("rooms", "resnet18", 16, 512, 5), (32, 32))
    one, same, other = (initial(shapes, seed) for seed in (3, 3, 4))
    kernel = one["params"]["body"]["Conv_0"]["kernel"]  # 7 x 7 x 3 x 16: root of 2 / (49 x 16) = 0.0505
    assert float(kernel.std()) == pytest.approx(0.0505, rel=0.05)
    dense = one["params"]["layers_1"]["kernel"]  # 512 x 512: 1 / root of 512 = 0.0442
    assert float(dense.std()) == pytest.approx(0.0442, rel=0.02)
    assert float(abs(dense.mean())) < 1e-3
    assert {float(x.mean()) for x in jax.tree.leaves(one["batch_stats"])} == {0.0, 1.0}
    assert (kernel == same["params"]["body"]["Conv_0"]["kernel"]).all()
    assert (kernel != other["params"]["body"]["Conv_0"]["kernel"]).any()


def test_backbones_are_as_large_as_the_originals():
    # He et al.'s ResNet-18 has 11,689,512 parameters, 513,000 of them in its classifier.
    assert sizes(Network("passages", "resnet18"))["body"] == 11_689_512 - 513_000
    # Weights and biases of the one-column AlexNet's five convolutions.
    conv = [(11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256)]
    assert sizes(Network("passages", "alexnet"))["body"] == sum(k * k * a * b + b for k, a, b in conv) == 2_469_696


def test_the_room_head_has_two_layers_of_512():
    parts = sizes(Network("rooms", "resnet18", outputs=17), 96, 128)
    assert parts["layers_0"] == 512 * 512 + 512
    assert parts["layers_1"] == 512 * 512 + 512
    assert parts["last"] == 512 * 17 + 17


@pytest.mark.parametrize(("backbone", "length"), [("resnet18", 2 * 4 + 8 * 4), ("alexnet", 6 * 4 + 4 * 4)])
def test_embeddings_are_two_unit_vectors(backbone, length):
    network = Network("rooms", backbone, 4, 8, 3)
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (5, 32, 48, 3)), jnp.uint8)
    variables = initial(variable_shapes(network, (32, 48)), 0)
    embedded = jax.jit(lambda v, x: network.apply(v, x, method="embed"))(variables, images)
    assert embedded.shape == (5, length)
    first = {"resnet18": 8, "alexnet": 24}[backbone]
    assert np.linalg.norm(embedded[:, :first], axis=1) == pytest.approx(np.ones(5), abs=1e-5)
    assert np.linalg.norm(embedded[:, first:], axis=1) == pytest.approx(np.ones(5), abs=1e-5)
    assert np.linalg.norm(embedded[0] - embedded[1]) > 1e-3


def test_max_pooling_before_normalising_by_hand():
    a = jnp.array([[[[3.0, 0.0], [1.0, 4.0]]]])  # maxima 3 and 4, length 5
    b = jnp.array([[[[0.0], [2.0]], [[1.0], [-7.0]]]])  # maximum 2
    assert joined((a, b))[0].tolist() == pytest.approx([0.6, 0.8, 1.0])
    assert joined((0 * a, b))[0].tolist() == [0.0, 0.0, 1.0]


def test_outputs_for_lengths_never_rise():
    # softplus of 0 is log 2, of log(e - 1) it is 1.
    x = jnp.array([[3.0, 0.0, np.log(np.e - 1.0)], [-2.0, -50.0, 40.0]])
    expected = [[3.0, 3.0 - np.log(2.0), 2.0 - np.log(2.0)], [-2.0, -2.0, -42.0]]
    assert np.asarray(falling(x)) == pytest.approx(np.array(expected), abs=1e-5)
    assert falling(x[:, :1]).tolist() == [[3.0], [-2.0]]


@pytest.mark.parametrize("backbone", ["resnet18", "alexnet"])
def test_detectors_have_an_output_a_length_that_cannot_contradict_the_next(backbone):
    network = Network("passages", backbone, 4, outputs=5)
    variables = initial(variable_shapes(network, (32, 48)), 1)
    images = jnp.asarray(np.random.default_rng(1).integers(0, 256, (6, 32, 48, 3)), jnp.uint8)
    logits = np.asarray(jax.jit(lambda v, x: network.apply(v, x))(variables, images))
    assert logits.shape == (6, 5) and (np.diff(logits, axis=1) < 0).all()


def test_augmented_images_keep_their_range_and_differ():
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (6, 16, 32, 3)), jnp.uint8)
    one, other = (augmented(jax.random.PRNGKey(k), images, False) for k in (0, 1))
    assert one.shape == images.shape and one.dtype == jnp.float32
    assert float(one.min()) >= 0.0 and float(one.max()) <= 255.0
    assert float(jnp.abs(one - other).mean()) > 1.0
    assert (augmented(jax.random.PRNGKey(0), images, False) == one).all()


def test_mirroring_is_done_where_asked():
    """A ramp to the right keeps its direction unless it is mirrored; of 64 some are, some not."""
    ramp = jnp.broadcast_to(jnp.arange(0, 128, 4, dtype=jnp.uint8)[None, None, :, None], (64, 16, 32, 3))

    def rising(flip):
        x = augmented(jax.random.PRNGKey(2), ramp, flip)
        return np.asarray(x[:, :, 24:].mean((1, 2, 3)) > x[:, :, :8].mean((1, 2, 3)))

    assert rising(False).all()
    assert 10 < rising(True).sum() < 54


def test_a_detector_answers_for_one_length_where_that_is_set():
    class Fixed(Trained):
        def logits(self, images):
            return np.array([[2.0, 1.0, -1.0]])

    detector = Fixed(None, {}, {"lengths_m": [1.0, 2.0, 3.0]})  # type: ignore[arg-type]
    image, asked = np.zeros((1, 4, 4, 3), np.uint8), np.array([[1.0, 2.5]])
    chances = [1 / (1 + np.exp(-logit)) for logit in (2.0, 0.0, 1.0)]
    assert detector.passage(image, asked)[0] == pytest.approx(chances[:2])
    always = Networks(detector, detector).asking(2.0).detector
    assert always.passage(image, asked)[0] == pytest.approx([chances[2]] * 2)
    assert always.passage(image, 3.0) == pytest.approx([chances[2]])
