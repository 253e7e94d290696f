"""The cells' wiring and the loss, recomputed in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from topological_nav.drives.driving import Forward, Policy, fresh_params, mean_over, policy_loss, unrolled

WIDTH, HIDDEN = 7, 4


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


@pytest.fixture(scope="module", params=[0, 3])
def made(request):
    policy = Policy(hidden=HIDDEN, projection=request.param)
    params = fresh_params(policy, Forward(5), WIDTH, 1)
    # No bias is 0: all of them must be in the right place.
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: jnp.asarray(x + rng.normal(0, 0.3, x.shape), jnp.float32), params)
    return policy, params


def by_hand(params, memory, x):
    p = jax.tree.map(np.asarray, params["policy"])

    def dense(name, value):
        part = p
        for key in name.split("/"):
            part = part[key]
        return value @ part["kernel"] + part["bias"]

    if "project" in p:
        x = np.maximum(dense("project", x), 0)
    total, new, logits = memory[0] + memory[1], [], []
    for i, own in enumerate(memory):
        a, b = dense(f"cells_{i}/inputs", x), dense(f"cells_{i}/memory", total)
        reset, keep = (
            sigmoid(a[:, :HIDDEN] + b[:, :HIDDEN]),
            sigmoid(a[:, HIDDEN : 2 * HIDDEN] + b[:, HIDDEN : 2 * HIDDEN]),
        )
        candidate = np.tanh(a[:, 2 * HIDDEN :] + reset * b[:, 2 * HIDDEN :])
        new.append((1 - keep) * candidate + keep * own)
        logits.append(dense(f"heads_{i}", new[-1]))
    return new, logits


def test_both_cells_read_the_sum_of_both_memories(made):
    policy, params = made
    rng = np.random.default_rng(2)
    x = rng.normal(size=(2, 6, WIDTH)).astype(np.float32)
    memory, expected = [np.zeros((2, HIDDEN))] * 2, []
    for t in range(6):
        memory, logits = by_hand(params, memory, x[:, t])
        expected.append(logits)
    linear, angular = unrolled(policy, params["policy"], jnp.asarray(x))
    assert linear.shape == (2, 6, 3) and angular.shape == (2, 6, 5)
    assert np.asarray(linear) == pytest.approx(np.stack([e[0] for e in expected], 1), abs=1e-5)
    assert np.asarray(angular) == pytest.approx(np.stack([e[1] for e in expected], 1), abs=1e-5)


def test_each_memory_reaches_the_other_velocity_only_through_the_sum(made):
    policy, params = made
    x, rng = jnp.zeros((1, WIDTH)), np.random.default_rng(3)
    a, b = (jnp.asarray(rng.normal(size=(1, HIDDEN)), jnp.float32) for _ in range(2))
    new, _ = policy.apply({"params": params["policy"]}, (a, b), x)
    other, _ = policy.apply({"params": params["policy"]}, (b, a), x)
    # Swapped memories have the same sum: what differs is z (a - b), by the linear cell's own gate.
    p = jax.tree.map(np.asarray, params["policy"])
    seen = np.zeros((1, WIDTH)) if "project" not in p else np.maximum(p["project"]["bias"], 0)[None]
    gates = seen @ p["cells_0"]["inputs"]["kernel"] + p["cells_0"]["inputs"]["bias"]
    gates = gates + np.asarray(a + b) @ p["cells_0"]["memory"]["kernel"] + p["cells_0"]["memory"]["bias"]
    keep = sigmoid(gates[:, HIDDEN : 2 * HIDDEN])
    assert np.asarray(new[0] - other[0]) == pytest.approx(keep * np.asarray(a - b), abs=1e-5)


def test_the_forward_model_adds_a_change(made):
    _, params = made
    p = jax.tree.map(np.asarray, params["forward"])
    rng = np.random.default_rng(4)
    u, x, action = rng.normal(size=(3, WIDTH)), rng.normal(size=(3, WIDTH)), np.eye(8)[[0, 2, 7]]
    y = np.concatenate([x, action], 1)
    for layer in ("Dense_0", "Dense_1"):
        y = np.maximum(y @ p[layer]["kernel"] + p[layer]["bias"], 0)
    unit = rng.uniform(0.1, 2.0, WIDTH)
    expected = u + unit * (y @ p["Dense_2"]["kernel"] + p["Dense_2"]["bias"])

    def predicted(weights):
        return Forward(5).apply({"params": weights}, *(jnp.asarray(v, jnp.float32) for v in (u, x, action, unit)))

    assert np.asarray(predicted(params["forward"])) == pytest.approx(expected, abs=1e-4)
    fresh = fresh_params(Policy(hidden=HIDDEN), Forward(5), WIDTH, 0)["forward"]
    assert np.asarray(predicted(fresh)) == pytest.approx(u, abs=1e-6)


def test_the_loss_by_hand():
    """One run of two steps, the second behind the drive's end for the forward model."""
    linear_logits = jnp.log(jnp.asarray([[[0.5, 0.25, 0.25], [0.2, 0.2, 0.6]]]))
    angular_logits = jnp.log(jnp.asarray([[[0.1, 0.1, 0.6, 0.1, 0.1], [0.2, 0.2, 0.2, 0.2, 0.2]]]))
    following = jnp.asarray([[[1.0, 0.0], [9.0, 9.0]]])
    predicted, consistent = jnp.asarray([[[0.5, 0.0], [0.0, 0.0]]]), jnp.asarray([[[1.0, 2.0], [0.0, 0.0]]])
    truth = {"linear": [[0, 2]], "angular": [[2, 4]], "valid": [[True, True]], "followed": [[True, False]]}
    truth = {name: jnp.asarray(value) for name, value in truth.items()}
    arguments = ((linear_logits, angular_logits), truth, (predicted, consistent), following)
    ce_linear = -(np.log(0.5) + np.log(0.6)) / 2
    ce_angular = -(np.log(0.6) + np.log(0.2)) / 2
    loss, parts = policy_loss(*arguments, alpha=10.0, lam=0.5)
    assert float(parts["ce_linear"]) == pytest.approx(ce_linear, abs=1e-6)
    assert float(parts["ce_angular"]) == pytest.approx(ce_angular, abs=1e-6)
    assert float(parts["forward"]) == pytest.approx(0.25) and float(parts["consistency"]) == pytest.approx(4.0)
    assert float(loss) == pytest.approx(10 * (ce_linear + ce_angular) + 0.25 + 0.5 * 4.0, abs=1e-5)
    alone, _ = policy_loss(*arguments, alpha=10.0, lam=0.5, jointly=0.0)
    assert float(alone) == pytest.approx(0.25)
    first, _ = policy_loss(*arguments, alpha=10.0, lam=0.5, jointly=0.0, consistent=1.0)  # the report's equation 1
    assert float(first) == pytest.approx(0.25 + 0.5 * 4.0)


def test_a_mean_over_nothing_is_zero():
    assert float(mean_over(jnp.asarray([3.0, 5.0]), jnp.asarray([False, False]))) == 0.0
    assert float(mean_over(jnp.asarray([3.0, 5.0]), jnp.asarray([False, True]))) == 5.0
