"""Every robot's evidence on the MJX backends, on an NVIDIA GPU (on a CPU most would compile and run for minutes)."""

import jax
import pytest

from docs.studies.robots import evidence
from interactive_nav.robots import robot_names

pytestmark = [pytest.mark.gpu, pytest.mark.heavy]


@pytest.mark.parametrize("backend", ["warp", "jax"])
@pytest.mark.parametrize("name", robot_names())
def test_evidence(name, backend):
    if jax.default_backend() != "gpu":
        pytest.skip("needs an NVIDIA GPU")
    own = evidence.measure(name, backend)
    assert own.backend == backend
    failed = [f"{c.name}: {c.value:.4g}, limits {c.low:.3g} to {c.high:.3g}" for c in own.checks if not c.passed]
    assert not failed, "; ".join(failed)
