"""Sums of a profile, by hand; and what a machine without a GPU is told."""

import pytest

from docs.studies.kernels import busy_share, device_events, part_of, plain_name
from interactive_nav_common.errors import UserError


def test_busy_is_what_the_intervals_cover():
    # From 0 to 10: covered 0-3 and 5-8, of which 6-7 twice.
    assert busy_share([(5.0, 8.0), (0.0, 3.0), (6.0, 7.0), (10.0, 10.0)]) == pytest.approx(0.6)
    assert busy_share([(2.0, 4.0)]) == 1.0 and busy_share([]) == 0.0


@pytest.mark.parametrize(
    ("kernel", "name", "part"),
    [
        ("_nxn_broadphase__kernel_079a3fb8_cuda_kernel_forward", "_nxn_broadphase__kernel", "collision"),
        ("_efc_contact_init__locals__kernel_3a7c064e_b7c9424", None, "constraint rows"),
        ("_update_gradient_JTDAJ_dense_tiled__locals__kernel_87ae7184", None, "solver"),
        ("build_megakernel__locals___render_megakernel_0638279c", None, "rendering"),
        ("_update_constraint_efc__locals__kernel_0539aa50", None, "solver"),  # in every iteration of the solver
        ("_JTDACJ_sparse__locals__kernel_0d23ad07", None, "solver"),
        ("_comvel_branch", None, "smooth dynamics"),
        ("some_other_kernel", None, "task, observation, window, learner (XLA)"),
        ("loop_add_fusion.12", "loop_add_fusion", "task, observation, window, learner (XLA)"),
        ("MemcpyD2D", "MemcpyD2D", "copies"),
    ],
)
def test_kernels_are_named_and_sorted(kernel, name, part):
    assert part_of(kernel) == part
    assert name is None or plain_name(kernel) == name


def test_a_profile_without_a_gpu_is_refused(tmp_path):
    with pytest.raises(UserError, match="no kernels of a GPU"):
        device_events(tmp_path)
