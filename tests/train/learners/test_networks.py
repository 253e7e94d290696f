"""Networks: sizes by hand, what is normalised, encoders shared and apart, and learning from a picture."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import losses as ppo_losses

from interactive_nav_common.errors import UserError
from tests.train.learners.test_ppo import Recorder
from tests.train.toy_env import ToyConfig, batched
from tests.train.toy_pixels import SIDE, SMALL, ToyPixels
from train.config import EnvConfig, NetworkConfig, PPOConfig, RunConfig, TrainConfig
from train.learners import networks, ppo
from train.learners.algorithms import ALGORITHMS

FULL = {"state": (29,), "pixels/depth": (68, 68, 1), "pixels/segmentation": (68, 68, 1)}
TINY = {"state": (6,), "pixels/depth": (SIDE, SIDE, 1), "pixels/segmentation": (SIDE, SIDE, 1)}
KEY = jax.random.PRNGKey(0)


def count(tree) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def observation(shape=(3,), size=TINY, seed=0):
    rng = np.random.default_rng(seed)
    out = {name: jnp.asarray(rng.integers(0, 256, (*shape, *s)), jnp.uint8) for name, s in size.items()}
    return out | {"state": jnp.asarray(rng.normal(2.0, 3.0, (*shape, *size["state"])), jnp.float32)}


def make(config=SMALL, size=TINY, normalize=True):
    return networks.make_ppo_networks(config, size, 2, (16,), (16,), normalize)


def test_sizes_are_those_of_the_original():
    """Reference benchmark 8.1: 68 -> 16 -> 7 -> 5 pixels, 1,600 features, 0.62 million weights with the trunk."""
    made = networks.make_ppo_networks(NetworkConfig(), FULL, 2, (256,), (256,), True)
    policy = made.policy_network.init(KEY)  # type: ignore[call-arg]
    image = policy["encoder"]["params"]["image"]
    assert image["Conv_0"]["kernel"].shape == (8, 8, 2, 32)
    assert image["Conv_2"]["kernel"].shape == (3, 3, 64, 64)
    assert image["Dense_0"]["kernel"].shape == (1600, 256)
    conv = 8 * 8 * 2 * 32 + 32 + 4 * 4 * 32 * 64 + 64 + 3 * 3 * 64 * 64 + 64
    encoder = conv + 1600 * 256 + 256 + 29 * 256 + 256
    assert count(policy["encoder"]) == encoder
    assert count(policy["head"]) == 512 * 256 + 256 + 256 * 4 + 4  # mean and deviation of two actions
    value = made.value_network.init(KEY)  # type: ignore[call-arg]
    assert count(value["head"]) == 512 * 256 + 256 + 256 * 1 + 1
    assert float(jnp.abs(value["head"]["params"]["output"]["kernel"]).max()) <= 0.003


def test_bytes_and_floats_of_one_image_give_the_same_features():
    made = make()
    params = made.policy_network.init(KEY)  # type: ignore[call-arg]
    seen = observation()
    floats = {k: v.astype(jnp.float32) / 255 if v.dtype == jnp.uint8 else v for k, v in seen.items()}
    statistics = networks.init_normalizer(TINY)
    apply = made.policy_network.apply
    np.testing.assert_allclose(apply(statistics, params, seen), apply(statistics, params, floats), rtol=1e-5, atol=1e-6)


def test_bytes_beside_signed_floats_are_each_taken_as_they_are():
    size = {"pixels/rgb": (SIDE, SIDE, 3), "pixels/normals": (SIDE, SIDE, 3)}
    made = networks.make_ppo_networks(SMALL, size, 2, (8,), (8,), True)
    params = made.policy_network.init(KEY)  # type: ignore[call-arg]
    rng = np.random.default_rng(0)
    rgb = jnp.asarray(rng.integers(0, 256, (4, SIDE, SIDE, 3)), jnp.uint8)
    seen = {"pixels/rgb": rgb, "pixels/normals": jnp.asarray(rng.uniform(-1, 1, rgb.shape), jnp.float32)}
    statistics, apply = networks.init_normalizer(size), made.policy_network.apply
    floats = {**seen, "pixels/rgb": rgb.astype(jnp.float32) / 255}
    np.testing.assert_allclose(apply(statistics, params, seen), apply(statistics, params, floats), rtol=1e-5, atol=1e-6)


def test_only_the_vector_is_normalised():
    seen = observation((500,))
    statistics = networks.update_normalizer(networks.init_normalizer(TINY), seen)
    mean: Any = statistics.mean
    assert set(mean) == {"state"}
    np.testing.assert_allclose(mean["state"], seen["state"].mean(0), rtol=1e-4)
    normal = networks.normalize(seen, statistics)
    np.testing.assert_allclose(normal["state"].std(0), np.ones(6), rtol=1e-2)
    np.testing.assert_array_equal(normal["pixels/depth"], seen["pixels/depth"])
    assert networks.preprocess(False)(seen, statistics) is seen


def test_a_critic_of_the_vector_does_not_see_the_images():
    made = make(dataclasses.replace(SMALL, critic_inputs="state"))
    value = made.value_network
    params, statistics = value.init(KEY), networks.init_normalizer(TINY)  # type: ignore[call-arg]
    one, other = observation(), {**observation(seed=1), "state": observation()["state"]}
    np.testing.assert_array_equal(value.apply(statistics, params, one), value.apply(statistics, params, other))
    policy = made.policy_network
    params = policy.init(KEY)  # type: ignore[call-arg]
    assert float(jnp.abs(policy.apply(statistics, params, one) - policy.apply(statistics, params, other)).max()) > 0


def test_an_action_reaches_both_critics():
    head = networks.TwinHead((8,), action_features=4)
    split = networks.make_split(SMALL, TINY, True, networks.preprocess(True), head, action_size=2)
    params, statistics = split.init(KEY), networks.init_normalizer(TINY)
    values = [split.apply(statistics, params, observation(), jnp.full((3, 2), a)) for a in (0.0, 1.0)]
    assert values[0].shape == (3, 2)
    assert (np.asarray(values[0]) != np.asarray(values[1])).all()
    assert (np.asarray(values[0])[:, 0] != np.asarray(values[0])[:, 1]).all()  # independent critics


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"conv_strides": (4, 2)}, "the same number"),
        ({"share_encoder": True, "critic_inputs": "state"}, "sees the same"),
        ({"image_features": 0}, "at least 1"),
    ],
)
def test_impossible_encoders_are_refused(settings, told):
    with pytest.raises(UserError, match=told):
        NetworkConfig(**settings)


def test_images_too_small_for_the_kernels_are_refused():
    with pytest.raises(UserError, match=r"12 x 12 pixels are too small for kernels \(8, 4, 3\)"):
        make(NetworkConfig())
    with pytest.raises(UserError, match=r"images have sides of \[12, 20\] pixels, expected one of all cameras"):
        make(SMALL, {**TINY, "pixels/left/depth": (20, 20, 1)})
    images = {name: shape for name, shape in TINY.items() if name != "state"}
    with pytest.raises(UserError, match="images only"):
        make(dataclasses.replace(SMALL, critic_inputs="state"), images)


def test_images_alone_are_enough():
    images = {name: shape for name, shape in TINY.items() if name != "state"}
    made = make(size=images)
    params, statistics = made.policy_network.init(KEY), networks.init_normalizer(images)  # type: ignore[call-arg]
    seen = {name: value for name, value in observation().items() if name != "state"}
    statistics = networks.update_normalizer(statistics, seen)
    assert made.policy_network.apply(statistics, params, seen).shape == (3, 4)


def test_shared_and_separate_encoders_give_the_same_loss_and_gradient():
    """With equal encoders both spellings are one function; the shared gradient is the sum of the separate ones."""
    config = PPOConfig(
        num_envs=4, unroll_length=3, batch_size=4, num_minibatches=1, num_updates_per_batch=1, learning_rate=1.0
    )
    config = dataclasses.replace(config, policy_hidden_layer_sizes=(8,), value_hidden_layer_sizes=(8,))
    env = batched(ToyPixels())
    apart = ppo.make_agent(env, TrainConfig(ppo=config, network=SMALL))
    shared = ppo.make_agent(env, TrainConfig(ppo=config, network=dataclasses.replace(SMALL, share_encoder=True)))
    one = shared.init(KEY, KEY)
    policy, value = ppo.whole_params(one.params)
    state = jax.jit(env.reset)(jax.random.split(KEY, 4))
    _, data, _ = jax.jit(lambda s, e: ppo.collect(shared, env, s, e, KEY))(one, state)
    settings = {"entropy_cost": 0.01, "normalize_advantage": False, "discounting": 0.9}

    def loss_shared(params):
        return ppo.loss_of_splits(shared.nets, params, one.normalizer_params, data, KEY, **settings)[0]

    def loss_apart(params):
        return ppo_losses.compute_ppo_loss(
            params, one.normalizer_params, data, KEY, ppo_network=apart.nets, **settings
        )[0]

    def loss_on_features(params):
        return ppo.loss_of_splits(apart.nets, params, one.normalizer_params, data, KEY, **settings)[0]

    both = ppo_losses.PPONetworkParams(policy=policy, value=value)  # type: ignore[call-arg]
    loss, grad = jax.jit(jax.value_and_grad(loss_shared))(one.params)
    loss_2, grad_2 = jax.jit(jax.value_and_grad(loss_apart))(both)
    np.testing.assert_allclose(loss, loss_2, rtol=1e-5)
    loss_3, grad_3 = jax.jit(jax.value_and_grad(loss_on_features))(both)
    np.testing.assert_allclose(loss_3, loss_2, rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), grad_3, grad_2)
    total = jax.tree.map(jnp.add, grad_2.policy["encoder"], grad_2.value["encoder"])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), grad.encoder, total)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), grad.value, grad_2.value["head"])


@pytest.mark.slow
@pytest.mark.heavy
def test_ppo_learns_from_a_picture():
    """Where the goal lies stands in the image only: success from about 0.2 to at least 0.9."""
    config = TrainConfig(
        env=EnvConfig(scenes=("toy",)),
        network=dataclasses.replace(
            SMALL, conv_channels=(8,), conv_kernels=(4,), conv_strides=(4,), share_encoder=True
        ),
        ppo=PPOConfig(
            num_envs=64,
            unroll_length=16,
            batch_size=64,
            num_minibatches=4,
            learning_rate=2e-3,
            discounting=0.97,
            policy_hidden_layer_sizes=(32,),
            value_hidden_layer_sizes=(32,),
        ),
        run=RunConfig(num_timesteps=65_536, log_every_steps=8_192, checkpoint_every_steps=65_536),
    )
    seen = Recorder()
    result = ALGORITHMS["ppo"].train(batched(ToyPixels(ToyConfig())), config, seen)
    assert seen.logs[0][1]["episode/success"] < 0.6
    assert result.metrics["episode/success"] >= 0.9


@pytest.mark.parametrize("name", ["conv_for_cpu", "conv_in_blocks"])
@pytest.mark.parametrize(("size", "k", "stride"), [(11, 8, 4), (12, 4, 2), (5, 3, 1), (7, 2, 3)])
def test_convolutions_are_xlas_in_value_and_gradients(name: str, size: int, k: int, stride: int):
    images = jax.random.normal(jax.random.PRNGKey(0), (2, size, size + 1, 3))
    kernel = jax.random.normal(jax.random.PRNGKey(1), (k, k, 3, 5))

    def ours(images, kernel) -> Any:
        return getattr(networks, name)(images, kernel, (stride, stride))

    def xlas(images, kernel):
        names = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(images, kernel, (stride, stride), "VALID", dimension_numbers=names)

    for value in (ours(images, kernel), networks.conv_as_product(images, kernel, (stride, stride))):
        np.testing.assert_allclose(value, xlas(images, kernel), rtol=1e-4, atol=1e-4)
    found, expected = (jax.grad(lambda x, w, f=f: (f(x, w) ** 2).sum(), (0, 1))(images, kernel) for f in (ours, xlas))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-3)


def test_a_gpu_convolves_blocks_of_few_channels_with_stride_one():
    """68 pixels in blocks of 4 are 17 of 2 * 16 channels; 32 channels stay as they are."""
    text = str(
        jax.make_jaxpr(networks.conv_in_blocks, static_argnums=2)(
            jnp.zeros((1, 68, 68, 2)), jnp.zeros((8, 8, 2, 32)), (4, 4)
        )
    )
    assert "f32[1,17,17,32]" in text and "window_strides=(1, 1)" in text and "f32[1,16,16,32]" in text
    text = str(
        jax.make_jaxpr(networks.conv_in_blocks, static_argnums=2)(
            jnp.zeros((1, 16, 16, 32)), jnp.zeros((4, 4, 32, 64)), (2, 2)
        )
    )
    assert "window_strides=(2, 2)" in text and "pad" not in text.split("conv_general")[0]


def test_on_a_cpu_acting_has_xlas_convolutions_and_learning_none():
    """Its gradients within a loop take 20 to 30 times as long there, see `docs/studies/policies/cpu_programs.py`."""
    made = make()
    params = made.policy_network.init(KEY)  # type: ignore[call-arg]

    def acted(params):
        return made.policy_network.apply(networks.init_normalizer(TINY), params, observation())

    acting, learning = (jax.make_jaxpr(f)(params) for f in (acted, jax.grad(lambda params: acted(params).sum())))
    assert "conv_general_dilated" in str(acting)
    assert ("conv_general_dilated" in str(learning)) == (jax.default_backend() != "cpu")
