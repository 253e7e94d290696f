"""Compute the reward of a control step on NumPy or JAX arrays with any leading batch axes (paper section V-A)."""

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.rotations import Array, namespace


def interactive_navigation_reward(
    success: Array,
    geodesic_before_m: Array,
    geodesic_after_m: Array,
    interacts: Array,
    k_int: float,
    success_value: float = 10.0,
) -> tuple[Array, dict[str, Array]]:
    """Return R = R_suc + R_pot + R_int [...], and its terms under `success`, `potential`, `interaction`.

    R_suc is `success_value` on the step that reaches the goal. R_pot = GD_{t-1} - GD_t is geodesic progress among
    static structure; over an episode it adds up to the first less the last distance. R_int = -k_int 1_int, where
    `interacts` is 1 if the robot touched a movable object in any physics substep; the paper's k_int are 0, 0.1 and 1.
    Raise `ConfigError` for a negative Python number `k_int`.
    """
    if isinstance(k_int, (int, float)) and k_int < 0:
        raise ConfigError(f"k_int is {k_int}, expected a penalty >= 0 (it is subtracted)")
    xp = namespace(success, geodesic_before_m, geodesic_after_m, interacts)
    terms = {
        "success": xp.asarray(success) * success_value,
        "potential": xp.asarray(geodesic_before_m) - xp.asarray(geodesic_after_m),
        "interaction": -k_int * xp.asarray(interacts),
    }
    return terms["success"] + terms["potential"] + terms["interaction"], terms
